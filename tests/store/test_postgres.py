"""The record in PostgreSQL: the same chains, answers and refusals as in SQLite, on a real server."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import psycopg
import pytest
from sqlalchemy import select, text
from typer.testing import CliRunner

from service.audit.filters import EventFilter
from service.audit.queries import events_page
from service.audit.queries import runs as listed_runs
from service.cli.main import app
from service.core.errors import ComputeError, StoreError
from service.core.records.events import RecordCopied
from service.core.records.run_events import StepNote
from service.store.database.postgres import EVIDENCE
from service.store.database.tables import artefacts, event_facets, events, jobs, metadata
from service.store.durable_effects import Clock
from service.store.records import SITE, LeaseHeldError, NewJob, StoreVersionError
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.forked import run as run_command
from tests.support.processes.postgres import OTHER, OWNER, ROLE, Cluster
from tests.support.processes.waiting import until
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, start_run
from tests.support.rig.rig import command
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs

pytestmark = [
    pytest.mark.packages("postgresql"),
    pytest.mark.timeout(300),
    pytest.mark.sqlite("compares the two databases by itself"),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    made = Cluster()
    made.start()
    yield made
    made.stop()


@pytest.fixture
def site(cluster: Cluster, tmp_path: Path) -> Path:
    return cluster.site(tmp_path / "site")


def fill(folder: Path) -> str:
    """Record a short run with files, a job that is computed and one that waits, and sign it."""
    with Store.open(folder, SteppedClock(), CountedIds()) as store:
        run_id = start_run(store)
        for viewpoint in ("v1_001", "v1_002"):
            capture(store, run_id, viewpoint)
        note = StepNote(step="capture", attempt=1, note="Müller said: A7R-V", data={"lux": 0.1 + 0.2})
        new = [NewJob("detect", "capture", 1, key, {"n": n}) for n, key in enumerate(("a", "b"), 1)]
        store.record(run_id, [note], actor="Ada", jobs=new)
        job = store.claim_job("worker", 60.0)
        assert job is not None
        store.fail_job(job, ComputeError("too dark"), retry=False)
        checkpoint(store, run_id)
        checkpoint(store, SITE)
    return run_id


def heads(folder: Path) -> dict[str, str]:
    return dict(verify(folder).heads)


def test_the_same_acts_give_the_same_chains_as_in_sqlite(site: Path, tmp_path: Path) -> None:
    run_id = fill(site)
    assert fill(tmp_path / "lite") == run_id
    report = verify(site)
    assert report.ok, report.faults
    assert report.heads[run_id] == heads(tmp_path / "lite")[run_id]
    stored: list[list[tuple[object, ...]]] = []
    for folder in (site, tmp_path / "lite"):
        with Store.open(folder) as store, store.database.reading() as connection:
            found: list[tuple[object, ...]] = []
            for table in (events, artefacts, event_facets):
                of_run = select(table).where(table.c.run_id == run_id).order_by(*table.primary_key.columns)
                found += [tuple(row) for row in connection.execute(of_run)]
            stored.append(found)
    assert stored[0] == stored[1], "every number is equal to its last bit"


@pytest.mark.parametrize("q", ["muller", "Müller said", "a7r-v", "A7R-W", "v1_00", "worker too", "dark light", "…"])
def test_a_search_finds_the_same_events_as_in_sqlite(site: Path, tmp_path: Path, q: str) -> None:
    found: list[list[int]] = []
    for folder in (site, tmp_path / "lite"):
        run_id = fill(folder)
        with Store.open(folder) as store, store.database.reading() as connection:
            page = events_page(connection, run_id, EventFilter(q=q))
            found.append([row.seq for row in page.rows])
            assert len(listed_runs(connection)) == 1
    assert found[0] == found[1]


def test_the_programs_role_changes_no_evidence(cluster: Cluster, tmp_path: Path) -> None:
    database = cluster.new_database()
    fill(cluster.site(tmp_path / "site", database))
    for table in EVIDENCE:
        named = f"SELECT attname FROM pg_attribute WHERE attrelid = '{table}'::regclass AND attnum = 1"
        column = cluster.run(database, named)[0][0]
        for statement in (
            f"UPDATE {table} SET {column} = {column}",
            f"DELETE FROM {table}",
            f"TRUNCATE {table} CASCADE",
            f"DROP TABLE {table}",
            f"ALTER TABLE {table} DISABLE TRIGGER ALL",
        ):
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                cluster.run(database, statement, role=ROLE)
    with pytest.raises(psycopg.errors.InsufficientPrivilege):
        cluster.run(database, "SET session_replication_role = replica", role=ROLE)


@pytest.mark.parametrize("table", EVIDENCE)
def test_not_even_the_owner_changes_evidence_by_accident(cluster: Cluster, tmp_path: Path, table: str) -> None:
    database = cluster.new_database()
    fill(cluster.site(tmp_path / "site", database))
    statements = [f"DELETE FROM {table}", f"TRUNCATE {table} CASCADE"]
    if table == "timestamps":  # it has no rows here
        statements = statements[1:]
    for statement in statements:
        with pytest.raises(psycopg.errors.RaiseException, match=r"is append-only: (delete|truncate) refused"):
            cluster.run(database, statement, role=OWNER)


@pytest.mark.parametrize(
    ("role", "grants", "why"),
    [
        (OWNER, (), "owns the table runs"),
        (OTHER, (), "is a superuser"),
        (ROLE, (f"GRANT DELETE ON events TO {ROLE}",), "may DELETE on events"),
        (ROLE, (f"GRANT {OWNER} TO {ROLE}",), "owns the table runs"),
    ],
)
def test_a_role_that_could_change_evidence_is_refused(
    cluster: Cluster, tmp_path: Path, role: str, grants: tuple[str, ...], why: str
) -> None:
    database = cluster.new_database()
    cluster.run(database, "SELECT 1", *grants)
    folder = cluster.site(tmp_path / "site", database, role)
    try:
        with pytest.raises(StoreError, match=why):
            Store.open(folder)
    finally:
        if "GRANT oc_owner" in " ".join(grants):
            cluster.run(database, f"REVOKE {OWNER} FROM {ROLE}")


def test_a_database_that_nobody_prepared_is_refused(cluster: Cluster, tmp_path: Path) -> None:
    folder = cluster.site(tmp_path / "site", cluster.new_database(prepared=False))
    with pytest.raises(StoreVersionError, match="has not been prepared"):
        Store.open(folder)


def test_a_server_that_is_away_is_named_without_the_password(cluster: Cluster, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "site.yaml").write_text(f"database: postgresql://oc:geheim@/none?host={tmp_path}\n")
    with pytest.raises(StoreError, match="the database refused") as raised:
        Store.open(folder)
    assert "geheim" not in str(raised.value)


def test_a_folder_with_a_database_of_its_own_and_another_is_refused(cluster: Cluster, tmp_path: Path) -> None:
    Store.open(tmp_path / "data").close()
    (tmp_path / "data" / "site.yaml").write_text(f"database: {cluster.url(cluster.new_database(), ROLE)}\n")
    for attempt in (lambda: Store.open(tmp_path / "data").close(), lambda: verify(tmp_path / "data")):
        with pytest.raises(StoreError, match="has a database of its own"):
            attempt()


TAMPERED = {
    "an event changed": (
        "SET session_replication_role = replica; UPDATE events SET actor = 'Eve' WHERE seq = 3 AND run_id <> 'site'",
        "event 3",
    ),
    "an event removed": (
        "SET session_replication_role = replica; DELETE FROM events WHERE seq = 4 AND run_id <> 'site'",
        "event",
    ),
    "a trigger switched off": ("ALTER TABLE events DISABLE TRIGGER events_append_only", "the trigger"),
    "a trigger dropped": ("DROP TRIGGER artefacts_no_truncate ON artefacts", "is missing: the evidence could be"),
    "a refusal that refuses nothing": (
        "CREATE OR REPLACE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS $$BEGIN RETURN OLD;END$$",
        "is not the one that this software makes",
    ),
    "a grant": (
        f"GRANT UPDATE ON heads TO {ROLE}; GRANT TRUNCATE ON heads TO {ROLE}",
        f"the role {ROLE} may TRUNCATE",
    ),
    "a column": ("ALTER TABLE events ADD COLUMN note TEXT", "the column note of events is not of this software"),
    "a number of fewer bytes": (
        "ALTER TABLE leases ALTER COLUMN until_utc_s TYPE REAL",
        "the column until_utc_s of leases is not the one",
    ),
    "a rule gone": ("ALTER TABLE events DROP CONSTRAINT events_no_fork", "the constraint events_no_fork of events"),
    "words": (
        "SET session_replication_role = replica; "
        "UPDATE event_words SET words = '''x'':1'::tsvector WHERE position = 2",
        "the words by which auditors search are not the event's",
    ),
    "facets": (
        "SET session_replication_role = replica; UPDATE event_facets SET value = 'x' WHERE name = 'protocol_id'",
        "the index of events does not say what the event says",
    ),
    "a lease on no run": (
        "SET session_replication_role = replica; INSERT INTO leases VALUES ('ghost', 'a', 'b', 1, 'c', 'd', 1, 1)",
        "1 rows of the table leases belong to rows of runs that are not there",
    ),
}


@pytest.mark.parametrize("done", TAMPERED)
def test_what_a_superuser_did_is_found(cluster: Cluster, tmp_path: Path, done: str) -> None:
    statements, said = TAMPERED[done]
    database = cluster.new_database()
    folder = cluster.site(tmp_path / "site", database)
    fill(folder)
    assert verify(folder).ok
    cluster.run(database, *statements.split("; "))
    found = [str(fault) for fault in verify(folder).faults]
    assert any(said in fault for fault in found), found


WRITER = """
import sys
from pathlib import Path
from service.core.records.events import RecordCopied, StepNote
from service.store.store import Store
with Store.open(Path(sys.argv[1]), create=False) as store:
    for n in range(int(sys.argv[3])):
        note = StepNote(step="s", attempt=1, note=f"{sys.argv[4]} {n}")
        store.record(sys.argv[2], [note], actor=sys.argv[4])
        print(n, flush=True)
