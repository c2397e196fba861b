"""Crashes and power losses at every point of a record, and a writer killed while it writes."""

from __future__ import annotations

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.core.errors import StoreError
from service.core.records.events import Event
from service.store.database import engine, postgres
from service.store.durable_effects import DurableFiles
from service.store.records import NewArtefact, NewJob
from service.store.store import Store
from service.store.verification.verify import AuditReport, verify
from tests.support.processes.waiting import until
from tests.support.record.outsider import copy_data, is_postgres, outsider
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import (
    CountedIds,
    Crash,
    CrashingFiles,
    capture,
    captured,
    files_of,
    put_image,
    start_run,
)

ROOT_DIR = Path(__file__).parents[2]


def record_one(store: Store, run: str) -> list[Event]:
    ref = put_image(store, "v2")
    return store.record(
        run,
        [captured(ref, "v2")],
        actor="camera",
        artefacts=[NewArtefact(ref, "camera")],
        jobs=[NewJob("registration", "register", 1, "key")],
    )


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a run of one viewpoint."""
    data = tmp_path_factory.mktemp("crash") / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        capture(store, start_run(store), "v1")
    return data


def leftovers(report: AuditReport) -> list[str]:
    """Notes on files that a crash left behind."""
    return [note for note in report.notes if note.startswith("artefacts/")]


def sweep(data: Path, crash_at: int | None) -> tuple[CrashingFiles, bool]:
    """Record one viewpoint with crashing file operations; returns them, and whether `record` returned."""
    ids = CountedIds()
    ids.count = 100
    files = CrashingFiles()
    with Store.open(data, SteppedClock(), ids, files) as store:
        run = store.find_run("latest")
        files.points.clear()
        files.crash_at = crash_at
        try:
            record_one(store, run)
        except Crash:
            return files, False
    return files, True


@pytest.mark.slow
@pytest.mark.parametrize("power_lost", [False, pytest.param(True, marks=pytest.mark.sweep)])
def test_crash_at_every_point_of_a_record(before: Path, tmp_path: Path, *, power_lost: bool) -> None:
    copy_data(before, tmp_path / "whole")
    points = sweep(tmp_path / "whole", None)[0].points
    journal = [] if is_postgres(before) else ["append", "sync_file"]
    assert [point.split()[1] for point in points[::3]] == [
        "write",
        "make_directory",
        "sync_directory",
        "make_read_only",
        "sync_file",
        "rename",
        "sync_directory",
        *journal,
        "commit",
        *journal[:1],
    ]
    committed_at: list[str] = []
    for index, point in enumerate(points):
        data = tmp_path / f"crash {index}"
        copy_data(before, data)
        files, returned = sweep(data, index)
        assert not returned
        if power_lost:
            files.lose_power()
        report = verify(data)
        assert report.ok, (point, report.first_fault)
        assert report.events in (2, 4), point
        if report.events == 4:
            committed_at.append(point)
            assert not leftovers(report)
        with Store.open(data, SteppedClock(), CountedIds()) as store:
            run = store.find_run("latest")
            if report.events == 2:
                assert len(store.artefacts(run)) == 3
                record_one(store, run)
            assert [event.payload.kind for event in store.events(run)] == [
                "run_started",
                "viewpoint_captured",
                "viewpoint_captured",
                "job_enqueued",
            ]
        assert verify(data).ok
    assert committed_at == ["after commit", *(f"{when} append" for when in ("before", "within", "after") if journal)]


def test_a_commit_that_returned_survives_the_loss_of_power(before: Path, tmp_path: Path) -> None:
    copy_data(before, tmp_path / "data")
    files, returned = sweep(tmp_path / "data", None)
    assert returned
    files.lose_power()
    report = verify(tmp_path / "data")
    assert report.ok
    assert report.events == 4


def test_full_disk_is_a_clear_error_and_leaves_nothing(tmp_path: Path) -> None:
    class FullDisk(DurableFiles):
        full = False

        def sync_file(self, path: Path) -> None:
            if self.full:
                raise OSError(28, "No space left on device", str(path))
            super().sync_file(path)

    files = FullDisk()
    with Store.open(tmp_path, files=files) as store:
        run = start_run(store)
        files.full = True
        with pytest.raises(StoreError, match="No space left") as caught:
            capture(store, run, "v1")
        assert "free space" in caught.value.remedy
        files.full = False
        assert len(list(files_of(tmp_path))) == 2
        capture(store, run, "v1")
    assert leftovers(verify(tmp_path)) == []


WRITER = """
import sys
from pathlib import Path
from service.store.store import Store
from tests.support.record.store import capture
with Store.open(Path(sys.argv[1])) as store:
    run = store.find_run("latest")
    index = 0
    while True:
        capture(store, run, f"v{index}")
        print(index, flush=True)
        index += 1
