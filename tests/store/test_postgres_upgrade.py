"""A prepared database is upgraded to a later revision by its owner, whole or not at all, while nobody writes."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path

import psycopg
import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.run_events import StepNote
from service.store.database.database import REVISIONS
from service.store.records import StoreVersionError
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.postgres import OTHER, OWNER, ROLE, Cluster
from tests.support.processes.waiting import until
from tests.support.record.next_version import NEXT, NextVersion
from tests.support.record.outsider import rows
from tests.support.record.store import capture, start_run

pytestmark = [
    pytest.mark.packages("postgresql"),
    pytest.mark.timeout(300),
    pytest.mark.sqlite("begins a server by itself"),
]
# What a schema is made of: the columns in their order, and the rest as the server writes it down.
CATALOGUE = (
    "SELECT c.relname, a.attname, format_type(a.atttypid, a.atttypmod), a.attnotnull, a.attidentity::text, "
    "a.attcollation::regcollation::text, pg_get_expr(d.adbin, d.adrelid), "
    "row_number() OVER (PARTITION BY c.relname ORDER BY a.attnum) FROM pg_attribute AS a "
    "JOIN pg_class AS c ON c.oid = a.attrelid LEFT JOIN pg_attrdef AS d ON (d.adrelid, d.adnum) = (c.oid, a.attnum) "
    "WHERE c.relnamespace = 'public'::regnamespace AND c.relkind = 'r' AND a.attnum > 0 AND NOT a.attisdropped",
    "SELECT conrelid::regclass::text, conname, pg_get_constraintdef(oid) FROM pg_constraint "
    "WHERE connamespace = 'public'::regnamespace",
    "SELECT indexdef FROM pg_indexes WHERE schemaname = 'public'",
    "SELECT tgrelid::regclass::text, tgenabled::text, pg_get_triggerdef(oid) FROM pg_trigger WHERE NOT tgisinternal",
    "SELECT proname, prosrc FROM pg_proc WHERE pronamespace = 'public'::regnamespace",
    "SELECT relname, relowner::regrole::text, grantee::regrole::text, privilege_type FROM pg_class "
    "CROSS JOIN LATERAL aclexplode(coalesce(relacl, acldefault('r', relowner))) "
    "WHERE relnamespace = 'public'::regnamespace AND relkind = 'r'",
)


@pytest.fixture(scope="module")
def following(tmp_path_factory: pytest.TempPathFactory) -> NextVersion:
    return NextVersion(tmp_path_factory.mktemp("next"))


def fill(folder: Path) -> str:
    with Store.open(folder) as store:
        run_id = start_run(store)
        capture(store, run_id, "v1_001")
        checkpoint(store, run_id)
    return run_id


def prepare_with_this_version(cluster: Cluster, database: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["store", "prepare", cluster.url(database, OWNER), "--role", ROLE])
    return done.exit_code, " ".join(done.output.split())


def schema(cluster: Cluster, database: str) -> list[list[tuple[object, ...]]]:
    return [sorted(cluster.run(database, query), key=str) for query in CATALOGUE]


@pytest.mark.slow
def test_a_later_version_upgrades_what_an_earlier_one_has_prepared(
    cluster: Cluster, following: NextVersion, tmp_path: Path
) -> None:
    database, other = cluster.new_database(), cluster.new_database(prepared=False)
    site, lite = cluster.site(tmp_path / "site", database), tmp_path / "lite"
    run_id = fill(site)
    fill(lite)
    before = verify(site).heads

    upgrade = ("store", "prepare", cluster.url(database, OWNER), "--role", ROLE)
    sign = ("audit", "rotate-key", "--reason", "goes on", "--operator", "Ada", "--data")
    audit = ("audit", "verify", "all", "--json", "--data")
    refused, as_another, upgraded, again, fresh, verified, *others = following.run(
        (*audit, site),
        ("store", "prepare", cluster.url(database, OTHER), "--role", ROLE),
        upgrade,
        upgrade,
        ("store", "prepare", cluster.url(other, OWNER), "--role", ROLE),
        (*audit, site),
        (*sign, site),
        (*audit, site),
        (*sign, lite),
        (*audit, lite),
    )
    assert refused[0] == as_another[0] == 1
    assert f"prepared by an earlier version of orthocapture (its revision is {REVISIONS[-1]}" in refused[1]
    assert "store prepare URL-OF-THE-OWNER --role ROLE" in refused[1]
    assert f"the tables belong to the role {OWNER}, and this address names {OTHER}" in as_another[1]
    assert upgraded[0] == 0, upgraded[1]
    assert f"Upgraded from revision {REVISIONS[-1]} to {NEXT}" in upgraded[1]
    assert f"granted to {ROLE}: SELECT, INSERT on inspections" in upgraded[1]
    assert again == (0, f"The database has this version's tables already (revision {NEXT}).")
    assert fresh[0] == 0, fresh[1]
    for status, said in (verified, *others):
        assert status == 0, said
    assert before[run_id] in verified[1]
    assert rows(lite, "SELECT version_num FROM alembic_version") == [(NEXT,)], "the same migration upgrades SQLite"
    assert schema(cluster, database) == schema(cluster, other), "an upgraded database is as a new one"

    for statement in (
        "UPDATE inspections SET size_mm = 1",
        "UPDATE runs SET origin = 'elsewhere'",
        "DELETE FROM inspections",
        "TRUNCATE inspections",
    ):
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            cluster.run(database, statement, role=ROLE)
    cluster.run(database, "INSERT INTO inspections VALUES ((SELECT max(run_id) FROM runs), 1, 0.5)", role=ROLE)
    for statement in ("UPDATE inspections SET size_mm = 1", "DELETE FROM inspections", "TRUNCATE inspections"):
        with pytest.raises(psycopg.errors.RaiseException, match="inspections is append-only"):
            cluster.run(database, statement, role=OWNER)

    with pytest.raises(StoreVersionError, match=f"newer version of orthocapture .*{NEXT}") as raised:
        Store.open(site)
    assert "Install the version that wrote it" in str(raised.value)
    status, said = prepare_with_this_version(cluster, database)
    assert (status, f"its revision {NEXT} is unknown here" in said) == (1, True), said


def test_a_grant_that_is_missing_is_given_again_and_nothing_else_is_changed(cluster: Cluster) -> None:
    database = cluster.new_database()
    whole = schema(cluster, database)
    assert prepare_with_this_version(cluster, database) == (
        0,
        f"The database has this version's tables already (revision {REVISIONS[-1]}).",
    )
    cluster.run(database, f"REVOKE INSERT ON events FROM {ROLE}")
    status, said = prepare_with_this_version(cluster, database)
    assert (status, said.endswith(f"granted to {ROLE}: INSERT on events")) == (0, True), said
    assert schema(cluster, database) == whole


def test_a_database_of_somebody_else_is_left_alone(cluster: Cluster) -> None:
    database = cluster.new_database(prepared=False)
    cluster.run(database, "CREATE TABLE runs (run_id text)")
    status, said = prepare_with_this_version(cluster, database)
    assert (status, "this is not a database of orthocapture" in said) == (1, True), said
    assert len(cluster.run(database, "SELECT 1 FROM pg_tables WHERE schemaname = 'public'")) == 1


@contextmanager
def upgrade_in_its_middle(
    cluster: Cluster, following: NextVersion, database: str
) -> Generator[subprocess.Popen[str]]:
    """Start an upgrade that waits for a reader of a table that it alters, until the block ends."""
    with closing(psycopg.connect(cluster.url(database, ROLE))) as reader:
        reader.execute("SELECT * FROM runs")
        upgrading = following.start("store", "prepare", cluster.url(database, OWNER), "--role", ROLE)
        until(lambda: waits(cluster, "relation") or upgrading.poll() is not None, "the upgrade has altered no table")
        assert upgrading.poll() is None, upgrading.communicate()[0]
        yield upgrading


def waits(cluster: Cluster, kind: str) -> bool:
    asked = f"SELECT count(*) FROM pg_locks WHERE NOT granted AND locktype = '{kind}'"
    return cluster.run("postgres", asked) == [(1,)]


@pytest.mark.slow
def test_a_write_during_an_upgrade_waits_and_is_then_refused_unless_the_upgrade_was_killed(
    cluster: Cluster, following: NextVersion, tmp_path: Path
) -> None:
    database = cluster.new_database()
    site = cluster.site(tmp_path / "site", database)
    run_id = fill(site)
    before = schema(cluster, database)
    refusals: list[StoreVersionError] = []

    def write(store: Store, note: str) -> None:
        try:
            store.record(run_id, [StepNote(step="capture", attempt=1, note=note)], actor="Ada")
        except StoreVersionError as error:
            refusals.append(error)

    with Store.open(site) as store:
        with upgrade_in_its_middle(cluster, following, database) as upgrading:
            writer = threading.Thread(target=write, args=(store, "during one that is killed"))
            writer.start()
            until(lambda: waits(cluster, "advisory"), "the write has not waited")
            upgrading.kill()
            upgrading.communicate()
        writer.join()
        assert refusals == []
        assert schema(cluster, database) == before, "nothing of the upgrade is there"
        assert verify(site).ok

        with upgrade_in_its_middle(cluster, following, database) as upgrading:
            writer = threading.Thread(target=write, args=(store, "during one that succeeds"))
            writer.start()
            until(lambda: waits(cluster, "advisory"), "the write has not waited")
        said = upgrading.communicate()[0]
        writer.join()
        assert upgrading.returncode == 0, said
        (refusal,) = refusals
        assert f"newer version of orthocapture (its revision {NEXT}" in str(refusal)
    assert cluster.run(database, "SELECT count(*) FROM events WHERE kind = 'step_note'") == [(1,)]
