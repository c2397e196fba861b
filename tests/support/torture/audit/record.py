"""The attacked record: small but complete, made by the software itself, with its state at every commit."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

from service.audit.findings import correct
from service.core.errors import DataError
from service.core.records.run_events import EvidenceExported, OperatorAction, RunAborted, RunReleased
from service.people.control import Control
from service.people.person import Person, SignInRefusedError
from service.people.sessions import People
from service.rig import load_rig
from service.store.database.engine import database_path
from service.store.durable_effects import DurableFiles, SystemClock
from service.store.journal import NAME as JOURNAL_NAME
from service.store.records import SITE, NewArtefact, NewJob
from service.store.signatures.log import NAME
from service.store.signatures.second_place import SecondPlace, journal_copy
from service.store.signatures.signing import checkpoint, rotate_key
from service.store.signatures.timestamps import Authority
from service.store.store import Store
from service.web.site import record_start
from tests.support.pages.web import PIN, QUICK_HASHES, password_of, populate
from tests.support.record.time_stamp_authority import time_stamp_authority
from tests.support.runs.bench_run import PROTOCOL, begin_run

COPY = "second_place.jsonl"
WAL_NAME = "orthocapture.sqlite-wal"


@dataclass(frozen=True, slots=True)
class State:
    """The files on the disk right after a commit."""

    database: bytes
    log: bytes | None
    copy: bytes | None
    journal: bytes | None
    journal_copy: bytes | None


@dataclass(frozen=True, slots=True)
class Record:
    """A finished record.

    Attributes:
        folder: holds data/ and the signature copy; nothing has it open.
        run_id: of the run that is complete, corrected and released.
        states: after every commit, oldest first; the last one is the current state.
        with_wal: the database, its write-ahead log, the log of signatures and the journal as left by a crash, some
            commits before the end.
        keys: PEM of every key that signed, oldest first; only the last one's file still exists.
    """

    folder: Path
    run_id: str
    states: tuple[State, ...]
    with_wal: tuple[bytes, bytes, bytes, bytes]
    keys: tuple[bytes, ...]

    @property
    def data(self) -> Path:
        """The data folder."""
        return self.folder / "data"

    @property
    def copy(self) -> Path:
        """The second copy of the signature log."""
        return self.folder / COPY

    @property
    def journal(self) -> Path:
        """The journal."""
        return self.data / JOURNAL_NAME

    @property
    def journal_copy(self) -> Path:
        """The second copy of the journal."""
        return journal_copy(self.copy)


@dataclass
class _Keeping(DurableFiles):
    """The store's file operations; keeps a copy of the files after every commit."""

    folder: Path
    states: list[State] = field(default_factory=list[State])

    def commit(self, commit: Callable[[], None]) -> None:
        """Commit, then copy the files."""
        commit()
        self.states.append(state_of(self.folder))


def state_of(folder: Path) -> State:
    """Read the files in their current state."""
    with closing(sqlite3.connect(database_path(folder / "data"))) as connection:
        database = connection.serialize()
    named = folder / "data" / NAME, folder / COPY, folder / "data" / JOURNAL_NAME, journal_copy(folder / COPY)
    return State(database, *map(_content, named))


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def make_record(folder: Path) -> Record:
    """Record two ended runs, an open one, jobs of every outcome, people, a correction, a release, a stamp, keys."""
    folder.mkdir(parents=True)
    files = _Keeping(folder)
    with time_stamp_authority(folder / "tsa") as authority, Store.open(folder / "data", files=files) as store:
        people = People(store, QUICK_HASHES)
        _start(store, folder, people)
        run_id = _complete_run(store, folder, Authority(authority.url, authority.certificates, 10.0))
        _people_act(store, people, run_id)
        (first_key,) = (folder / "data" / "keys").glob("*.pem")
        first = first_key.read_bytes()
        rotate_key(store, reason="yearly", actor="ada")
        _keep(folder)
        _aborted_run(store, folder)
        _open_run(store, folder, people)
        with_wal = _with_wal(folder)
    (key,) = (folder / "data" / "keys").glob("*.pem")
    record = Record(folder, run_id, (*files.states, state_of(folder)), with_wal, (first, key.read_bytes()))
    shutil.rmtree(folder / "tsa")
    put_back(record)
    return record


def put_back(record: Record) -> None:
    """Restore the record's final state."""
    put(record, record.states[-1])


def put(record: Record, state: State) -> None:
    """Restore a state of the record's files; None means that the file does not exist."""
    for left in record.data.glob("orthocapture.sqlite-*"):
        left.unlink()
    database_path(record.data).write_bytes(state.database)
    for path, content in (
        (record.data / NAME, state.log),
        (record.copy, state.copy),
        (record.journal, state.journal),
        (record.journal_copy, state.journal_copy),
    ):
        if content is None:
            path.unlink(missing_ok=True)
        elif not path.exists() or path.read_bytes() != content:
            path.write_bytes(content)


