"""Events: canonical form, chain, append-only tables, migrations, several processes at once."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import rfc8785
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import create_engine, text

from service.core.errors import IntegrityError, StoreError
from service.core.records.run_events import ActionRefused, JobEnqueued, StepNote
from service.store.database import engine as database
from service.store.database import new_schema
from service.store.database.database import REVISIONS, migrate
from service.store.database.engine import database_path
from service.store.database.tables import metadata
from service.store.events import ROOT, canonical, canonical_parsed, event_sha256, parse_canonical
from service.store.records import NewArtefact, StoreVersionError, UnknownRunError
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.new_schema import migrated_statements, module_text
from tests.support.record.outsider import rows, tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, captured, put_image, start_run

ROOT_DIR = Path(__file__).parents[2]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data", SteppedClock(), CountedIds()) as opened:
        yield opened


def note(text: str, **data: object) -> StepNote:
    return StepNote(step="capture", attempt=1, note=text, data=data)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53) + 1, 2**53 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.parametrize(("text", "of"), [("12", int), ("-9007199254740991", int), ("9007199254740992", float)])
def test_numbers_without_a_point_are_integers_as_far_as_every_reader_has_them(text: str, of: type) -> None:
    assert type(parse_canonical(text)) is of


def test_what_was_parsed_is_written_in_order_and_not_at_all_where_a_number_is_none() -> None:
    assert canonical_parsed({"b": 1, "a": [True]}) == '{"a":[true],"b":1}'
    for number in (math.nan, math.inf):
        with pytest.raises(StoreError):
            canonical_parsed({"a": number})


@given(JSON)
@settings(deadline=None)
def test_canonical_json_survives_reading_back(value: object) -> None:
    text = canonical(value)
    assert canonical(parse_canonical(text)) == text
    assert parse_canonical(text) == value
    assert canonical_parsed(parse_canonical(text)) == text
    assert json.loads(text, parse_int=float) == value  # as read by any JSON parser that uses doubles


@pytest.mark.parametrize(
    "value",
    [
        1e16,
        1e21,
        1e-5,
        1e-7,
        12.5e-6,
        100.0,
        -0.0,
        5e-324,
        2.0**70,
        0.1,
        123456789.125,
        "1.0",
        "2e-5",
        '\x7f\x1f/\\"',
    ],
)
def test_the_quick_way_writes_numbers_and_text_as_the_standard_says(value: float | str) -> None:
    for whole in (value, {"é": [value, "\ue000"], "z": value, "\U0001f9b4": {"\ue000": value, "\U00010000": 1}}):
        assert canonical_parsed(whole) == canonical(whole)


def test_hash_is_sha256_of_rfc_8785_over_all_other_fields(store: Store) -> None:
    run = start_run(store)
    (event,) = store.record(run, [note("µ", x=1e20, y=-0.0, z=[1.0, 2.5])], actor="Ada")
    fields = event.model_dump(mode="json")
    del fields["sha256"]
    assert event.sha256 == hashlib.sha256(rfc8785.dumps(fields)).hexdigest() == event_sha256(fields)
    assert event.at_utc == "2026-11-21T12:00:00.250000Z"
    assert event.monotonic_s == 1000.0


def test_events_link_and_read_back_equal(store: Store) -> None:
    run = start_run(store)
    appended = store.record(run, [note("a"), note("b", q=0.1 + 0.2)], actor="Ada")
    ref = put_image(store, "v1")
    appended += store.record(run, [captured(ref, "v1")], actor="camera", artefacts=[NewArtefact(ref, "camera")])
    events = store.events(run)
    assert events[1:] == appended
    assert [event.seq for event in events] == [1, 2, 3, 4]
    assert [event.previous_sha256 for event in events] == [ROOT, *(event.sha256 for event in events[:-1])]
    assert store.events(run, after_seq=3) == appended[-1:]
    assert events[-1].payload == captured(ref, "v1")


@pytest.mark.parametrize(
    ("value", "said"),
    [(float("nan"), "nan"), (float("inf"), "inf"), (2**60, "safe integer"), (object(), "plain")],
)
def test_what_has_no_canonical_form_is_refused_and_nothing_is_written(store: Store, value: object, said: str) -> None:
    run = start_run(store)
    with pytest.raises(StoreError, match=said):
        store.record(run, [note("good"), note("bad", x={"y": [value]})], actor="Ada")
    assert len(store.events(run)) == 1
    assert verify(store.database_path.parent).ok


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
@pytest.mark.parametrize("table", ["runs", "events", "artefacts", "checkpoints", "timestamps", "event_index"])
def test_tables_refuse_update_delete_and_replace(store: Store, table: str) -> None:
    run = start_run(store)
    capture(store, run, "v1")
    signed = checkpoint(store, run)
    with closing(sqlite3.connect(store.database_path)) as outsider:
        outsider.execute(
            "INSERT INTO timestamps VALUES (?, ?, 'http://localhost', ?, '')", (run, signed.seq, signed.at_utc)
        )
        outsider.commit()
        for statement in (
            f"UPDATE {table} SET run_id = 'x'",
            f"DELETE FROM {table}",
            f"INSERT OR REPLACE INTO {table} SELECT * FROM {table}",
        ):
            with pytest.raises(sqlite3.IntegrityError, match=f"{table} is append-only"):
                outsider.execute(statement)
    of_stamp = "time stamp", "its row of timestamps"
    faults = [fault.what for fault in verify(store.database_path.parent).faults]
    assert [what for what in faults if not what.startswith(of_stamp)] == []


def moved_away(path: Path) -> None:
    for each in path.parent.glob(path.name + "*"):
        each.rename(each.with_name("gone-" + each.name))


def replaced_by_a_copy(path: Path) -> None:
    copy = path.with_name("copy")
    shutil.copy(path, copy)
    copy.replace(path)


def its_log_removed(path: Path) -> None:
    path.with_name(path.name + "-wal").unlink()


@pytest.mark.sqlite("damages SQLite's file")
@pytest.mark.parametrize("change", [moved_away, replaced_by_a_copy, its_log_removed])
def test_a_database_that_is_taken_away_in_use_stops_the_run_loudly(
    tmp_path: Path, change: Callable[[Path], None]
) -> None:
    with Store.open(tmp_path / "data", SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        change(database_path(tmp_path / "data"))
        with pytest.raises(StoreError, match=r"was (removed|replaced) while it was in use"):
            capture(store, run, "v2")
        assert len(list((tmp_path / "data" / "artefacts").rglob("*"))) > 3, "the image lies there all the same"


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
def test_database_is_durable_and_strict(store: Store) -> None:
    data = store.database_path.parent
    assert rows(data, "PRAGMA journal_mode") == [("wal",)]
    strict = {name for (name,) in rows(data, "SELECT name FROM pragma_table_list WHERE strict")}
    assert strict == set(metadata.tables)
    with store._database.writing() as connection:  # pyright: ignore[reportPrivateUsage]  # the pragmas are a connection's
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar() == 2
        assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1


@pytest.mark.sqlite("SQLite's schema; tests/store/test_postgres.py alters PostgreSQL's")
def test_migrations_make_the_tables_of_the_metadata(store: Store) -> None:
    engine = create_engine(f"sqlite:///{store.database_path}")
    with engine.connect() as connection:
        # The full-text index has tables of its own, which SQLAlchemy does not know.
        options = {"include_name": lambda name, kind, _parent: kind != "table" or not name.startswith("event_words")}
        assert compare_metadata(MigrationContext.configure(connection, opts=options), metadata) == []
    engine.dispose()


def test_a_new_database_is_what_the_migrations_make() -> None:
    migrated = create_engine("sqlite://")
    with migrated.begin() as connection:
        migrate(connection)
        assert database.read_schema(connection) == database.fresh_schema()
        made_by = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one()
        assert made_by == REVISIONS[-1]
    migrated.dispose()
    statements = migrated_statements()
    assert statements == new_schema.STATEMENTS
    assert Path(new_schema.__file__).read_text("utf-8") == module_text(statements)


def test_opening_prints_nothing_and_needs_no_ini(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    Store.open(tmp_path / "new" / "deep").close()
    Store.open(tmp_path / "new" / "deep").close()
    assert capfd.readouterr() == ("", "")


def test_the_known_revisions_are_those_of_the_migrations() -> None:
    config = Config()
    config.set_main_option("script_location", "service.store.database:migrations")
    config.set_main_option("path_separator", "os")
    scripts = ScriptDirectory.from_config(config).walk_revisions()
    assert tuple(reversed([script.revision for script in scripts])) == REVISIONS


def test_newer_database_is_refused_unchanged(tmp_path: Path) -> None:
    Store.open(tmp_path).close()
    tamper(tmp_path, "UPDATE alembic_version SET version_num = '9999'")
    for attempt in (lambda: Store.open(tmp_path), lambda: verify(tmp_path)):
        with pytest.raises(StoreVersionError, match=r"(newer|another) version .*9999"):
            attempt()
    assert rows(tmp_path, "SELECT version_num FROM alembic_version") == [("9999",)]


@pytest.mark.sqlite("damages SQLite's file")
def test_foreign_and_broken_databases_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    database_path(tmp_path / "a").write_bytes(b"not a database at all" * 100)
    with pytest.raises(StoreError, match="not a database"):
        Store.open(tmp_path / "a")
    (tmp_path / "b").mkdir()
    with closing(sqlite3.connect(database_path(tmp_path / "b"))) as other:
        other.execute("CREATE TABLE mine (x)")
    with pytest.raises(StoreVersionError, match="not a database of orthocapture"):
        Store.open(tmp_path / "b")
    with pytest.raises(StoreError, match="no run data"):
        Store.open(tmp_path / "c", create=False)
    assert not (tmp_path / "c").exists()


def test_runs_are_found_by_beginning_and_latest(tmp_path: Path) -> None:
    clock = SteppedClock()
    with Store.open(tmp_path, clock, CountedIds()) as store:
        with pytest.raises(UnknownRunError, match="no run in this data folder"):
            store.find_run("latest")
        first = start_run(store)
        clock.passed_s = 60
        second = start_run(store, simulated=False)
        assert [(run.run_id, run.simulated) for run in store.runs()] == [(first, True), (second, False)]
        assert store.find_run("latest") == second
        assert store.find_run("20261121-120000") == first
        with pytest.raises(UnknownRunError, match="beginning of 2 runs"):
            store.find_run("2026")
        with pytest.raises(UnknownRunError, match="no run is called"):
            store.find_run("x")
        with pytest.raises(UnknownRunError):
            store.record("x", [note("a")], actor="Ada")


def test_artefacts_and_events_must_belong_together(store: Store) -> None:
    run = start_run(store)
    ref = put_image(store, "v1")
    with pytest.raises(StoreError, match="not recorded"):
        store.record(run, [captured(ref, "v1")], actor="camera")
    with pytest.raises(StoreError, match="no event of this record refers"):
        store.record(run, [note("a")], actor="camera", artefacts=[NewArtefact(ref, "camera")])
    refused = ActionRefused(action="skip", step=None, why="no")
    job = JobEnqueued(job="j", job_kind="k", step="s", attempt=1, idempotency_key="x", arguments={})
    assert len(store.record(run, [refused], actor="Ada")) == 1
    with pytest.raises(StoreError, match="store itself"):
        store.record(run, [job], actor="Ada")
    store.artefact_path(ref.sha256).unlink()
    with pytest.raises(IntegrityError, match="missing"):
        store.record(run, [captured(ref, "v1")], actor="camera", artefacts=[NewArtefact(ref, "camera")])
    assert [event.payload.kind for event in store.events(run)] == ["run_started", "action_refused"]
    assert len(store.artefacts(run)) == 2


def test_artefact_rows_say_where_the_file_came_from(store: Store) -> None:
    run = start_run(store)
    ref = put_image(store, "v1")
    new = NewArtefact(ref, "camera", "capture", 1, "v1", "Ada", "2026-11-21T11:59:59.000000Z", 3.5)
    store.record(run, [captured(ref, "v1")], actor="camera", artefacts=[new])
    row = store.artefacts(run)[-1]
    assert (row.ref, row.device, row.step, row.attempt, row.viewpoint) == (ref, "camera", "capture", 1, "v1")
    assert (row.who, row.at_utc, row.monotonic_s, row.seq) == ("Ada", "2026-11-21T11:59:59.000000Z", 3.5, 2)


def test_putting_twice_keeps_one_read_only_file(store: Store, tmp_path: Path) -> None:
    source = tmp_path / "DSC00001.JPG"
    source.write_bytes(b"\xff\xd8" + b"x" * 3_000_000)
    first = store.put_file(source, kind="image", media_type="image/jpeg")
    path = store.artefact_path(first.sha256, verify=True)
    before = path.stat().st_ino
    assert store.put_file(source, kind="image", media_type="image/jpeg", sha256=first.sha256) == first
    assert path.stat().st_ino == before
    assert path.stat().st_mode & 0o777 == 0o400
    assert path.read_bytes() == source.read_bytes()
    with pytest.raises(StoreError, match="changed in transfer"):
        store.put_file(source, kind="image", media_type="image/jpeg", sha256="0" * 64)
    assert list((store.database_path.parent / "artefacts" / "tmp").iterdir()) == []
    path.chmod(0o644)
    path.write_bytes(b"other")
    with pytest.raises(IntegrityError, match="altered"):
        store.put_file(source, kind="image", media_type="image/jpeg")
    with pytest.raises(IntegrityError, match="altered"):
        store.artefact_path(first.sha256, verify=True)
    with pytest.raises(StoreError, match="not a SHA-256"):
        store.artefact_path("../../etc/passwd")


WRITER = """
import sys
from pathlib import Path
from service.core.records.events import StepNote
from service.store.signatures.signing import checkpoint
from service.store.store import Store
with Store.open(Path(sys.argv[1])) as store:
    run = store.find_run("latest")
    for index in range(50):
        store.record(run, [StepNote(step="s", attempt=1, note=f"{sys.argv[2]} {index}")], actor=sys.argv[2])
"""


@pytest.mark.slow
def test_four_processes_append_fifty_events_each_to_one_chain(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
        writers = [
            subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path), f"writer {index}"], cwd=ROOT_DIR)
            for index in range(4)
        ]
        assert [writer.wait(timeout=90) for writer in writers] == [0, 0, 0, 0]
        events = store.events(run)
    assert [event.seq for event in events] == list(range(1, 202))
    for index in range(4):
        mine = [event.payload for event in events if event.actor == f"writer {index}"]
        expected = [f"writer {index} {number}" for number in range(50)]
        assert [payload.note for payload in mine if isinstance(payload, StepNote)] == expected
    assert verify(tmp_path).ok


@pytest.mark.sqlite("SQLite's file is made by whoever comes first; PostgreSQL's tables by their owner")
@pytest.mark.slow
def test_several_processes_may_create_the_same_store_at_once(tmp_path: Path) -> None:
    code = "import sys, pathlib, service.store.store as s; s.Store.open(pathlib.Path(sys.argv[1])).close()"
    openers = [
        subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "new")], cwd=ROOT_DIR) for _index in range(4)
    ]
    assert [opener.wait(timeout=60) for opener in openers] == [0, 0, 0, 0]