"""


@pytest.mark.slow
def test_writers_of_one_chain_wait_for_one_another(site: Path) -> None:
    run_id = fill(site)
    command = [sys.executable, "-c", WRITER, str(site), run_id, "40"]
    writers = [subprocess.Popen([*command, name], stdout=subprocess.DEVNULL) for name in ("Ada", "Emmy", "Grace")]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    report = verify(site)
    assert report.ok, report.faults
    with Store.open(site) as store:
        notes = [e.payload.note for e in store.events(run_id) if isinstance(e.payload, StepNote)]
    assert len(notes) == 1 + 3 * 40


def test_every_job_is_claimed_once(site: Path) -> None:
    run_id = fill(site)
    with Store.open(site) as store:
        new = [NewJob("detect", "capture", 1, f"job {n}", {}) for n in range(40)]
        store.record(run_id, [], actor="Ada", jobs=new)
    claimed: list[str] = []

    def work(name: str) -> None:
        with Store.open(site) as store:
            while (job := store.claim_job(name, 60.0)) is not None:
                claimed.append(job.job_id)

    workers = [threading.Thread(target=work, args=(f"worker {n}",)) for n in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(claimed) == len(set(claimed)) == 41, "and the one that fill() left"


@pytest.mark.slow
def test_nothing_that_was_acknowledged_is_lost_when_the_server_dies(tmp_path: Path) -> None:
    cluster = Cluster()
    cluster.start()
    site = cluster.site(tmp_path / "site")
    run_id = fill(site)
    command = [sys.executable, "-c", WRITER, str(site), run_id, "100000", "Ada"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for _ in range(50):
            writer.stdout.readline()
        cluster.kill()
        acknowledged = 50 + len(writer.stdout.read().splitlines())
        assert writer.stderr is not None
        said = writer.stderr.read()
    assert "StoreError" in said
    cluster.start()
    try:
        report = verify(site)
        assert report.ok, report.faults
        with Store.open(site) as store:
            notes = [e.payload.note for e in store.events(run_id) if isinstance(e.payload, StepNote)]
            store.record(run_id, [StepNote(step="s", attempt=1, note="goes on")], actor="Ada")
        assert acknowledged <= len(notes) - 1 <= acknowledged + 1
    finally:
        cluster.stop()


class SetClock(SteppedClock):
    """A clock of another host that was set wrong."""

    def __init__(self, ahead_s: float) -> None:
        super().__init__()
        self._ahead_s = ahead_s

    def utc_s(self) -> float:
        return super().utc_s() + self._ahead_s


def test_leases_are_judged_by_the_servers_clock(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A host whose clock is years away neither takes a job early nor holds one for ever."""
    run_id = fill(site)
    late: Clock = SetClock(-1e9)
    early: Clock = SetClock(+1e9)
    with Store.open(site, early) as here, Store.open(site, late) as there:
        job = here.claim_job("here", 60.0)
        assert job is not None
        with here.lease(run_id, "here", 60.0):
            monkeypatch.setattr("service.store.runs.socket.gethostname", lambda: "another-host")
            assert there.claim_job("there", 60.0) is None
            with pytest.raises(LeaseHeldError):
                there.lease(run_id, "there", 60.0)
            monkeypatch.undo()


