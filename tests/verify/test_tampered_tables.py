"""Changed rows beside the chains: words of the search, sign-ins, links, secrets, stamps, jobs."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import pytest

from service.core.errors import StoreError
from service.core.records.run_events import StepNote
from service.people.credentials import token_sha256
from service.people.person import LinkError, NotSignedInError, Person, PinRefusedError, SignInRefusedError
from service.people.sessions import People
from service.store.database.engine import database_path
from service.store.durable_effects import SystemClock
from service.store.records import SITE, NewArtefact, NewJob
from service.store.signatures.log import NAME
from service.store.signatures.signing import checkpoint
from service.store.signatures.timestamps import Authority, timestamp
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, password_of, populate
from tests.support.record.outsider import copy_data, is_postgres, rows, tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import capture, enqueue, start_run
from tests.support.record.time_stamp_authority import time_stamp_authority


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with jobs of every outcome, people of every kind, and a time stamp."""
    folder = tmp_path_factory.mktemp("recorded") / "data"
    with (
        time_stamp_authority(tmp_path_factory.mktemp("authority")) as authority,
        Store.open(folder) as store,
    ):
        people = People(store, QUICK_HASHES)
        populate(people)
        run = start_run(store)
        capture(store, run, "v1")
        for key in ("one", "two"):
            enqueue(store, run, NewJob("registration", "register", 1, key), actor="runner")
        job = store.claim_job("worker 1", 10)
        assert job is not None
        ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name="result.json")
        store.finish_job(job, measures={}, duration_s=1.0, artefacts=[NewArtefact(ref, "worker 1")])
        timestamp(store, checkpoint(store, run), Authority(authority.url, authority.certificates, 30))
        ada = people.person(people.sign_in("ada", password_of("ada")), idle_lock_s=1e9, deliberate=False)
        assert ada is not None
        people.accounts.invite(ada, "marie", "Marie Curie", "technician")
        people.lock(ada)
        checkpoint(store, SITE)
    return folder


@pytest.fixture
def data(recorded: Path, tmp_path: Path) -> Path:
    copy_data(recorded, tmp_path / "data")
    return tmp_path / "data"


def faults(data: Path) -> list[str]:
    return [str(fault) for fault in verify(data).faults]


def run_of(data: Path) -> str:
    ((run,),) = rows(data, "SELECT run_id FROM runs WHERE run_id <> 'site'")
    return str(run)


