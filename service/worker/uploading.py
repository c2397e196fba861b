"""The uploader beside a worker: a process of its own, so that nothing of the network reaches the worker's."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from service.core.errors import ConfigurationError
from service.store.data_folder import object_store_of

_LOG = logging.getLogger(__name__)
_POLL_S = 1.0
_FIRST_WAIT_S, _LONGEST_WAIT_S = 2.0, 60.0
_GRACE_S = 5.0


@contextmanager
def uploading(data: Path) -> Generator[None]:
    """Keep an uploader at work meanwhile, if the data folder's site.yaml names an object store; else nothing begins.

    A site.yaml that is wrong, or a package that is missing, is logged: the worker goes on without it.
    """
    if not _names_store(data):
        yield
        return
    over = threading.Event()
    keeper = threading.Thread(target=_keep, args=(data, over), name="uploader", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        over.set()
        keeper.join()


def _names_store(data: Path) -> bool:
    try:
        section = object_store_of(data)
        if section is None:
            return False
        from service.store.objects.opening import open_objects  # noqa: PLC0415 - for sites only

        open_objects(data, section)
    except ConfigurationError as error:
        _LOG.error("nothing is uploaded: %s", error)
        return False
    return True


def _keep(data: Path, over: threading.Event) -> None:
    """Start the uploader again whenever it ends, until `over`; then end it."""
    arguments = ["store", "upload", "--follow", "--data", str(data), "--json", "--parent", str(os.getpid())]
    wait_s = _FIRST_WAIT_S
    while not over.is_set():
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "service.cli.main", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:  # for want of memory, say
            _LOG.warning("no uploader could be started: %s", error.strerror)
            over.wait(wait_s)
            continue
        while process.poll() is None and not over.wait(_POLL_S):
            pass
        if over.is_set():
            _end(process)
            return
        _LOG.warning("the uploader has ended (status %s); another one is started", process.returncode)
        over.wait(wait_s)
        wait_s = min(2 * wait_s, _LONGEST_WAIT_S)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:  # it waits for the network
        process.kill()
        process.wait()
