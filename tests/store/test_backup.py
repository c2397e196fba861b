"""Backups made during a run: incremental, never partial, restored and verified."""

from __future__ import annotations

import json
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import StoreError
from service.core.records.events import DataRestored
from service.core.records.run_events import ViewpointCaptured
from service.store.backup import BackupFolder, BackupOptions, back_up
from service.store.durable_effects import DurableFiles, RandomIds
from service.store.records import SITE
from service.store.restoring import restore
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.forked import run
from tests.support.record.outsider import rows, tamper
from tests.support.record.store import Crash, CrashingFiles, capture, files_of, start_run
from tests.support.record.tampering import cut
from tests.support.runs.bench_run import record_runs

pytestmark = pytest.mark.sqlite("backups and journal: a server has its own")


def ada(_folder: Path) -> str:
    """The person who restores."""
    return "Ada"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A signed run of three viewpoints."""
    folder = tmp_path / "data"
    with Store.open(folder) as store:
        run = start_run(store)
        for viewpoint in ("v1", "v2", "v3"):
            capture(store, run, viewpoint)
        checkpoint(store, run)
    return folder


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """An unsigned run without viewpoints."""
    folder = tmp_path / "small"
    with Store.open(folder) as store:
        start_run(store)
    return folder


def capture_more(data: Path, *viewpoints: str) -> None:
    with Store.open(data) as store:
        run = store.runs()[-1].run_id
        for viewpoint in viewpoints:
            capture(store, run, viewpoint)
        checkpoint(store, run)


def states(backup: Path) -> list[str]:
    return BackupFolder(backup, DurableFiles(), RandomIds()).states()


def command(*words: object) -> tuple[int, dict[str, Any]]:
    done = CliRunner().invoke(app, [*map(str, words), "--json"])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, json.loads(done.stdout)


def test_a_completed_run_comes_back_and_verifies(tmp_path: Path) -> None:
    record_runs(tmp_path)
    data, backup, restored = tmp_path / "data", tmp_path / "backup", tmp_path / "restored"
    status, made = command("store", "backup", backup, "--data", data)
    assert (status, made["ok"], made["present"]) == (0, True, 0)
    assert made["copied"] == made["state"]["artefacts"] > 4
    status, back = command("store", "restore", backup, restored)
    assert (status, back["ok"], back["lost"], back["faults"]) == (0, True, [], [])
    status, report = command("audit", "verify", "all", "--data", restored)
    assert (status, report["ok"]) == (0, True)
    of_events = "SELECT run_id, seq, sha256 FROM events WHERE run_id != 'site' ORDER BY run_id, seq"
    assert rows(restored, of_events) == rows(data, of_events)
    assert sorted(p.name for p in files_of(restored)) == sorted(p.name for p in files_of(data))
    with Store.open(restored) as store:
        restorations = [e.payload for e in store.events(SITE) if isinstance(e.payload, DataRestored)]
    assert [restoration.state for restoration in restorations] == [made["name"]]


def test_backups_during_a_run_hold_one_moment_of_it_each(tmp_path: Path, data: Path) -> None:
    """A capture at full speed that is signed continuously, with backups beside it."""
    over = threading.Event()

    def go_on() -> None:
        with Store.open(data) as store:
            run = start_run(store)
            number = 0
            while not over.is_set():
                number += 1
                capture(store, run, f"w{number}")
                if number % 3 == 0:
                    checkpoint(store, run)

    runner = threading.Thread(target=go_on)
    runner.start()
    try:
        reports = [back_up(data, tmp_path / "backup") for _ in range(4)]
    finally:
        over.set()
        runner.join()
    assert [report.state.faults for report in reports] == [()] * 4
    assert reports[-1].present >= reports[0].state.artefacts  # only new files were copied
    sizes = [report.state.artefacts for report in reports]
    assert sizes == sorted(sizes)
    assert sizes[-1] > sizes[0]
    for number, report in enumerate(reports):
        back = restore(tmp_path / "backup", tmp_path / f"restored{number}", name=report.name, actor=ada)
        assert back.ok, back.audit.first_fault
        assert verify(tmp_path / f"restored{number}").ok
        with Store.open(tmp_path / f"restored{number}") as store:
            run = store.runs()[-1].run_id
            last = store.events(run)[-1]
            assert isinstance(last.payload, ViewpointCaptured) or report is reports[0]
            assert not store.driven(run)


def test_the_second_backup_copies_only_what_is_new(tmp_path: Path, data: Path) -> None:
    first = back_up(data, tmp_path / "backup")
    before = {p: p.stat().st_mtime_ns for p in files_of(tmp_path / "backup")}
    capture_more(data, "v4")
    second = back_up(data, tmp_path / "backup")
    assert (second.copied, second.present) == (1, first.state.artefacts)
    assert all(p.stat().st_mtime_ns == at for p, at in before.items())
    restore(tmp_path / "backup", tmp_path / "old", name=first.name, actor=ada)
    restore(tmp_path / "backup", tmp_path / "new", actor=ada)
    viewpoints = "SELECT viewpoint FROM artefacts WHERE viewpoint IS NOT NULL ORDER BY viewpoint"
    assert [v for (v,) in rows(tmp_path / "old", viewpoints)] == ["v1", "v2", "v3"]
    assert [v for (v,) in rows(tmp_path / "new", viewpoints)] == ["v1", "v2", "v3", "v4"]


@pytest.mark.slow
def test_killed_or_without_power_at_any_point_no_half_backup_looks_whole(tmp_path: Path, small: Path) -> None:
    counted = CrashingFiles()
    back_up(small, tmp_path / "counted", files=counted)
    points = len(counted.points)
    assert points > 60
    whole = 0
    for point in (*range(2, points - 12, 14), *range(points - 12, points)):
        backup, power = tmp_path / f"backup{point}", point % 2 == 0
        files = CrashingFiles(crash_at=point)
        with pytest.raises(Crash):
            back_up(small, backup, files=files)
        if power:
            files.lose_power()
        for name in states(backup) if backup.exists() else []:
            restore(backup, tmp_path / f"half{point}", name=name, actor=ada)
            assert verify(tmp_path / f"half{point}").ok
            whole += 1
        again = back_up(small, backup)
        assert (again.state.faults, again.copied + again.present) == ((), again.state.artefacts)
        last = BackupFolder(backup, DurableFiles(), RandomIds())
        assert all(last.artefacts.verified_path(path.name) for path in files_of(small))
    assert 0 < whole < 6  # those that died after the last rename


def test_an_interrupted_restoration_is_no_data_folder(tmp_path: Path, small: Path) -> None:
    back_up(small, tmp_path / "backup")
    counted = CrashingFiles()
    restore(tmp_path / "backup", tmp_path / "counted", actor=ada, files=counted)
    for point in range(0, len(counted.points), 6):
        folder = tmp_path / f"restored{point}"
        with pytest.raises(Crash):
            restore(tmp_path / "backup", folder, actor=ada, files=CrashingFiles(crash_at=point))
        try:
            assert verify(folder).ok  # it died after the last rename
        except StoreError as error:
            assert "there is no run data here" in str(error)  # noqa: PT017 - either is right, by the point


def test_a_file_that_the_data_folder_lost_is_told_and_older_backups_stay(tmp_path: Path, data: Path) -> None:
    capture_more(data, "v4")
    back_up(data, tmp_path / "whole")
    image = next(p for p in files_of(data) if p.read_bytes().startswith(b"v2"))
    image.unlink()
    status, made = command("store", "backup", tmp_path / "backup", "--data", data)
    assert status == 1
    assert image.name in made["state"]["faults"][0]
    assert "missing" in made["state"]["faults"][0]
    status, back = command("store", "restore", tmp_path / "backup", tmp_path / "restored")
    assert status == 1
    assert any(image.name in fault for fault in back["faults"])
    # An earlier backup still has the file, and keeps it.
    status, made = command("store", "backup", tmp_path / "whole", "--data", data, "--keep", 1)
    assert (status, len(states(tmp_path / "whole"))) == (0, 1)
    assert command("store", "restore", tmp_path / "whole", tmp_path / "mended")[0] == 0


def test_a_roll_back_of_the_record_is_not_hidden_by_the_backup(tmp_path: Path, data: Path) -> None:
    capture_more(data, "v4")
    run = str(rows(data, "SELECT run_id FROM runs WHERE run_id != 'site'")[0][0])
    tamper(data, *cut(run, 5), *cut(SITE, 5))
    assert not verify(data).ok
    made = back_up(data, tmp_path / "backup", BackupOptions(keep=1))
    assert any("signatures.jsonl" in fault for fault in made.state.faults)


def test_a_copy_that_was_altered_is_found_and_mended(tmp_path: Path, data: Path) -> None:
    backup = tmp_path / "backup"
    back_up(data, backup)
    copy = next(p for p in files_of(backup) if p.read_bytes().startswith(b"v3"))
    copy.chmod(0o644)
    copy.write_bytes(b"v3".ljust(2000, b"\xfe"))
    status, back = command("store", "restore", backup, tmp_path / "restored")
    assert status == 1
    assert [copy.name in line for line in back["lost"]] == [True]
    assert command("store", "backup", backup, "--data", data, "--read-all")[0] == 0
    assert command("store", "restore", backup, tmp_path / "mended")[0] == 0


def test_an_altered_database_is_not_restored(tmp_path: Path, data: Path) -> None:
    made = back_up(data, tmp_path / "backup")
    tamper(tmp_path / "backup" / "states" / made.name, "UPDATE events SET actor = 'Eve' WHERE seq = 2")
    status, answer = command("store", "restore", tmp_path / "backup", tmp_path / "restored")
    assert status == 1
    assert "altered" in answer["error"]["what"]
    assert not (tmp_path / "restored" / "orthocapture.sqlite").exists()


@pytest.mark.slow
def test_a_run_goes_on_in_the_restored_folder(tmp_path: Path) -> None:
    _, begun = record_runs(tmp_path)
    assert command("store", "backup", tmp_path / "backup", "--data", tmp_path / "data")[0] == 0
    restored = tmp_path / "restored"
    assert command("store", "restore", tmp_path / "backup", restored)[0] == 0
    assert command("audit", "rotate-key", "--lost", "--reason", "disk died", "--data", restored)[0] == 0
    resume = [sys.executable, "-m", "service.cli.main", "resume", "latest", "--data", str(restored)]
    done = run(resume, typed="abort the disk died\n", timeout_s=60)
    assert f"Run {begun} is aborted" in done.stdout, done.stderr
    assert command("audit", "verify", "all", "--data", restored)[0] == 0


def test_the_signing_key_leaves_only_when_asked_and_a_restored_run_can_be_signed(tmp_path: Path, data: Path) -> None:
    back_up(data, tmp_path / "without")
    assert not any(b"PRIVATE KEY" in p.read_bytes() for p in (tmp_path / "without").rglob("*") if p.is_file())
    back_up(data, tmp_path / "with", BackupOptions(with_keys=True))
    restore(tmp_path / "with", tmp_path / "restored", actor=ada)
    capture_more(tmp_path / "restored", "v9")
    assert verify(tmp_path / "restored").ok
    restore(tmp_path / "without", tmp_path / "lost", actor=ada)
    with pytest.raises(StoreError, match="signing key is missing"):
        capture_more(tmp_path / "lost", "v9")
    assert command("audit", "rotate-key", "--lost", "--reason", "disk died", "--data", tmp_path / "lost")[0] == 0
    capture_more(tmp_path / "lost", "v10")
    assert verify(tmp_path / "lost").ok
    keys = [*(tmp_path / "restored" / "keys").iterdir(), *(tmp_path / "with").rglob("*.pem")]
    assert len(keys) == 2
    assert {key.stat().st_mode & 0o077 for key in keys} == {0}


def test_what_is_refused(tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    back_up(data, tmp_path / "backup")
    other = tmp_path / "other"
    with Store.open(other) as store:
        start_run(store)
    refused = {
        ("backup", data / "copy", "--data", data): "within its own data folder",
        ("backup", tmp_path / "full", "--data", data): "something other than backups",
        ("backup", tmp_path / "backup", "--data", other): "another data folder",
        ("backup", tmp_path / "new", "--data", tmp_path / "nowhere"): "no run data",
        ("restore", tmp_path / "backup", tmp_path / "full"): "not empty",
        ("restore", tmp_path / "full", tmp_path / "new"): "not a folder of orthocapture backups",
        ("restore", tmp_path / "backup", tmp_path / "new", "--state", "x"): "no backup 'x'",
    }
    for words, why in refused.items():
        status, answer = command("store", *words)
        assert (status, why in answer["error"]["what"]) == (1, True), answer
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage._replace(free=1000))  # a small disk
    status, answer = command("store", "backup", tmp_path / "new", "--data", data)
    assert (status, "GB are free" in answer["error"]["what"]) == (1, True)
    assert states(tmp_path / "new") == []