FORGET = (
    "INSERT INTO event_words (event_words, rowid, words) SELECT 'delete', i.position, words_of(e.actor, e.payload) "
    "FROM events AS e JOIN event_index AS i USING (run_id, seq) WHERE e.kind = 'viewpoint_captured'"
)
ALTERED = {
    "an event that no search finds any more": (FORGET, "event 2: the words by which auditors search are not"),
    "a word that the event does not have": (
        "INSERT INTO event_words (rowid, words) SELECT position, 'no' FROM event_index WHERE kind = 'run_started'",
        "event 1: the words by which auditors search are not the event's",
    ),
    "words of no event": (
        "INSERT INTO event_words (rowid, words) VALUES (999, 'x')",
        "words of an event that is not",
    ),
    "the form of the words": ("UPDATE event_words_config SET v = 3", "the index by which auditors search is damaged"),
    "no words at all": (
        "INSERT INTO event_words (event_words) VALUES ('delete-all')",
        "event 1: the words by which auditors search",
    ),
    "a protocol that no page finds any more": (
        "DELETE FROM event_facets WHERE name = 'protocol_id'",
        "event 1: the index of events does not say what the event says",
    ),
    "another protocol": (
        "UPDATE event_facets SET value = 'other' WHERE name = 'protocol_id'",
        "event 1: the index of events does not say what the event says",
    ),
    "a value that the event does not have": (
        "INSERT INTO event_facets SELECT run_id, seq, 'action', 'abort' FROM events "
        "WHERE kind = 'viewpoint_captured'",
        "event 2: the index of events does not say what the event says",
    ),
    "a value of no event": (
        "INSERT INTO event_facets SELECT run_id, 999, 'action', 'abort' FROM runs WHERE run_id <> 'site'",
        "event 999: the index of events has facets of an event that is not there",
    ),
    "the order of events": (
        "UPDATE event_index SET position = 999 WHERE kind = 'run_started'",
        "its place in the index of events (999) is not that in which it was written",
    ),
    "a row of the index of a run that never was": (
        "INSERT INTO event_index (run_id, seq, kind, actor) VALUES ('ghost', 1, 'run_completed', 'runner')",
        "run ghost, event 1: the index of events has a row of an event that is not there",
    ),
    "a lease on a run that never was": (
        "INSERT INTO leases VALUES ('ghost', 'a', 'b', 1.0, 'c', 'd', 1, 1.0)",
        "row 1 of the table leases belongs to a row of runs that is not there",
    ),
    "a password": (
        "UPDATE accounts SET password_hash = (SELECT password_hash FROM accounts WHERE account = 'grace') "
        "WHERE account = 'emmy'",
        "the password of the account emmy was set past the software",
    ),
    "a PIN": (
        "UPDATE accounts SET pin_hash = 'x' WHERE account = 'emmy'",
        "the PIN of the account emmy was",
    ),
    "a name": ("UPDATE accounts SET full_name = 'Eve' WHERE account = 'emmy'", "emmy has another name or beginning"),
    "when an account was made": (
        "UPDATE accounts SET created_utc = '2020-01-01T00:00:00.000000Z' WHERE account = 'emmy'",
        "emmy has another name or beginning",
    ),
    "a sign-in": (
        "INSERT INTO sessions SELECT 'x', 'emmy', 'EVE234', csrf, created_utc_s, seen_utc_s, 0, 0 FROM sessions",
        "the sign-in of emmy on screen EVE234 is not told by any event",
    ),
    "somebody else's sign-in": ("UPDATE sessions SET token_sha256 = 'x'", "is not the one that its event records"),
    "the lock of a screen": ("UPDATE sessions SET locked = 0", "is not locked; the events say otherwise"),
    "a link": (
        f"INSERT INTO invitations VALUES ('{token_sha256('eve')}', 'emmy', 9e9, 0)",
        "a link for the account emmy is not one that the events record",
    ),
    "a link that was used": (
        "UPDATE invitations SET used = 0 WHERE account = 'grace'",
        "a link for the account grace is valid; the events say otherwise",
    ),
    "a time stamp removed": ("DELETE FROM timestamps", "was removed"),
    "when a time stamp was asked for": ("UPDATE timestamps SET at_utc = 'x'", "it is not the one that was given"),
    "a time stamp that nobody gave": (
        "INSERT INTO timestamps SELECT run_id, seq, 'http://eve', at_utc, token FROM timestamps",
        "time stamp of http://eve: no event records that it was given",
    ),
    "who did a job": ("UPDATE jobs SET worker = 'x' WHERE state = 'finished'", "differs from its event job_finished"),
    "the order of jobs": ("UPDATE jobs SET position = 9 WHERE state = 'finished'", "another place in the queue"),
    "the end of a job that waits": (
        "UPDATE jobs SET ended_seq = 1 WHERE state = 'queued'",
        "queued and has an end",
    ),
}


# The same in PostgreSQL, where the words are rows of a table.
OF_POSTGRES = {
    "an event that no search finds any more": (
        "DELETE FROM event_words USING event_index AS i WHERE i.position = event_words.position "
        "AND i.kind = 'viewpoint_captured'",
        "event 2: the words by which auditors search are not",
    ),
    "a word that the event does not have": (
        "UPDATE event_words SET words = words || CAST('no' AS tsvector) FROM event_index AS i "
        "WHERE i.position = event_words.position AND i.kind = 'run_started'",
        "event 1: the words by which auditors search are not the event's",
    ),
    "words of no event": ("INSERT INTO event_words VALUES (999, 'x')", "words of an event that is not"),
    "no words at all": ("DELETE FROM event_words", "event 1: the words by which auditors search"),
    "a row of the index of a run that never was": (
        "INSERT INTO event_index (position, run_id, seq, kind, actor) "
        "VALUES (999, 'ghost', 1, 'run_completed', 'runner')",
        "run ghost, event 1: the index of events has a row of an event that is not there",
    ),
    "a lease on a run that never was": (
        "INSERT INTO leases VALUES ('ghost', 'a', 'b', 1.0, 'c', 'd', 1, 1.0)",
        "1 rows of the table leases belong to rows of runs that are not there",
    ),
}
OF_SQLITE = pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=OF_SQLITE) if name == "the form of the words" else name for name in ALTERED],
)
def test_what_was_put_in_past_the_software_is_named(data: Path, name: str) -> None:
    statement, said = (ALTERED | OF_POSTGRES if is_postgres(data) else ALTERED)[name]
    assert faults(data) == []
    tamper(data, "PRAGMA foreign_keys = OFF", statement)
    assert any(said in fault for fault in faults(data)), faults(data)


