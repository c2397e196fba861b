"""The journal: what was recorded is in it before it counts; each of journal and database restores the other."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import StoreError
from service.core.records.events import RecordRebuilt
from service.core.records.run_events import OperatorAction
from service.store.database.engine import DATABASE_NAME, database_path
from service.store.database.tables import metadata
from service.store.durable_effects import DurableFiles, SystemClock
from service.store.journal import (
    DERIVED,
    KEPT,
    NAME,
    PRESENT_STATE,
    STATED_ELSEWHERE,
    Ending,
    JournalLine,
    read_lines,
    read_tail,
)
from service.store.records import SITE, NewJob, RecordDamagedError
from service.store.restoring import RebuildReport, rebuild
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.second_place import JournalCopy, SecondPlace, journal_copy
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.outsider import rows, tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, enqueue, start_run
from tests.support.record.tampering import cut

pytestmark = pytest.mark.sqlite("backups and journal: a server has its own")

WAL = f"{DATABASE_NAME}-wal"
Meddle = Callable[[Path, Path], object]  # with the data folder, and one that holds its files as they were earlier


def lines_of(data: Path) -> list[JournalLine]:
    return [item for item in read_lines(data / NAME) if isinstance(item, JournalLine)]


def faults(data: Path) -> list[str]:
    return [str(fault) for fault in verify(data).faults]


def ada(_folder: Path) -> str:
    return "Ada"


def mended(data: Path) -> RebuildReport:
    """Rebuild, and check that the record verifies afterwards and says what was done."""
    report = rebuild(data, actor=ada)
    assert faults(data) == []
    with Store.open(data) as store:
        (said,) = [e.payload for e in store.events(SITE) if isinstance(e.payload, RecordRebuilt)]
    assert (said.made, said.kept, said.events) == (report.made, report.kept, report.events)
    return report


def written_over(source: Path, target: Path) -> None:
    """As `cp` and `rsync --inplace` do: the file stays the same one."""
    content = source.read_bytes()
    with target.open("r+b") as stream:
        stream.truncate(0)
        stream.write(content)


def moved_into_the_database(data: Path) -> None:
    """Have SQLite move what is in the write-ahead log into the database, as it does from time to time."""
    with closing(sqlite3.connect(data / DATABASE_NAME)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def emptied(path: Path) -> None:
    """As `: >` does."""
    os.truncate(path, 0)


def test_every_row_is_in_the_journal_before_it_is_committed(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []

    class Watching(DurableFiles):
        def commit(self, commit: Callable[[], None]) -> None:
            journalled = [item.rows for item in read_lines(tmp_path / "data" / NAME) if isinstance(item, JournalLine)]
            with closing(sqlite3.connect(f"file:{tmp_path}/data/{DATABASE_NAME}?mode=ro", uri=True)) as other:
                known = other.execute("SELECT 1 FROM sqlite_master WHERE name = 'events'").fetchone()
                count = other.execute("SELECT count(*) FROM events").fetchone()[0] if known else 0
            seen.append((sum(row.table == "events" for line in journalled for row in line), count))
            commit()

    with Store.open(tmp_path / "data", SteppedClock(), CountedIds(), Watching()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        capture(store, run, "v2")
    assert seen == [(0, 0), (1, 0), (2, 1), (3, 2)]
    assert (tmp_path / "data" / NAME).stat().st_mode & 0o777 == 0o600


def test_every_table_is_kept_made_again_or_of_the_moment() -> None:
    named = {*KEPT, *DERIVED, *PRESENT_STATE, *STATED_ELSEWHERE}
    assert named == set(metadata.tables)


MEDDLED: dict[str, Meddle] = {
    "the write-ahead log is cut": lambda data, _: emptied(data / WAL),
    "the database is cut": lambda data, _: emptied(data / DATABASE_NAME),
    "both are written over by older ones": lambda data, old: [
        written_over(old / name, data / name) for name in (DATABASE_NAME, WAL)
    ],
    "the write-ahead log is written over": lambda data, old: written_over(old / WAL, data / WAL),
    "the database is written over by zeros": lambda data, _: (data / DATABASE_NAME).write_bytes(bytes(200_000)),
    "the database is written over by an older one": lambda data, old: written_over(
        old / DATABASE_NAME, data / DATABASE_NAME
    ),
    "an older database replaces it": lambda data, old: os.replace(old / DATABASE_NAME, data / DATABASE_NAME),
    "the database is deleted": lambda data, _: (data / DATABASE_NAME).unlink(),
    "the journal is cut": lambda data, _: emptied(data / NAME),
    "the journal is written over by an older one": lambda data, old: written_over(old / NAME, data / NAME),
    "an older journal replaces it": lambda data, old: os.replace(old / NAME, data / NAME),
    "the journal is deleted": lambda data, _: (data / NAME).unlink(),
}


@pytest.mark.parametrize("how", MEDDLED)
@pytest.mark.parametrize("what", ["capture", "sign", "wait"])
def test_what_is_altered_in_use_is_noticed_at_once_and_restored(tmp_path: Path, how: str, what: str) -> None:
    data, old = tmp_path / "data", tmp_path / "old"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        moved_into_the_database(data)
        capture(store, run, "v1")
        checkpoint(store, run)
        old.mkdir()
        for name in (DATABASE_NAME, WAL, NAME):
            shutil.copyfile(data / name, old / name)
        for number in range(2, 6):
            capture(store, run, f"v{number}")
            if number == 4:
                moved_into_the_database(data)
        MEDDLED[how](data, old)
        acts: dict[str, Callable[[], object]] = {
            "capture": lambda: capture(store, run, "v9"),
            "sign": lambda: checkpoint(store, run),
            "wait": store.database.require_record,
        }
        with pytest.raises(StoreError, match=r"overwritten|cut|removed|replaced|refused") as told:
            acts[what]()
        assert "store rebuild" in told.value.remedy
    if not is_whole(data):  # what SQLite had in memory may have brought everything back at the end
        mended(data)
    with Store.open(data) as store:
        taken = [e.payload.viewpoint for e in store.events(run) if e.payload.kind == "viewpoint_captured"]
    assert taken == ["v1", "v2", "v3", "v4", "v5"]
    assert faults(data) == []


def is_whole(data: Path) -> bool:
    """Whether the folder can be used and verifies."""
    try:
        Store.open(data, create=False).close()
        return not faults(data)
    except StoreError:
        return False


@pytest.mark.parametrize("how", [how for how in MEDDLED if "write-ahead" not in how and "both" not in how])
def test_what_is_altered_at_rest_is_refused_by_writers_and_restored(tmp_path: Path, how: str) -> None:
    data, old = tmp_path / "data", tmp_path / "old"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        checkpoint(store, run)
    old.mkdir()
    for name in (DATABASE_NAME, NAME):
        shutil.copyfile(data / name, old / name)
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        capture(store, run, "v2")
    MEDDLED[how](data, old)
    with pytest.raises(StoreError) as told:
        Store.open(data)
    assert "store rebuild" in told.value.remedy
    report = mended(data)
    assert report.made == ("journal" if "journal" in how else "database")
    assert report.lost == ()
    assert all((data / name).exists() for name in report.kept)
    with Store.open(data) as store:
        assert [e.payload.kind for e in store.events(run)] == ["run_started", *["viewpoint_captured"] * 2]
        capture(store, run, "v3")
    assert faults(data) == []


def test_a_rebuilt_database_holds_every_row_of_the_old_one(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        enqueue(store, run, NewJob("registration", "capture", 1, "one", {"sigma_px": 0.5}), actor="Ada")
        enqueue(store, run, NewJob("registration", "capture", 1, "two", {"sigma_px": 0.5}), actor="Ada")
        job = store.claim_job("worker", 10.0)
        assert job is not None
        store.finish_job(job, measures={"rms_px": 1.0}, duration_s=1.0)
        store.claim_job("worker", 10.0)
        checkpoint(store, run)
    before = {name: rows(data, f"SELECT * FROM {name} ORDER BY 1, 2, 3") for name in (*KEPT, "heads")}
    index = rows(data, "SELECT * FROM event_index ORDER BY position")
    database_path(data).unlink()
    report = rebuild(data, actor=ada)
    kept = (data / "orthocapture.sqlite").stat()
    assert (report.made, report.why, report.lost, kept.st_size > 0) == ("database", "the database is gone", (), True)
    tamper(data, "DELETE FROM events WHERE kind = 'record_rebuilt'")  # what came since
    after = {name: rows(data, f"SELECT * FROM {name} ORDER BY 1, 2, 3") for name in KEPT}
    for name in ("runs", "artefacts", "timestamps", "accounts", "invitations"):
        assert after[name] == before[name], name
    assert [row for row in after["events"] if row in before["events"]] == before["events"]
    assert set(before["checkpoints"]) <= set(after["checkpoints"])
    assert rows(data, "SELECT * FROM event_index ORDER BY position")[: len(index)] == index
    states = rows(data, "SELECT idempotency_key, state, worker FROM jobs ORDER BY position")
    assert states == [
        ("one", "finished", "worker"),
        ("two", "queued", None),
    ]


def test_a_commit_that_did_not_happen_is_no_fault_and_the_next_writer_says_so(tmp_path: Path) -> None:
    data = tmp_path / "data"

    class Refusing(DurableFiles):
        full = False

        def commit(self, commit: Callable[[], None]) -> None:
            if self.full:
                raise OSError(28, "No space left on device")
            super().commit(commit)

    files = Refusing()
    with Store.open(data, SteppedClock(), CountedIds(), files) as store:
        run = start_run(store)
        files.full = True
        with pytest.raises(StoreError, match="No space left"):
            capture(store, run, "v1")
        files.full = False
        assert store.head(run) == 1
        report = verify(data)
        assert report.faults == ()
        assert f"{NAME}: 1 line was never committed; the writer was interrupted" in report.notes
        capture(store, run, "v2")
        capture(store, run, "v3")
    assert [(line.number, line.after) for line in lines_of(data)] == [(1, 0), (2, 1), (3, 1), (4, 3)]
    assert faults(data) == []
    database_path(data).unlink()
    assert mended(data).lost == ()
    with Store.open(data) as store:
        taken = [e.payload.viewpoint for e in store.events(run) if e.payload.kind == "viewpoint_captured"]
    assert taken == ["v2", "v3"]


def test_a_torn_last_line_of_a_power_cut_is_overwritten_by_the_next(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
    whole = (data / NAME).read_bytes()
    for torn in (b'{"after":2,"number":3,"prev', bytes(700)):
        (data / NAME).write_bytes(whole[: whole.rindex(b'{"mark"')] + torn)
        report = verify(data)
        assert report.faults == ()
        assert f"{NAME}: its end is cut off, as after a power cut" in report.notes
        with Store.open(data) as store:
            capture(store, run, f"after {len(torn)}")
        assert verify(data).faults == ()
        whole = (data / NAME).read_bytes()


@pytest.mark.parametrize("line", [1, 2, 4])
def test_an_altered_line_of_the_journal_is_found_by_its_chain(tmp_path: Path, line: int) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        for number in range(3):
            store.record(run, [OperatorAction(action="pause", reason=f"lunch {number}")], actor="Ada")
    pieces = (data / NAME).read_bytes().splitlines(keepends=True)
    pieces[line - 1] = pieces[line - 1].replace(b"Ada", b"Eve")
    (data / NAME).write_bytes(b"".join(pieces))
    assert any(fault.startswith((NAME, "run ")) for fault in faults(data))
    pieces[line - 1] = b""
    (data / NAME).write_bytes(b"".join(pieces))
    assert any(NAME in fault or "journal" in fault for fault in faults(data))
    report = mended(data)
    assert report.made == "journal"
    with Store.open(data) as store:
        assert store.head(run) == 4


def test_an_old_folder_gets_a_journal_with_the_next_write_and_a_note_says_so(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
    (data / NAME).unlink()
    with closing(sqlite3.connect(database_path(data))) as connection:
        connection.execute("PRAGMA user_version = 0")
    assert verify(data).faults == ()
    assert f"there is no {NAME} yet: the next write begins it" in verify(data).notes
    with Store.open(data) as store:
        capture(store, run, "v2")
    report = verify(data)
    assert report.faults == ()
    assert f"{NAME}: 2 events were recorded before the journal was begun" in report.notes
    database_path(data).unlink()
    assert mended(data).events == 3


def test_rows_put_in_past_the_journal_and_rows_taken_out_are_found(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        capture(store, run, "v2")
    shutil.copytree(data, tmp_path / "other")
    tamper(data, *cut(run, 3))
    assert f"run {run}, event 3: the event is in the journal and no longer in the database: it was removed" in faults(
        data
    )
    assert mended(data).restored_events == 1
    tamper(tmp_path / "other", "UPDATE runs SET created_utc = '2026-11-21T12:00:00.000001Z'")
    (fault,) = faults(tmp_path / "other")
    assert fault == f"run {run}: its row of runs is not as it is in the journal: it was altered"


def test_a_database_of_an_older_backup_put_in_by_hand_is_refused_and_brought_up_to_date(tmp_path: Path) -> None:
    data, backup = tmp_path / "data", tmp_path / "backup"
    runner = CliRunner()
    with Store.open(data) as store:
        run = start_run(store)
        capture(store, run, "v1")
    assert runner.invoke(app, ["store", "backup", str(backup), "--data", str(data)]).exit_code == 0
    with Store.open(data) as store:
        capture(store, run, "v2")
    (state,) = (backup / "states").iterdir()
    assert [path.name for path in sorted(state.iterdir())] == [NAME, DATABASE_NAME, "state.json"]
    shutil.copyfile(state / DATABASE_NAME, data / DATABASE_NAME)
    refused = runner.invoke(app, ["audit", "checkpoint", "--data", str(data)])
    assert refused.exit_code == 1
    assert "store rebuild" in refused.output.replace("\n", " ")
    assert runner.invoke(app, ["audit", "verify", "all", "--data", str(data)]).exit_code == 1
    done = runner.invoke(app, ["store", "rebuild", "--data", str(data), "--operator", "Ada", "--json"])
    assert done.exit_code == 0, done.output
    assert {name: json.loads(done.output)[name] for name in ("made", "restored_events", "lost")} == {
        "made": "database",
        "restored_events": 1,
        "lost": [],
    }
    assert runner.invoke(app, ["audit", "verify", "all", "--data", str(data)]).exit_code == 0
    again = runner.invoke(app, ["store", "rebuild", "--data", str(data), "--operator", "Ada"])
    assert "there is nothing to rebuild" in again.output


def test_the_second_place_has_the_journal_too_and_a_lost_folder_comes_back_from_it(tmp_path: Path) -> None:
    data, copy = tmp_path / "data", tmp_path / "share" / "signatures.jsonl"
    copy.parent.mkdir()
    place = SecondPlace.of(data, copy, SystemClock(), DurableFiles())
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        checkpoint(store, run)
        assert place.update() is None
        capture(store, run, "v2")
        checkpoint(store, run)
        assert place.update() is None
        checkpoint(store, SITE)
        assert place.update() is None
    kept = journal_copy(copy)
    assert kept.name == f"signatures.{NAME}"
    assert kept.stat().st_mode & 0o777 == 0o600
    assert (data / NAME).read_bytes().startswith(kept.read_bytes())
    assert verify(data, signatures_copy=copy).faults == ()
    whole = (data / NAME).read_bytes()
    (data / NAME).write_bytes(b"".join(whole.splitlines(keepends=True)[:2]))
    assert any(f"{NAME} ends before line" in str(fault) for fault in verify(data, signatures_copy=copy).faults)
    away = place.update()
    assert away is not None
    assert "is not the beginning of the journal" in away.why
    (data / NAME).unlink()
    database_path(data).unlink()
    with pytest.raises(StoreError, match="there is no journal"):
        rebuild(data, actor=ada)
    report = rebuild(data, actor=ada, journal=kept)
    assert (report.made, report.lost) == ("database", ())
    assert verify(data).faults == ()
    with Store.open(data) as store:
        assert store.head(run) == 3


class Interrupting(DurableFiles):
    """Lets another program act whenever something is about to be appended, if no lock keeps that program waiting."""

    def __init__(self, locked: Path, act: Callable[[], object]) -> None:
        self.locked = locked
        self.act = act

    def append(self, path: Path, offset: int, data: bytes) -> None:
        with self.locked.open("rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                free = False
            else:
                fcntl.flock(stream, fcntl.LOCK_UN)
                free = True
        if free:
            self.act()
        super().append(path, offset, data)


def test_two_programs_that_copy_the_journal_at_once_do_not_spoil_the_copy(tmp_path: Path) -> None:
    data, copy = tmp_path / "data", tmp_path / "copy.jsonl"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        checkpoint(store, run)
        ends: list[int] = []

        def another_program() -> None:
            capture(store, run, f"v{len(ends)}")
            JournalCopy(data, copy, DurableFiles()).bring_up_to_date()
            ends.append(copy.stat().st_size)

        JournalCopy(data, copy, Interrupting(data / LOG_NAME, another_program)).bring_up_to_date()
        assert copy.stat().st_size >= max(ends, default=0), "what one program had copied another took away"
        another_program()
    assert read_tail(copy) is not None
    assert (data / NAME).read_bytes().startswith(copy.read_bytes())


def test_two_stores_of_one_folder_write_one_journal(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as one, Store.open(data, SteppedClock()) as other:
        run = start_run(one)
        for number in range(6):
            capture(one if number % 2 else other, run, f"v{number}")
            one.database.require_record()
            other.database.require_record()
    assert [line.number for line in lines_of(data)] == [1, 2, 3, 4, 5, 6, 7]
    (*_, ending) = read_lines(data / NAME)
    assert isinstance(ending, Ending)
    assert ending.mark is not None
    assert faults(data) == []


def test_what_does_not_touch_the_record_writes_no_line(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        enqueue(store, run, NewJob("registration", "capture", 1, "one"), actor="Ada")
        before = len(lines_of(data))
        with store.lease(run, "runner", 30.0) as lease:
            lease.renew()
        job = store.claim_job("worker", 10.0)
        assert job is not None
        store.renew_job(job, 10.0)
        assert len(lines_of(data)) == before
    assert faults(data) == []


def test_a_folder_whose_database_is_gone_is_not_begun_anew(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store:
        start_run(store)
    database_path(tmp_path / "data").unlink()
    with pytest.raises(RecordDamagedError, match="the database is gone"):
        Store.open(tmp_path / "data")
    assert not database_path(tmp_path / "data").exists()