def test_positions_have_no_gaps_after_a_transaction_that_failed(site: Path) -> None:
    run_id = fill(site)

    def write_and_fail(store: Store) -> None:
        with store.database.writing() as connection:
            store.append(connection, run_id, [StepNote(step="s", attempt=1, note="z")], actor="Ada")
            raise RuntimeError

    with Store.open(site) as store:
        for _ in range(3):
            with pytest.raises(RuntimeError):
                write_and_fail(store)
        store.record(run_id, [StepNote(step="s", attempt=1, note="good")], actor="Ada")
        with store.database.reading() as connection:
            numbered = text("SELECT position FROM event_index ORDER BY position")
            positions = list(connection.execute(numbered).scalars())
    assert positions == list(range(1, len(positions) + 1))
    assert verify(site).ok


def test_a_connection_in_use_when_the_store_is_closed_is_closed_when_it_is_given_back(
    cluster: Cluster, site: Path
) -> None:
    store = Store.open(site)
    with store.database.reading() as connection:
        server = connection.execute(text("SELECT pg_backend_pid()")).scalar_one()
        store.close()
        assert connection.execute(text("SELECT 1")).scalar_one() == 1
    sessions = f"SELECT 1 FROM pg_stat_activity WHERE pid = {server}"
    until(lambda: not cluster.run("postgres", sessions), "its session has not ended")


