"""Replays a recorded run as a new one, event by event, up to a chosen point: for screenshots of unfinished runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

from service.core.jobs import Each, Reference, read_reference
from service.core.protocol import parse_protocol
from service.core.records.events import Event, Payload
from service.core.records.run_events import JobEnqueued, JobFinished, OperatorAction, RunStarted, SessionStarted
from service.rig import Rig
from service.run_start import start_run
from service.steps import params_models
from service.store.records import Job, NewArtefact, NewJob
from service.store.store import Store

Told = Callable[[Event], bool]


def retell(
    store: Store,
    source: str,
    rig: Rig,
    person: str,
    *,
    until: Told,
    more: Mapping[int, Sequence[Payload]] | None = None,
) -> str:
    """Record a new run with the same events, artefacts and jobs as `source`; returns the new run's id.

    Automatic confirmations are attributed to `person`. Signatures are made anew for the new run's own records.

    Args:
        until: the first event for which it is true is left out, with all that follow.
        more: events of `person` to insert after the event of that number in `source`.
    """
    events = store.events(source)
    root = events[0].payload
    assert isinstance(root, RunStarted)
    text = store.artefact_path(root.protocol.sha256).read_bytes()
    loaded = parse_protocol(text, params_models(), name=root.protocol.original_name)
    run_id = start_run(store, loaded, rig, operator=person, auto_confirm=False)
    rows: dict[int, list[NewArtefact]] = {}
    for row in store.artefacts(source):
        new = NewArtefact(row.ref, row.device, row.step, row.attempt, row.viewpoint)
        rows.setdefault(row.seq, []).append(new)
    again: dict[str, str] = {}
    jobs = _Jobs(store, run_id)
    for event in events[1:]:
        if until(event):
            break
        again[event.sha256] = _tell(store, run_id, person, event, rows.get(event.seq, []), again, jobs)
        for payload in (more or {}).get(event.seq, ()):
            actor = person if isinstance(payload, OperatorAction) else "runner"
            store.record(run_id, [payload], actor=actor)
    return run_id


@dataclass
class _Jobs:
    """The jobs of the new run; the worker of the source finished them in an order of its own."""

    store: Store
    run_id: str
    keys: dict[str, str] = field(default_factory=dict[str, str])  # job of the source → idempotency key
    names: dict[str, str] = field(default_factory=dict[str, str])  # job of the source → job of the new run
    claimed: dict[str, Job] = field(default_factory=dict[str, Job])

    def claim(self, payload: JobFinished) -> Job:
        """Return the job that has this end. Raises AssertionError if it was never enqueued."""
        key = self.keys[payload.job]
        while key not in self.claimed:
            job = self.store.claim_job(payload.worker, 3600.0, [payload.job_kind], run_id=self.run_id)
            assert job is not None, payload.job
            self.claimed[job.idempotency_key] = job
        return self.claimed.pop(key)


def _renamed(value: Any, names: Mapping[str, str]) -> Any:
    """Arguments whose references are to the jobs of the new run."""
    reference = read_reference(value)
    if isinstance(reference, Reference):
        return replace(reference, job=names[reference.job]).record()
    if isinstance(reference, Each):
        return replace(reference, without=tuple(names[job] for job in reference.without)).record()
    if isinstance(value, dict):
        return {key: _renamed(item, names) for key, item in cast("dict[str, Any]", value).items()}
    return [_renamed(item, names) for item in cast("list[Any]", value)] if isinstance(value, list) else value


def _tell(
    store: Store,
    run_id: str,
    person: str,
    event: Event,
    rows: Sequence[NewArtefact],
    again: Mapping[str, str],
    jobs: _Jobs,
) -> str:
    """Record one event again; returns the hash of the new one."""
    payload = event.payload
    actor = event.actor
    if isinstance(payload, JobEnqueued):
        job = NewJob(
            payload.job_kind,
            payload.step,
            payload.attempt,
            payload.idempotency_key,
            _renamed(payload.arguments, jobs.names),
            version=payload.version,
        )
        jobs.keys[payload.job] = payload.idempotency_key
        store.record(run_id, [], actor=actor, jobs=[job])
        enqueued = store.events(run_id, store.head(run_id) - 1)[-1]
        assert isinstance(enqueued.payload, JobEnqueued)
        jobs.names[payload.job] = enqueued.payload.job
        return enqueued.sha256
    if isinstance(payload, JobFinished):
        finished = store.finish_job(
            jobs.claim(payload),
            measures=payload.measures,
            duration_s=payload.duration_s,
            result=payload.result,
            artefacts=rows,
            late_s=payload.late_s,
        )
        return finished.sha256
    if isinstance(payload, OperatorAction):
        signed = again.get(payload.signed_sha256, payload.signed_sha256)
        change: dict[str, Any] = {"automatic": False, "via": "web", "signed_sha256": signed}
        payload, actor = payload.model_copy(update=change), person
    if isinstance(payload, SessionStarted):
        payload = payload.model_copy(update={"host": "table-side"})
    return store.record(run_id, [payload], actor=actor, artefacts=rows)[-1].sha256
