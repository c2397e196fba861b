"""The audit finds and names every kind of tampering, and excuses what a crash leaves."""

from __future__ import annotations

import json
import random
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.audit import audit_app
from service.core.errors import OrthocaptureError, StoreError
from service.core.records.run_events import StepNote
from service.store.database.engine import database_path
from service.store.durable_effects import utc_text
from service.store.events import event_sha256
from service.store.records import SITE, NewArtefact, NewJob, UnknownRunError
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import show, verify
from tests.support.record.outsider import outsider, rows, tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, enqueue, start_run

RUN = "20261121-120000-000003"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Seven signed events: run_started, three viewpoints, job_enqueued, job_finished, step_note."""
    folder = tmp_path / "data"
    with Store.open(folder, SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        assert run == RUN
        for viewpoint in ("v1", "v2", "v3"):
            capture(store, run, viewpoint)
        enqueue(store, run, NewJob("registration", "register", 1, "key"), actor="runner")
        job = store.claim_job("worker 1", 10)
        assert job is not None
        ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name="result.json")
        store.finish_job(job, measures={"rms_px": 0.4}, duration_s=1.0, artefacts=[NewArtefact(ref, "worker 1")])
        store.record(run, [StepNote(step="capture", attempt=1, note="end")], actor="runner")
        checkpoint(store, run)
    return folder


def image_path(data: Path, viewpoint: str) -> Path:
    ((sha256,),) = rows(data, f"SELECT sha256 FROM artefacts WHERE viewpoint = '{viewpoint}'")
    return data / "artefacts" / str(sha256)[:2] / str(sha256)


def test_untouched_evidence_verifies(data: Path) -> None:
    seen: list[tuple[int, int]] = []
    report = verify(data, RUN, lambda _what, done, total: seen.append((done, total)))
    assert report.ok
    assert report.first_fault is None
    assert (report.events, report.artefacts, report.files, report.jobs, report.notes) == (7, 6, 6, 1, ())
    assert (report.checkpoints, report.unsigned_events, len(report.key_ids)) == (1, {RUN: 0}, 1)
    assert seen[-1] == (report.bytes_hashed, report.bytes_hashed)
    assert report.heads[RUN] == rows(data, "SELECT sha256 FROM events WHERE seq = 7")[0][0]


SQL_TAMPERING = {
    "payload": (
        3,
        "altered",
        ["UPDATE events SET payload = replace(payload, 'station_1', 'station_2') WHERE seq = 3"],
    ),
    "unreadable payload": (3, "altered", ["UPDATE events SET payload = '{' WHERE seq = 3"]),
    "payload spelt otherwise": (3, "canonical form", ["UPDATE events SET payload = ' ' || payload WHERE seq = 3"]),
    "actor": (2, "altered", ["UPDATE events SET actor = 'Eve' WHERE seq = 2"]),
    "time": (2, "altered", ["UPDATE events SET at_utc = '2026-11-21T13:00:00.000000Z' WHERE seq = 2"]),
    "monotonic time": (2, "altered", ["UPDATE events SET monotonic_s = 1 WHERE seq = 2"]),
    "kind column": (2, "column kind", ["UPDATE events SET kind = 'step_note' WHERE seq = 2"]),
    "event in the middle deleted": (
        3,
        "missing from the chain",
        ["DELETE FROM events WHERE seq = 3", "DELETE FROM artefacts WHERE seq = 3"],
    ),
    "last event deleted": (7, "it was left at event 7", ["DELETE FROM events WHERE seq = 7"]),
    "events exchanged": (
        2,
        "previous_sha256",
        [
            "UPDATE events SET seq = 99 WHERE seq = 2",
            "UPDATE events SET seq = 2 WHERE seq = 3",
            "UPDATE events SET seq = 3 WHERE seq = 99",
        ],
    ),
    "artefact row deleted": (3, "no artefact row", ["DELETE FROM artefacts WHERE seq = 3"]),
    "artefact row's device": (3, "row was altered", ["UPDATE artefacts SET device = 'phone' WHERE seq = 3"]),
    "artefact row's size": (3, "not what the event", ["UPDATE artefacts SET size_bytes = 1999 WHERE seq = 3"]),
    "artefact row moved": (
        3,
        "no artefact row",
        ["UPDATE artefacts SET seq = 7 WHERE seq = 3"],
    ),
    "job state": (6, "is queued", ["UPDATE jobs SET state = 'queued'"]),
    "job arguments": (5, "differs", ["UPDATE jobs SET arguments = '{\"a\":1}'"]),
    "job deleted": (5, "no row", ["DELETE FROM jobs"]),
    "run row deleted": (None, "the run's own row is missing", ["DELETE FROM runs"]),
    "where the chain ends deleted": (None, "where the chain ends is missing", ["DELETE FROM heads"]),
    "run row": (1, "simulated", ["UPDATE runs SET simulated = 0"]),
    "run's time": (1, "was made at", ["UPDATE runs SET created_utc = '2026-11-20T12:00:00.250000Z'"]),
    "job priority": (5, "differs", ["UPDATE jobs SET priority = 0"]),
    "job's beginning": (5, "differs", ["UPDATE jobs SET enqueued_utc = '2026-11-21T12:00:01.250000Z'"]),
    "job's end": (6, "differs", ["UPDATE jobs SET ended_utc = '2026-11-21T12:00:01.250000Z'"]),
    "job's error": (6, "differs", ["UPDATE jobs SET error = 'no memory'"]),
    "row of the index deleted": (3, "missing from the index", ["DELETE FROM event_index WHERE seq = 3"]),
    "row of the index edited": (
        3,
        "does not say what the event says",
        ["UPDATE event_index SET kind = 'step_note' WHERE seq = 3"],
    ),
    "row of the index put elsewhere": (4, "does not say", ["UPDATE event_index SET step = 'x' WHERE seq = 4"]),
    "row of the index invented": (
        8,
        "of an event that is not there",
        [
            f"INSERT INTO event_index (position, run_id, seq, kind, actor) "
            f"SELECT max(position) + 1, '{RUN}', 8, 'run_completed', 'runner' FROM event_index"
        ],
    ),
}


@pytest.mark.parametrize("name", SQL_TAMPERING)
def test_tampering_with_the_database_is_named(data: Path, name: str) -> None:
    seq, said, statements = SQL_TAMPERING[name]
    tamper(data, *statements)
    fault = verify(data).first_fault
    assert fault is not None
    assert (fault.run_id, fault.seq) == (RUN, seq)
    assert said in fault.what


@pytest.mark.parametrize(("second", "said"), [(4.9, 0), (5.1, 1)])
def test_a_run_whose_row_is_a_few_seconds_from_its_first_event_was_made_by_an_older_version(
    data: Path, second: float, said: int
) -> None:
    """It read the clock twice."""
    ((first_utc,),) = rows(data, f"SELECT at_utc FROM events WHERE seq = 1 AND run_id = '{RUN}'")
    row_utc = datetime.fromisoformat(str(first_utc)) - timedelta(seconds=second)
    tamper(data, f"UPDATE runs SET created_utc = '{utc_text(row_utc)}' WHERE run_id = '{RUN}'")
    assert len([fault for fault in verify(data).faults if "that it was made at" in fault.what]) == said


def test_an_altered_row_is_named_with_the_file_that_it_is_about(data: Path) -> None:
    tamper(data, "UPDATE artefacts SET device = 'phone' WHERE seq = 3")
    (fault,) = [fault for fault in verify(data).faults if "row was altered" in fault.what]
    assert (fault.seq, data / fault.file) == (3, image_path(data, "v2"))
    (fault,) = [fault for fault in verify(data, files=False).faults if "row was altered" in fault.what]
    assert (fault.seq, fault.file) == (3, ""), "the files were not read"


def test_event_rewritten_with_its_hash_breaks_the_next_link(data: Path) -> None:
    names = ("seq", "run_id", "at_utc", "monotonic_s", "previous_sha256", "payload")
    (row,) = rows(data, f"SELECT {', '.join(names)} FROM events WHERE seq = 7")
    fields = dict(zip(names, row, strict=True))
    fields |= {"payload": json.loads(str(fields["payload"])), "actor": "Eve"}
    tamper(data, f"UPDATE events SET actor = 'Eve', sha256 = '{event_sha256(fields)}' WHERE seq = 7")
    fault = verify(data).first_fault
    assert fault is not None
    assert "chain ends at event 7" in fault.what
    tamper(data, f"UPDATE events SET sha256 = '{'0' * 63}1' WHERE seq = 4")
    assert [str(fault.seq) for fault in verify(data).faults][:2] == ["4", "5"]


def append_byte(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"!")


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[1000] ^= 1
    path.write_bytes(content)


def point_elsewhere(path: Path) -> None:
    path.rename(path.with_name("copy"))
    path.symlink_to(path.with_name("copy"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (append_byte, "2001 bytes, recorded are 2000"),
        (truncate, "1993 bytes"),
        (flip_bit, "altered"),
        (Path.unlink, "missing"),
        (point_elsewhere, "missing"),
    ],
)
def test_tampering_with_a_file_is_named(data: Path, change: Callable[[Path], None], said: str) -> None:
    path = image_path(data, "v2")
    path.chmod(0o644)
    change(path)
    fault = verify(data).first_fault
    assert fault is not None
    assert (fault.seq, fault.file) == (3, f"artefacts/{path.name[:2]}/{path.name}")
    assert said in fault.what


def test_swapped_files_are_both_found(data: Path) -> None:
    one, other = image_path(data, "v1"), image_path(data, "v3")
    content = one.read_bytes(), other.read_bytes()
    for path, swapped in ((one, content[1]), (other, content[0])):
        path.chmod(0o644)
        path.write_bytes(swapped)
    assert [fault.seq for fault in verify(data).faults] == [2, 4]


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
def test_missing_trigger_is_a_fault(data: Path) -> None:
    with closing(sqlite3.connect(database_path(data))) as connection:
        connection.execute("DROP TRIGGER events_no_update")
    fault = verify(data).first_fault
    assert fault is not None
    assert "events_no_update" in fault.what


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
@pytest.mark.parametrize(
    "statements",
    [
        [
            "DROP TRIGGER events_no_update",
            "CREATE TRIGGER events_no_update BEFORE UPDATE ON events BEGIN SELECT 1; END",
        ],
        ["DROP INDEX jobs_open"],
        ["CREATE TRIGGER forget AFTER INSERT ON events BEGIN DELETE FROM event_index; END"],
    ],
    ids=["trigger that does nothing", "index dropped", "foreign trigger"],
)
def test_a_schema_that_is_not_ours_is_a_fault(data: Path, statements: list[str]) -> None:
    with closing(sqlite3.connect(database_path(data))) as connection:
        for statement in statements:
            connection.execute(statement)
    fault = verify(data).first_fault
    assert fault is not None
    assert "software" in fault.what or "missing" in fault.what


@pytest.mark.sqlite("damages SQLite's file")
def test_an_index_that_finds_nothing_is_a_fault(data: Path) -> None:
    """Emptied under another definition, which is then put back: SQLite's quick_check does not see it."""
    made = "CREATE INDEX jobs_open ON jobs (state, position)"
    for definition, version, last in ((f"{made} WHERE 0", 1001, "REINDEX jobs_open"), (made, 1002, "")):
        with closing(sqlite3.connect(database_path(data), isolation_level=None)) as connection:
            connection.execute("PRAGMA writable_schema = ON")
            connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = 'jobs_open'", (definition,))
            connection.execute(f"PRAGMA schema_version = {version}")
        with closing(sqlite3.connect(database_path(data), isolation_level=None)) as connection:
            connection.execute(last)
    assert rows(data, "PRAGMA quick_check") == [("ok",)]
    assert any("row 1 missing from index jobs_open" in str(fault) for fault in verify(data).faults)