"""


@pytest.mark.parametrize("lines", [5, 8, 13])
def test_killed_writer_loses_nothing_that_it_reported(tmp_path: Path, lines: int) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], cwd=ROOT_DIR, stdout=subprocess.PIPE
    ) as writer:
        assert writer.stdout is not None
        for _line in range(lines):
            writer.stdout.readline()
        writer.send_signal(signal.SIGKILL)
        reported = lines + len(writer.stdout.read().split())
    report = verify(tmp_path)
    assert report.ok
    assert report.events - 1 in (reported, reported + 1)
    assert len(leftovers(report)) <= 1
    with Store.open(tmp_path) as store:
        capture(store, run, "after")
    assert verify(tmp_path).events == report.events + 1


def test_a_process_that_holds_the_database_for_long_is_waited_for(
    before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A runner stopped because another process was starved while it wrote."""
    monkeypatch.setattr(engine, "BUSY_TIMEOUT_S", 0.1)
    monkeypatch.setattr(postgres, "LOCK_TIMEOUT_S", 0.1)
    data = tmp_path / "data"
    copy_data(before, data)
    with Store.open(data) as store, Store.open(data, patience_s=0.1) as hasty, ThreadPoolExecutor() as pool:
        run = store.find_run("latest")
        with outsider(data) as other:
            other.execute(
                f"SELECT pg_advisory_xact_lock({postgres.WRITERS})" if is_postgres(data) else "BEGIN IMMEDIATE"
            )
            with pytest.raises(StoreError, match=r"lock.*look for one that hangs"):
                record_one(hasty, run)
            count = len(caplog.records)
            recorded = pool.submit(record_one, store, run)
            until(lambda: len(caplog.records) >= count + 3, "it does not say that it waits")
        assert recorded.result(20)[0].payload.kind == "viewpoint_captured"
    assert "another process has held" in caplog.records[-1].message
    assert verify(data).faults == ()


@pytest.mark.parametrize(("folder", "file"), [(0o700, 0o600), (0o755, 0o644), (0o2770, 0o660), (0o777, 0o644)])
def test_what_is_made_is_for_whom_its_folder_is_and_keys_for_their_owner(
    tmp_path: Path, folder: int, file: int
) -> None:
    files = DurableFiles()
    tmp_path.chmod(folder)
    files.make_directory(tmp_path / "keys", private=True)
    files.make_directory(tmp_path / "runs")
    files.write(tmp_path / "key", [b"a", b"b"], private=True)
    files.write(tmp_path / "image", [b"a", b"b"])
    files.append(tmp_path / "log", 0, b"whole")
    files.append(tmp_path / "log", 2, b"o")
    rights = {path.name: path.stat().st_mode & 0o7777 for path in tmp_path.iterdir()}
    assert (rights["keys"], rights["key"]) == (0o700, 0o600)
    assert rights["runs"] == folder & ~0o022 | (0o2070 & folder if folder & 0o2000 else 0)
    assert rights["image"] == rights["log"] == file
    assert ((tmp_path / "image").read_bytes(), (tmp_path / "log").read_bytes()) == (b"ab", b"who")
    with pytest.raises(FileExistsError):  # nothing recorded is ever written over
        files.write(tmp_path / "image", [b"c"])
    files.make_read_only(tmp_path / "image")
    assert (tmp_path / "image").stat().st_mode & 0o777 == file & 0o444