@pytest.mark.sqlite("damages SQLite's file")
def test_words_that_are_there_and_cannot_be_found_are_a_fault(data: Path) -> None:
    words = {f"word{i}": f"{i * 7919 % 100_003:x}" for i in range(3000)}  # more than fits into one page of the index
    with Store.open(data) as store:
        store.record(run_of(data), [StepNote(step="s", attempt=1, note="n", data=words)], actor="runner")
    assert faults(data) == []
    tamper(data, "DELETE FROM event_words_idx")
    (fault,) = faults(data)
    assert fault.startswith("orthocapture.sqlite: the index by which auditors search is damaged: a search for")


@pytest.mark.sqlite("damages SQLite's file")
def test_commits_behind_a_damaged_frame_of_the_write_ahead_log_are_missed(data: Path) -> None:
    wal = data / "orthocapture.sqlite-wal"
    with Store.open(data) as store:
        ends = [0]
        for note in ("a", "b", "c"):
            store.record(run_of(data), [StepNote(step="s", attempt=1, note=note)], actor="runner")
            ends.append(wal.stat().st_size)
        whole = wal.read_bytes()
        database = database_path(data).read_bytes()

    def altered(offset: int) -> tuple[list[str], list[str]]:
        database_path(data).write_bytes(database)
        wal.with_name(wal.name.replace("-wal", "-shm")).unlink(missing_ok=True)
        flipped = bytearray(whole)
        if offset >= 0:
            flipped[offset] ^= 1
        wal.write_bytes(flipped)
        report = verify(data)
        of_journal = [fault for fault in report.faults if "journal.jsonl, which has" in fault.what]
        assert len(of_journal) == (offset >= 0)  # even the last commit, which a power cut might have interrupted
        others = [str(fault) for fault in report.faults if fault not in of_journal]
        return others, [note for note in report.notes if "wal" in note]

    assert altered(-1) == ([], [])
    assert altered(ends[1] + 200) == ([f"{wal.name}: 2 commits behind a damaged frame are lost"], [])
    assert altered(ends[1] + 10) == ([f"{wal.name}: 2 commits behind a damaged frame are lost"], [])  # a salt
    assert altered(ends[2] + 200) == (
        [],
        [f"{wal.name}: a commit behind a damaged frame is not read, as after a power cut"],
    )
    assert altered(20) == ([f"{wal.name}: its head is damaged: what was committed last is lost"], [])


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
def test_a_number_of_the_database_that_this_software_never_sets_is_a_fault(data: Path) -> None:
    with closing(sqlite3.connect(database_path(data))) as connection:
        connection.execute("PRAGMA application_id = 7")
    assert faults(data) == ["orthocapture.sqlite: its application_id is 7: this software leaves it 0"]


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_the_number_of_the_journals_line_cannot_be_changed_in_the_database(data: Path) -> None:
    for number, said in ((7, "it holds line 7 of journal.jsonl, which has"), (9999, "it ends at line")):
        with closing(sqlite3.connect(database_path(data))) as connection:
            connection.execute(f"PRAGMA user_version = {number}")
        assert any(said in fault for fault in faults(data))


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
def test_a_trigger_on_another_table_is_not_ours(data: Path) -> None:
    with closing(sqlite3.connect(database_path(data))) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET tbl_name = 'Runs' WHERE name = 'runs_no_update'")
        connection.commit()
    assert any("the trigger runs_no_update is not the one" in fault for fault in faults(data))


@pytest.mark.sqlite("damages SQLite's file")
def test_a_row_that_its_own_table_forbids_is_refused_in_words(data: Path) -> None:
    with closing(sqlite3.connect(database_path(data), isolation_level=None)) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        loose = (
            "UPDATE sqlite_master SET sql = replace(replace(sql, 'NOT NULL', ''), 'STRICT', '') WHERE name = 'heads'"
        )
        connection.execute(loose)
    with closing(sqlite3.connect(database_path(data), isolation_level=None)) as connection:
        connection.execute("UPDATE heads SET run_id = NULL WHERE run_id <> 'site'")
        connection.execute("UPDATE heads SET seq = 'x' WHERE run_id = 'site'")
    try:
        said = "\n".join(faults(data))
    except StoreError as error:
        said = str(error)
    assert "heads" in said


