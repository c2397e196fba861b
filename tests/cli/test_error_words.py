"""Every error that stops a run names its place and a remedy: from drivers, steps and the store."""

from __future__ import annotations

import ast
import errno
import inspect
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from drivers import errors as device_errors
from drivers.ur.link import probe
from service.core import errors as core_errors
from service.core.errors import OrthocaptureError
from service.store.signatures.log import NAME
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.faulty_disk import FaultyDisk
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

ROOT = Path(__file__).parents[2]
# Errors of steps and drivers always reach a person; elsewhere some are only for programmers.
SPEAKING = [
    *(ROOT / "drivers").rglob("*.py"),
    *(ROOT / "service" / "steps").rglob("*.py"),
    ROOT / "service/run_record.py",
]
CLASSES = {
    name
    for module in (device_errors, core_errors)
    for name, kind in inspect.getmembers(module, inspect.isclass)
    if issubclass(kind, OrthocaptureError)
}


def raised(path: Path) -> Iterator[tuple[int, set[str]]]:
    """Line and keywords of each error of the tree that a file raises."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CLASSES:
            yield node.lineno, {str(keyword.arg) for keyword in node.keywords}


def test_every_error_of_a_driver_or_a_step_says_where_and_what_to_do() -> None:
    found = [(path, *one) for path in SPEAKING for one in raised(path)]
    assert len(found) > 100
    silent = [
        f"{path.relative_to(ROOT)}:{line} lacks {', '.join(sorted({'where', 'remedy'} - keywords))}"
        for path, line, keywords in found
        if not {"where", "remedy"} <= keywords
    ]
    assert silent == []


def test_a_controller_that_hangs_up_is_told_with_what_to_do() -> None:
    host = "127.7.60.7"
    with closing(socket.create_server((host, 30004))) as listener:

        def hang_up() -> None:
            link, _ = listener.accept()
            link.recv(64)
            link.close()

        threading.Thread(target=hang_up, daemon=True).start()
        with pytest.raises(device_errors.DeviceUnavailableError) as raised_error:
            probe(host, 2.0)
    assert raised_error.value.remedy


def test_a_data_folder_that_is_gone_is_told_with_what_to_do(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        (tmp_path / "data").rename(tmp_path / "aside")
        with pytest.raises(core_errors.StoreError) as raised_error:
            store.free_bytes()
        (tmp_path / "aside").rename(tmp_path / "data")
    assert raised_error.value.where
    assert raised_error.value.remedy


def test_a_run_that_could_not_be_signed_says_how_it_is(tmp_path: Path) -> None:
    """The disk is full when the run ends; after resuming as told, the run is signed and verifies."""
    disk = FaultyDisk("append", 1, errno.ENOSPC, file=NAME)
    with Store.open(tmp_path / "data", files=disk) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        disk.armed = True
        bench.run()
        assert disk.failed
        told = [words for words in bench.operator.told if words.startswith("the record could not be signed")]
        assert told
        assert all(f"`orthocapture resume {bench.run_id}` signs it" in words for words in told)
        assert any("is not in signatures.jsonl yet" in note for note in verify(tmp_path / "data").notes)
        disk.mended = True
        bench.run()
    assert not any("not in signatures.jsonl yet" in note for note in verify(tmp_path / "data").notes)
    bench.must_verify()
