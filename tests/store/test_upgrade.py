"""A data folder of the version before this one is upgraded, verified, replayed, used further and copied."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit.filters import EventFilter
from service.audit.queries import events_page
from service.cli.main import app
from service.core.records.events import RecordCopied
from service.store.database.database import REVISIONS
from service.store.records import SITE
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.postgres import Cluster
from tests.support.recorded.unpacked_run import PREVIOUS, unpack_recorded_run
from tests.support.runs.bench_run import PROTOCOL, begin_run

REVISION = "0005"


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpack_recorded_run(tmp_path_factory.mktemp("previous"), PREVIOUS)


@pytest.fixture
def data(unpacked: Path, tmp_path: Path) -> Path:
    """A data folder that is as the previous version left it."""
    return Path(shutil.copytree(unpacked, tmp_path / "data"))


def revision(data: Path) -> str:
    with closing(sqlite3.connect(data / "orthocapture.sqlite")) as database:
        ((found,),) = database.execute("SELECT version_num FROM alembic_version")
    return str(found)


def orthocapture(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in arguments])
    assert done.exit_code == 0, done.output
    return done.output


def test_the_archive_is_the_one_that_its_page_describes() -> None:
    said = (PREVIOUS.parent / "README.md").read_text(encoding="utf-8")
    assert hashlib.sha256(PREVIOUS.read_bytes()).hexdigest() in said


def test_it_is_read_as_it_is_and_upgraded_when_it_is_written_to(data: Path) -> None:
    assert revision(data) == REVISION < REVISIONS[-1]
    before = verify(data)
    assert before.ok, before.faults
    assert (before.jobs, before.files) == (1, 8)
    assert revision(data) == REVISION, "reading changes nothing"
    with Store.open(data) as store:
        run_id = store.find_run("latest")
        with store.database.reading() as connection:
            assert events_page(connection, run_id, EventFilter(q="fixation")).rows, "its words are found"
    assert revision(data) == REVISIONS[-1]
    after = verify(data)
    assert after.ok, after.faults
    assert after.heads == before.heads


@pytest.mark.slow
def test_it_is_replayed_with_equal_results(data: Path) -> None:
    said = json.loads(orthocapture("replay", "latest", "--json", "--data", data))
    assert said["verdict"] == "identical"
    assert [job["kind"] for job in said["jobs"]] == ["locate_spheres"]


@pytest.mark.slow
def test_a_run_is_added_to_it(data: Path, tmp_path: Path) -> None:
    with Store.open(data) as store:
        assert begin_run(store, PROTOCOL, tmp_path).run().terminal
        assert len(store.runs()) == 2
        checkpoint(store, SITE)
    report = verify(data)
    assert report.ok, report.faults
    assert orthocapture("store", "backup", tmp_path / "backup", "--data", data)
    assert orthocapture("store", "restore", tmp_path / "backup", tmp_path / "restored", "--operator", "Ada")
    restored = verify(tmp_path / "restored")
    assert restored.ok, restored.faults
    changed = {name for name, head in restored.heads.items() if report.heads[name] != head}
    assert changed == {SITE}, "which says who restored it"


@pytest.mark.slow
@pytest.mark.packages("postgresql")
def test_it_goes_to_postgresql_with_equal_heads(data: Path, tmp_path: Path) -> None:
    before = verify(data)
    cluster = Cluster()
    cluster.start()
    try:
        site = cluster.site(tmp_path / "site")
        orthocapture("store", "copy", data, site, "--operator", "Ada")
        after = verify(site)
        assert after.ok, after.faults
        (run_id,) = set(before.heads) - {SITE}
        assert after.heads[run_id] == before.heads[run_id]
        with Store.open(site) as store:
            (copied,) = [e.payload for e in store.events(SITE) if isinstance(e.payload, RecordCopied)]
        assert (copied.runs, copied.files) == (1, 8)
    finally:
        cluster.stop()
