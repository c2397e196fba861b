"""Leftovers of crashes are listed and, on request, removed; never anything recorded or about to be recorded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from psutil import boot_time
from sqlalchemy import update

from service.core.records.base import ArtefactRef
from service.core.records.events import LeftoversRemoved
from service.core.records.run_events import SessionStarted
from service.store.database.tables import leases
from service.store.disk_space import USUAL_AGE_S, leftovers, remove_leftovers
from service.store.records import SITE, NewArtefact, NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.waiting import until
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import capture, captured, enqueue, files_of, put_image, start_run
from tests.support.rig.rig import REPOSITORY, orthocapture

HOLDER = """
import sys, time
from pathlib import Path
from service.store.store import Store
with Store.open(Path(sys.argv[1])) as store, store.lease(store.find_run("latest"), "a runner", 30.0):
    print("holds", flush=True)
    time.sleep(60)
"""


def crash_left(store: Store, name: str) -> Path:
    """Store a file whose record never came."""
    return store.artefact_path(put_image(store, name).sha256)


def half_written(data: Path) -> Path:
    part = data / "artefacts" / "tmp" / "0123.part"
    part.write_bytes(b"half")
    return part


def test_leftovers_are_those_that_the_audit_names(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        capture(store, start_run(store), "v1")
        assert leftovers(store, min_age_s=0) == []
        half, whole = half_written(tmp_path), crash_left(store, "v2")
        found = leftovers(store, min_age_s=0)
        notes = [note.split(":")[0] for note in verify(tmp_path).notes if note.startswith("artefacts/")]
    assert [one.path for one in found] == sorted(notes)
    assert {(one.path, one.kind) for one in found} == {
        (str(half.relative_to(tmp_path)), "part"),
        (str(whole.relative_to(tmp_path)), "unrecorded"),
    }


def test_removal_takes_leftovers_alone_and_is_recorded(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
        kept = store.artefact_path(capture(store, run, "v1").sha256)
        half, whole = half_written(tmp_path), crash_left(store, "v2")
        foreign = tmp_path / "artefacts" / "ab" / ("ab" + "0" * 62)
        foreign.parent.mkdir(exist_ok=True)
        foreign.write_bytes(b"not what its name says")
        gone = remove_leftovers(store, actor="Ada", min_age_s=0)
        assert {tmp_path / one.path for one in gone} == {half, whole}
        assert kept.exists()
        assert foreign.exists(), "tampering is for the audit to tell, not for a clean-up to hide"
        foreign.unlink()
        recorded = store.events(SITE)[-1]
        assert recorded.actor == "Ada"
        assert isinstance(recorded.payload, LeftoversRemoved)
        assert recorded.payload.files == {one.path: one.size_bytes for one in gone}
        assert remove_leftovers(store, actor="Ada", min_age_s=0) == []
    report = verify(tmp_path)
    assert report.ok
    assert not [note for note in report.notes if note.startswith("artefacts/")]


def test_what_is_young_stays_also_where_old_bytes_were_stored_again(tmp_path: Path) -> None:
    clock = SteppedClock.from_now()  # the file system's time goes on beside it
    with Store.open(tmp_path, clock) as store:
        start_run(store)
        path = crash_left(store, "v1")
        clock.passed_s = 2 * USUAL_AGE_S
        (old,) = leftovers(store)
        assert old.stays == ""

        def is_newer() -> bool:
            put_image(store, "v1")
            return leftovers(store)[0].written_utc > old.written_utc

        until(is_newer, "the file keeps its old time", every_s=0.002)
        clock.passed_s = 0.0
        since_written_s = clock.utc_s() - datetime.fromisoformat(old.written_utc).timestamp()
        clock.passed_s = USUAL_AGE_S - since_written_s  # when it would be old enough, were it not stored again
        (young,) = leftovers(store)
        assert "younger" in young.stays
        assert remove_leftovers(store, actor="Ada") == []
        assert path.exists()


def test_what_a_runner_at_work_may_still_record_stays(tmp_path: Path) -> None:
    """Whatever the file's age: its lease is older."""
    with Store.open(tmp_path) as store:
        run = start_run(store)
        with subprocess.Popen(
            [sys.executable, "-c", HOLDER, str(tmp_path)], cwd=REPOSITORY, stdout=subprocess.PIPE
        ) as holder:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"holds\n"
            ref = put_image(store, "v1")
            must_stay(store)
            holder.kill()
        assert [one.stays for one in leftovers(store, min_age_s=0)] == [""]
        must_record(store, run, ref)