def test_a_link_does_not_give_an_account_in_use_another_password(data: Path) -> None:
    expires_utc_s = SystemClock().utc_s() + 3600.0
    tamper(data, f"INSERT INTO invitations VALUES ('{token_sha256('eve')}', 'emmy', {expires_utc_s}, 0)")
    with Store.open(data) as store, pytest.raises(LinkError, match="not valid"):
        People(store, QUICK_HASHES).accounts.accept("eve", "correct horse eve", PIN)


def test_a_password_that_is_hashed_anew_is_recorded(data: Path) -> None:
    with Store.open(data) as store:
        People(store).sign_in("emmy", password_of("emmy"))
    assert faults(data) == []


def test_text_of_the_log_that_means_the_same_is_still_another_text(data: Path) -> None:
    lines = (data / NAME).read_bytes().splitlines(keepends=True)
    last = lines[-1]
    end = last.index(b'=="}\n')
    letter = last[end - 1 : end]
    alphabet = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    other = alphabet[alphabet.index(letter) ^ 1 : (alphabet.index(letter) ^ 1) + 1]  # the bit has no meaning
    (data / NAME).write_bytes(b"".join([*lines[:-1], last[: end - 1] + other + last[end:]]))
    assert faults(data) == [f"{NAME}, line {len(lines)}: its own signature is not valid"]
    (data / NAME).write_bytes(b"".join([*lines[:-1], last.replace(b'"number":', b'"number": ')]))
    assert any("it is not as it was written" in fault for fault in faults(data))


def test_whatever_people_do_verifies(tmp_path: Path) -> None:
    """Every act on accounts and screens leaves rows that agree with the events."""
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        people = People(store, QUICK_HASHES)
        people.first_link()  # a second link invalidates the first
        populate(people)
        accounts = people.accounts

        def person(account: str, password: str = "") -> Person:
            token = people.sign_in(account, password or password_of(account))
            found = people.person(token, idle_lock_s=1e9, deliberate=False)
            assert found is not None
            return found

        ada, grace = person("ada"), person("grace")
        people.lock(grace)
        people.unlock(grace, PIN)
        accounts.change_pin(grace, "9753")
        accounts.change_password(grace, "another horse altogether")
        accounts.change_role(ada, "lise", "supervisor", "she supervises now")
        accounts.disable(ada, "emmy", "on leave")
        accounts.enable(ada, "emmy", "back again")
        accounts.invite(ada, "marie", "Marie Curie", "technician")
        accounts.accept(accounts.reset(ada, "marie", "the link was lost"), "radium and polonium", PIN)
        accounts.reset(ada, "lise", "she has forgotten it")
        for _ in range(6):
            with suppress(SignInRefusedError):
                people.sign_in("marie", "wrong")
        accounts.end_wait(ada.account, "marie")
        marie = person("marie", "radium and polonium")
        people.lock(marie)
        for _ in range(5):
            with suppress(PinRefusedError, NotSignedInError):
                people.unlock(marie, "0000")
        people.sign_out(person("emmy"))
        clock.passed_s += 13 * 3600.0
        person("emmy")  # the sessions of the morning have ended
        checkpoint(store, SITE)
    assert faults(tmp_path / "data") == []


def rewrite_schema(data: Path, table: str, old: str, new: str) -> None:
    """Change the schema that SQLite reads for a table without SQLite noticing, as a flipped bit does."""
    with closing(sqlite3.connect(database_path(data))) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = replace(sql, ?, ?) WHERE name = ?", (old, new, table))
        connection.commit()


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
@pytest.mark.parametrize(
    ("table", "column"), [("jobs", "position"), ("event_index", "seq"), ("event_index", "run_id")]
)
def test_a_column_with_one_large_letter_is_told(data: Path, table: str, column: str) -> None:
    rewrite_schema(data, table, f"\t{column} ", f"\t{column[:-1]}{column[-1].upper()} ")
    assert any(f"the table {table} is not the one that this software makes" in fault for fault in faults(data))


@pytest.mark.sqlite("damages SQLite's file")
def test_a_text_that_became_bytes_is_told_with_its_place(data: Path) -> None:
    rewrite_schema(data, "sessions", "STRICT", "")
    tamper(data, "UPDATE sessions SET csrf = CAST(csrf AS BLOB)")
    rewrite_schema(data, "sessions", ")\n ", ")\n STRICT")
    assert any("the sign-in of ada on screen" in fault and "not the one" in fault for fault in faults(data))