def test_the_tables_are_those_of_the_metadata(cluster: Cluster) -> None:
    database = cluster.new_database()
    made = {row[0] for row in cluster.run(database, "SELECT tablename FROM pg_tables WHERE schemaname = 'public'")}
    assert made == {*metadata.tables, "alembic_version", "event_words"}
    assert jobs.name in made


def copied(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["store", "copy", *map(str, arguments), "--operator", "Ada"])
    return result.exit_code, result.output


def rows_of(folder: Path) -> dict[str, list[tuple[object, ...]]]:
    """Every row of the record, but for what the copy added to the site's chain and its place in the queue."""
    with Store.open(folder) as store, store.database.reading() as connection:
        return {
            name: [
                tuple(row)
                for row in connection.execute(select(table).order_by(*table.primary_key.columns))
                if SITE not in tuple(row)
            ]
            for name, table in metadata.tables.items()
            if name not in ("event_index", "leases", "sessions", "control")
        }


def test_a_record_goes_to_postgresql_and_back_with_every_number_the_same(cluster: Cluster, tmp_path: Path) -> None:
    run_id = fill(tmp_path / "lite")
    site, back = cluster.site(tmp_path / "site"), tmp_path / "back"
    for source, target in ((tmp_path / "lite", site), (site, back)):
        status, said = copied(source, target)
        assert (status, "Copied: 1 run, " in said) == (0, True), said
        report = verify(target)
        assert report.ok, report.faults
        assert report.heads[run_id] == verify(tmp_path / "lite").heads[run_id]
    assert rows_of(tmp_path / "lite") == rows_of(site) == rows_of(back)
    with Store.open(back) as store:
        copies = [e.payload for e in store.events(SITE) if isinstance(e.payload, RecordCopied)]
        assert [copy.runs for copy in copies] == [1, 1]
        assert "postgresql" in copies[0].database
        store.record(run_id, [StepNote(step="s", attempt=1, note="goes on")], actor="Ada")
        checkpoint(store, run_id)
    assert verify(back).ok


def test_two_records_are_never_mixed(cluster: Cluster, tmp_path: Path) -> None:
    fill(tmp_path / "lite")
    database = cluster.new_database()
    status, said = copied(tmp_path / "lite", cluster.site(tmp_path / "site", database))
    assert status == 0, said
    for target, why in (
        (tmp_path / "site", "has keys and signatures.jsonl already"),
        (cluster.site(tmp_path / "other", database), "has a record already"),
        (tmp_path / "lite", "has keys and signatures.jsonl already"),
    ):
        before = verify(tmp_path / "site").heads
        status, said = copied(tmp_path / "lite", target)
        assert status == 1
        assert why in " ".join(said.split())
        assert verify(tmp_path / "site").heads == before