def test_an_account_that_nobody_made_is_a_fault(data: Path) -> None:
    columns = "account, full_name, role, state, password_hash, pin_hash, failures, locked_until_utc_s, created_utc"
    values = "'eve', 'Eve', 'administrator', 'active', 'x', '', 0, 0.0, '2026-11-21T12:00:00.250000Z'"
    with outsider(data) as connection:
        connection.execute(f"INSERT INTO accounts ({columns}) VALUES ({values})")
    fault = verify(data).first_fault
    assert fault is not None
    assert "account eve (administrator) was made by nobody" in fault.what


@pytest.mark.sqlite("damages SQLite's file")
@pytest.mark.slow
def test_no_flipped_bit_ends_in_anything_but_a_report_or_an_error_of_ours(data: Path) -> None:
    path = database_path(data)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    whole = path.read_bytes()
    rng = random.Random(6)
    for _ in range(120):
        flipped = bytearray(whole)
        flipped[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(flipped)
        for left in ("-wal", "-shm"):
            path.with_name(path.name + left).unlink(missing_ok=True)
        with suppress(OrthocaptureError):
            verify(data)


def test_leftovers_of_a_crash_are_notes_and_foreign_files_faults(data: Path) -> None:
    with Store.open(data) as store:
        orphan = store.put_bytes(b"never recorded", kind="image", media_type="image/jpeg", original_name="x.JPG")
    (data / "artefacts" / "tmp" / "abc.part").write_bytes(b"half")
    report = verify(data)
    assert report.ok
    assert len(report.notes) == 2
    assert any(orphan.sha256 in note for note in report.notes)
    (data / "artefacts" / "ab").mkdir(exist_ok=True)
    (data / "artefacts" / "ab" / "notes.txt").write_text("hello")
    fault = verify(data).first_fault
    assert fault is not None
    assert fault.file == "artefacts/ab/notes.txt"


def test_a_store_refuses_to_append_to_a_cut_chain(data: Path) -> None:
    tamper(data, "DELETE FROM events WHERE seq = 7")
    with Store.open(data) as store, pytest.raises(StoreError, match="does not end where it was left"):
        store.record(RUN, [StepNote(step="s", attempt=1, note="n")], actor="Ada")


def test_each_run_is_verified_by_itself(data: Path) -> None:
    with Store.open(data) as store:
        second = start_run(store)
    tamper(data, f"UPDATE events SET actor = 'Eve' WHERE run_id = '{second}'")
    assert verify(data, RUN).ok
    assert not verify(data, second).ok
    assert set(verify(data).runs) == {RUN, second, SITE}
    with pytest.raises(UnknownRunError):
        verify(data, "nothing")


def test_verify_and_show_change_nothing(data: Path) -> None:
    before = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    verify(data)
    records = show(data, RUN)
    assert [record.kind for record in records] == [
        "run_started",
        *["viewpoint_captured"] * 3,
        "job_enqueued",
        "job_finished",
        "step_note",
    ]
    assert [artefact.ref.original_name for artefact in records[1].artefacts] == ["v1.JPG"]
    assert "viewpoint=v1" in records[1].summary
    after = {path: path.read_bytes() for path in data.rglob("*") if path.is_file() and "-" not in path.name}
    assert after == before


@pytest.mark.sqlite("damages SQLite's file")
def test_truncated_database_is_an_error_with_advice(data: Path) -> None:
    path = database_path(data)
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(StoreError) as caught:
        verify(data)
    assert "copy" in caught.value.remedy or "version" in caught.value.remedy


# --- command line ---


def run_cli(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(audit_app, arguments, env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.stdout, result.stderr


def test_cli_verify(data: Path) -> None:
    for name in (RUN, "2026", "latest", "all"):
        status, out, _err = run_cli("verify", name, "--data", str(data))
        assert status == 0
        assert "Verified" in out
    image = image_path(data, "v2")
    image.chmod(0o644)
    append_byte(image)
    status, out, _err = run_cli("verify", "latest", "--data", str(data))
    assert status == 1
    assert f"event 3, artefacts/{image.name[:2]}/{image.name}: the file has 2001 bytes" in out
    status, out, _err = run_cli("verify", "latest", "--json", "--data", str(data))
    assert status == 1
    report = json.loads(out)
    assert (report["ok"], report["first_fault"]["seq"]) == (False, 3)


def test_cli_show(data: Path) -> None:
    status, out, _err = run_cli("show", "2026", "--data", str(data))
    assert status == 0
    for words in ("viewpoint captured", "v2.JPG", "job finished", "Ada"):
        assert words in out
    status, out, _err = run_cli("show", RUN, "--data", str(data), "--json")
    assert status == 0
    shown = json.loads(out)
    assert shown["run"] == RUN
    assert shown["events"][1]["artefacts"][0]["device"] == "camera"


def test_cli_errors_say_what_to_do(data: Path, tmp_path: Path) -> None:
    status, out, err = run_cli("verify", "latest", "--data", str(tmp_path / "nowhere"))
    assert (status, out) == (1, "")
    assert "no run data" in err
    assert "--data DIR" in err
    assert not (tmp_path / "nowhere").exists()
    status, out, _err = run_cli("show", "1999", "--data", str(data), "--json")
    assert status == 1
    assert json.loads(out)["error"]["kind"] == "UnknownRunError"
    assert run_cli("verify", "--wrong")[0] == 2


def test_cli_reads_the_folder_from_the_environment(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ORTHOCAPTURE_DATA", str(data))
    assert run_cli("verify")[0] == 0
    assert "Verify the evidence" in run_cli("verify", "--help")[1]
