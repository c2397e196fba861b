"""Claim a job, compute, append the result; again, until told to stop."""

from __future__ import annotations

import importlib
import logging
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from service.core.errors import ComputeError, IntegrityError, OrthocaptureError
from service.store.errors import LeaseLostError
from service.store.records import Job, NewArtefact
from service.store.store import Store
from service.worker.job import Handler, JobAnswer, JobContext

_log = logging.getLogger(__name__)
_LEASE_S = 30.0

_MODULES = {
    "calibrate": "calibrate",
    "ct_surface": "surfaces",
    "locate_spheres": "surfaces",
    "layout": "layout",
    "structure_from_motion": "poses",
    "hybrid": "poses",
    "detect_spheres": "registering",
    "register": "registering",
    "evaluate": "evaluating",
    "coverage_points": "live",
    "live_view": "live",
    "live_summary": "live",
}


def _handler(kind: str) -> Handler:
    """The function of this name, imported at the first such job: a worker is ready at once."""

    def handle(context: JobContext) -> JobAnswer:
        module = importlib.import_module(f"service.worker.{_MODULES[kind]}")
        function: Handler = getattr(module, kind)
        return function(context)

    return handle


HANDLERS: Mapping[str, Handler] = {kind: _handler(kind) for kind in _MODULES}


def work(
    store: Store, *, until_idle: bool, stop: Callable[[], bool], progress: Callable[[str, int, int], None]
) -> int:
    """Serve jobs until `stop()`, or with `until_idle` until none is left; the number of jobs done."""
    name = f"worker {socket.gethostname()}:{os.getpid()}"
    done = 0
    while not stop():
        job = store.claim_job(name, _LEASE_S, kinds=list(HANDLERS))
        if job is None:
            if until_idle:
                return done
            time.sleep(0.2)
            continue
        _do(store, job, progress)
        done += 1
    return done


def _do(store: Store, job: Job, progress: Callable[[str, int, int], None]) -> None:
    started_s = time.monotonic()
    keeper = _LeaseKeeper(store, job)
    try:
        with keeper, tempfile.TemporaryDirectory(prefix="orthocapture-job-") as scratch:
            answer = HANDLERS[job.kind](JobContext(job.arguments, store, Path(scratch), progress))
    except OrthocaptureError as error:
        # The same input gives the same refusal: only trouble that passes is worth another try.
        store.fail_job(job, error, retry=not isinstance(error, (ComputeError, IntegrityError)))
        return
    except (ValueError, ArithmeticError, LookupError, OSError, MemoryError, np.linalg.LinAlgError) as error:
        _log.exception("job %s failed", job.kind)
        store.fail_job(job, error, retry=False)
        return
    duration_s = time.monotonic() - started_s
    rows = [NewArtefact(ref=ref, device="worker", step=job.step, attempt=job.attempt) for ref in answer.artefacts]
    try:
        store.finish_job(job, measures=answer.measures, duration_s=duration_s, result=answer.result, artefacts=rows)
    except LeaseLostError:
        _log.warning("job %s was taken over by another worker; its result stands", job.job_id)


class _LeaseKeeper:
    """Renews a job's lease while it is computed."""

    def __init__(self, store: Store, job: Job) -> None:
        self._store, self._job = store, job
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._renew, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def _renew(self) -> None:
        while not self._stop.wait(_LEASE_S / 3):
            try:
                self._store.renew_job(self._job, _LEASE_S)
            except LeaseLostError:
                return