def _keep(folder: Path) -> None:
    """Bring the second place up to date."""
    away = SecondPlace.of(folder / "data", folder / COPY, SystemClock(), DurableFiles()).update()
    if away is not None:
        raise DataError("the second place of the record that is to be attacked is not up to date", where=away.why)


def _start(store: Store, folder: Path, people: People) -> None:
    rig = folder / "rig.yaml"
    rig.write_text("name: bench\nsimulated: true\ndevices: {}\n")
    protocol = folder / "bench.yaml"
    protocol.write_text(PROTOCOL)
    record_start(store, load_rig(rig), [protocol], "http://127.0.0.1:8000")
    populate(people)


def _complete_run(store: Store, folder: Path, authority: Authority) -> str:
    bench = begin_run(store, PROTOCOL.replace("count: 4", "count: 3"), folder)
    bench.second_place = SecondPlace.of(folder / "data", folder / COPY, store.clock, store.files)
    bench.authority = authority
    _jobs(store, bench.run_id)
    if bench.run().status != "completed":
        raise DataError("the run that is to be attacked did not complete", where=bench.run_id)
    *_, end = (e for e in store.events(bench.run_id) if e.payload.kind == "run_completed")
    correct(store, bench.run_id, of_seq=1, field="operator", new="Ada L.", reason="her name", actor="emmy")
    released = RunReleased(meaning="reviewed and released", signed_sha256=end.sha256)
    store.record(bench.run_id, [released], actor="lise")
    exported = EvidenceExported(
        what="bundle", file_name="b.zip", sha256="0" * 64, size_bytes=1, head_sha256=end.sha256
    )
    store.record(bench.run_id, [exported], actor="lise")
    checkpoint(store, bench.run_id)
    _keep(folder)
    return bench.run_id


def _jobs(store: Store, run_id: str) -> None:
    """Add a job that finished with a file, one that failed after retries, and one that is waiting."""
    for key in ("one", "two", "three"):
        job = NewJob("registration", "capture", 1, key, {"sigma_px": 0.5})
        store.record(run_id, [], actor="runner", jobs=[job])
    job = store.claim_job("worker 1", 10.0)
    assert job is not None
    answer = store.put_bytes(
        json.dumps({"rms_px": 0.4}).encode(), kind="result", media_type="application/json", original_name="r.json"
    )
    store.finish_job(job, measures={"rms_px": 0.4}, duration_s=1.0, artefacts=[NewArtefact(answer, "worker 1")])
    for retry in (True, False):
        job = store.claim_job("worker 1", 10.0)
        assert job is not None
        store.fail_job(job, DataError("too few outlines"), retry=retry)


def _person(people: People, account: str) -> Person:
    person = people.person(people.sign_in(account, password_of(account)), idle_lock_s=1e9, deliberate=False)
    assert person is not None
    return person


def _people_act(store: Store, people: People, run_id: str) -> None:
    """Record a refused password, a changed PIN and role, an open invitation, and a locked and an open screen."""
    administrator = _person(people, "ada")
    people.accounts.invite(administrator, "marie", "Marie Curie", "technician")
    people.accounts.change_role(administrator, "lise", "supervisor", "she supervises now")
    with suppress(SignInRefusedError):
        people.sign_in("grace", "wrong password")
    grace = _person(people, "grace")
    people.accounts.change_pin(grace, PIN[::-1])
    people.lock(grace)
    people.sign_out(administrator)
    checkpoint(store, SITE)
    checkpoint(store, run_id)


def _aborted_run(store: Store, folder: Path) -> None:
    bench = begin_run(store, PROTOCOL, folder)
    store.record(bench.run_id, [RunAborted(reason="the specimen was dropped")], actor="Ada")
    checkpoint(store, bench.run_id)
    _keep(folder)


def _open_run(store: Store, folder: Path, people: People) -> None:
    """Add an open run that was signed once and continued; its lease and control are those of a killed runner."""
    bench = begin_run(store, PROTOCOL, folder)
    Control(store).take(bench.run_id, _person(people, "emmy"))
    store.lease(bench.run_id, "runner", 1.0)
    store.record(bench.run_id, [], actor="runner", jobs=[NewJob("registration", "capture", 1, "four")])
    store.claim_job("worker 2", 1.0, run_id=bench.run_id)
    # From here on commits stay in the write-ahead log: a signature, and one event after it.
    with closing(sqlite3.connect(database_path(folder / "data"))) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    checkpoint(store, bench.run_id)
    _keep(folder)
    store.record(bench.run_id, [OperatorAction(action="pause", reason="lunch")], actor="emmy")


def _with_wal(folder: Path) -> tuple[bytes, bytes, bytes, bytes]:
    data = folder / "data"
    database, wal, log, journal = (
        path.read_bytes() for path in (database_path(data), data / WAL_NAME, data / NAME, data / JOURNAL_NAME)
    )
    return database, wal, log, journal