def test_what_a_worker_at_work_may_still_record_stays(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
        enqueue(store, run, NewJob("register", "capture", 1, "key"), actor="runner")
        assert store.claim_job("a worker", 30.0) is not None
        ref = put_image(store, "v1")
        must_stay(store)
        must_record(store, run, ref)


def test_what_is_young_stays_though_the_clock_was_set_forward(tmp_path: Path) -> None:
    clock = SteppedClock.from_now()
    with Store.open(tmp_path, clock) as store:
        start_run(store)
        crash_left(store, "v1")
        clock.set_utc(2 * USUAL_AGE_S)
        (young,) = leftovers(store)
        assert "may be, younger" in young.stays
        clock.passed_s += USUAL_AGE_S + 60.0
        assert [one.stays for one in leftovers(store)] == [""]
        clock.reboot(600.0)
        assert [one.stays for one in leftovers(store)] == [""]


def test_what_a_runner_may_still_record_stays_though_the_clock_was_set_forward(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The boot, and with it the start of every process, then seems later than the files."""
    later = SimpleNamespace(boot_time=lambda: boot_time() + 3600.0)
    with Store.open(tmp_path, SteppedClock.from_now()) as store:
        run = start_run(store)
        started = SessionStarted(resumed=False, software={}, host="here", pid=1)
        store.record(run, [started], actor="runner")
        with store.lease(run, "a runner", 30.0):
            ref = put_image(store, "v1")
            monkeypatch.setattr("service.store.disk_space.psutil", later)
            must_stay(store)
            must_record(store, run, ref)


def test_what_a_process_on_another_host_may_still_record_stays_though_its_lease_seems_over(tmp_path: Path) -> None:
    """The clock of this host may have been set forward."""
    clock = SteppedClock.from_now()
    with Store.open(tmp_path, clock) as store:
        run = start_run(store)
        lease = store.lease(run, "a runner", 30.0)
        with store.database.writing() as connection:
            connection.execute(update(leases).values(host="another"))
        ref = put_image(store, "v1")
        clock.set_utc(3600.0)
        must_stay(store)
        lease.release()
        assert [one.stays for one in leftovers(store, min_age_s=0)] == [""]
        must_record(store, run, ref)


def must_stay(store: Store) -> None:
    (one,) = leftovers(store, min_age_s=0)
    assert "may still record it" in one.stays
    assert remove_leftovers(store, actor="Ada", min_age_s=0) == []


def must_record(store: Store, run: str, ref: ArtefactRef) -> None:
    """Check that the file is there for its record."""
    store.record(run, [captured(ref, "v1")], actor="camera", artefacts=[NewArtefact(ref, "camera")])
    assert leftovers(store, min_age_s=0) == []
    assert verify(store.database_path.parent).ok


def test_the_command_lists_first_and_removes_when_asked(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
        capture(store, run, "v1")
        path = crash_left(store, "v2")
    before = sorted(files_of(tmp_path))
    listed = orthocapture("store", "gc", "--data", str(tmp_path), "--min-age-min", "0")
    assert "may be removed" in listed.stdout
    assert "add --remove" in listed.stdout
    assert sorted(files_of(tmp_path)) == before
    young = json.loads(orthocapture("store", "gc", "--data", str(tmp_path), "--remove", "--json").stdout)
    assert young["removed"] == []
    assert "younger than 60 minutes" in young["left"][0]["stays"]
    removed = orthocapture("store", "gc", "--data", str(tmp_path), "--remove", "--min-age-min", "0")
    assert removed.returncode == 0, removed.stderr
    assert f"removed: {os.path.relpath(path, tmp_path)}" in removed.stdout
    assert sorted(files_of(tmp_path)) == [file for file in before if file != path]
    assert verify(tmp_path).ok