def test_a_file_that_the_source_lost_is_told_and_the_rest_is_copied(cluster: Cluster, tmp_path: Path) -> None:
    run_id = fill(tmp_path / "lite")
    with Store.open(tmp_path / "lite") as store:
        lost = next(row.ref.sha256 for row in store.artefacts(run_id) if row.ref.kind == "image")
        store.artefact_path(lost).unlink()
    status, said = copied(tmp_path / "lite", cluster.site(tmp_path / "site"))
    assert status == 1
    assert "a stored file is missing" in " ".join(said.split())
    assert [lost in str(fault) for fault in verify(tmp_path / "site").faults] == [True]


def test_a_database_is_prepared_by_its_owner_with_one_command(cluster: Cluster, tmp_path: Path) -> None:
    database = cluster.new_database(prepared=False)
    command = ["store", "prepare", cluster.url(database, OWNER), "--role", ROLE]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    run_id = fill(cluster.site(tmp_path / "site", database))
    said = CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(tmp_path / "site"), "--json"])
    assert (said.exit_code, run_id in said.output) == (0, True)


@pytest.mark.parametrize("command", [("backup", "copy"), ("rebuild",)])
def test_what_is_sqlites_alone_is_refused_by_name(site: Path, tmp_path: Path, command: tuple[str, ...]) -> None:
    fill(site)
    arguments = [command[0], *(str(tmp_path / name) for name in command[1:])]
    result = CliRunner().invoke(app, ["store", *arguments, "--data", str(site), "--operator", "Ada"][:-2])
    assert result.exit_code == 1
    assert "the record of this site is in PostgreSQL" in " ".join(result.output.split())


HOLDER = """
import sys
from pathlib import Path
from service.store.store import Store
with Store.open(Path(sys.argv[1])) as store:
    print(store.claim_job("this host", 60.0).job_id, flush=True)
    sys.stdin.read()
"""


@pytest.mark.slow
def test_workers_whose_clocks_differ_by_ten_minutes_take_no_job_early(cluster: Cluster, tmp_path: Path) -> None:
    database = cluster.new_database()
    site = cluster.site(tmp_path / "site", database)
    ahead, behind = SteppedClock.from_now(), SteppedClock.from_now()
    ahead.set_utc(600.0)
    behind.set_utc(-600.0)
    with Store.open(site, ahead) as early, Store.open(site, behind) as late:
        new = [NewJob("detect", "capture", 1, key, {}) for key in ("a", "b")]
        early.record(start_run(early), [], actor="runner", jobs=new)
        holder = subprocess.Popen(
            [sys.executable, "-c", HOLDER, str(site)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        with holder:
            assert holder.stdout is not None
            held = holder.stdout.readline().strip()
            other = late.claim_job("host with a clock that is late", 60.0)
            assert other is not None
            assert other.job_id != held
            for store in (early, late):
                assert store.claim_job("host", 60.0) is None
            # On the server, which judges leases, a minute passes.
            cluster.run(database, "UPDATE jobs SET until_utc_s = until_utc_s - 61")
            taken = [store.claim_job("host", 60.0) for store in (early, late)]
            assert {job.job_id for job in taken if job is not None} == {held, other.job_id}
            assert holder.stdin is not None
            holder.stdin.close()


@pytest.mark.slow
def test_a_worker_takes_the_kinds_that_it_is_given(site: Path, tmp_path: Path) -> None:
    camera = camera_of_width(160)
    picture = tmp_path / "view.png"
    assert cv2.imwrite(str(picture), render(slabs(), camera, ring_of_poses(3)[0], 1))
    with Store.open(site) as store:
        run = start_run(store)
        ref = store.put_file(picture, kind="image", media_type="image/png", original_name=picture.name)
        arguments = {
            "camera": dataclasses.asdict(camera),
            "effort": {},
            "images": [{"viewpoint": "view", "sha256": ref.sha256}],
        }
        new = [NewJob(kind, "capture", 1, kind, arguments) for kind in ("match", "features")]
        store.record(run, [], actor="runner", jobs=new)
    worker = ("worker", "--data", str(site), "--until-idle", "--jobs", "1")
    ended = run_command(command(*worker, "--kinds", "features", "--json"), timeout_s=200)
    assert ended.returncode == 0, ended.stderr
    with Store.open(site) as store:
        assert {job.kind: job.state for job in store.jobs(run)} == {"match": "queued", "features": "finished"}
    refused = CliRunner().invoke(app, [*worker, "--kinds", "features,matches"])
    assert refused.exit_code == 1
    assert "no kind of job called 'matches'" in " ".join(refused.output.split())
