"""One run is moved between records: equal heads, bit-equal numbers, recorded in both, and it goes on in one alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from sqlalchemy import select
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import StoreError
from service.core.records.events import RunMoved, RunReceived
from service.core.records.run_events import StepNote
from service.store.database.tables import artefacts, event_facets, events
from service.store.records import SITE, NewJob
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.store import CountedIds, capture, enqueue, start_run

pytestmark = [pytest.mark.timeout(300), pytest.mark.sqlite("moves runs between the two databases by itself")]
NOTE = StepNote(step="capture", attempt=1, note="Müller", data={"lux": 0.1 + 0.2})


def fill(folder: Path, first_id: int = 0) -> str:
    """Record a run with files, a finished job and one that waits, and sign it; returns its name."""
    ids = CountedIds()
    ids.count = first_id
    with Store.open(folder, ids=ids) as store:
        run_id = start_run(store)
        capture(store, run_id, f"v{first_id}")
        enqueue(store, run_id, NewJob("detect", "capture", 1, "a", {"n": 1.5}), actor="runner")
        job = store.claim_job("worker", 60.0, run_id=run_id)
        assert job is not None
        store.finish_job(job, measures={"x": 0.1}, duration_s=1.0)
        enqueue(store, run_id, NewJob("detect", "capture", 1, "b", {"n": 2}), actor="runner")
        store.record(run_id, [NOTE], actor="Ada")
        checkpoint(store, run_id)
    return run_id


def move(source: Path, target: Path, run: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["store", "copy", str(source), str(target), "--run", run, "--operator", "Ada"])
    return result.exit_code, " ".join(result.output.split())


def rows_of(folder: Path, run_id: str) -> list[tuple[object, ...]]:
    """Everything that is evidence of the run: events, artefact rows, facets."""
    with Store.open(folder, create=False) as store, store.database.reading() as connection:
        return [
            tuple(row)
            for table in (events, artefacts, event_facets)
            for row in connection.execute(
                select(table).where(table.c.run_id == run_id).order_by(*table.primary_key.columns)
            )
        ]


def require_clean(*folders: Path) -> None:
    for folder in folders:
        report = verify(folder)
        assert report.ok, (folder, report.faults)


@pytest.fixture(params=["SQLite", pytest.param("PostgreSQL", marks=pytest.mark.packages("postgresql"))])
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Another record, which has a run of its own."""
    folder = tmp_path / "site"
    if request.param == "PostgreSQL":
        request.getfixturevalue("cluster").site(folder)
    fill(folder, 50)
    return folder


@pytest.mark.slow
def test_a_run_goes_to_another_record_and_back_with_every_number_the_same(site: Path, tmp_path: Path) -> None:
    cart = tmp_path / "cart"
    run_id = fill(cart)
    other = fill(cart, 20)
    before = rows_of(cart, run_id)
    status, said = move(cart, site, run_id)
    assert (status, f"Moved: {run_id} (6 events, 3 files)" in said) == (0, True), said
    require_clean(cart, site)
    assert rows_of(cart, run_id) == rows_of(site, run_id) == before
    with Store.open(cart) as store:
        with pytest.raises(StoreError, match="was moved and goes on in"):
            store.record(run_id, [NOTE], actor="Ada")
        assert run_id not in store.open_runs()
        job = store.claim_job("worker", 60.0)
        assert job is not None
        assert job.run_id == other, "a job of the run that went is the other record's"
        assert store.claim_job("worker", 60.0) is None
        (moved,) = [e.payload for e in store.events(SITE) if isinstance(e.payload, RunMoved)]
        assert (moved.moved_run, moved.sha256) == (run_id, verify(site).heads[run_id])
    with Store.open(site) as store:
        (received,) = [e.payload for e in store.events(SITE) if isinstance(e.payload, RunReceived)]
        signed = json.loads(store.artefact_path(received.signatures.sha256, verify=True).read_bytes())
        assert [row["key_id"] for row in signed["checkpoints"]]
        assert "key_changed" in {row["kind"] for row in signed["site_events"]}
        first = store.claim_job("worker", 60.0)
        second = store.claim_job("worker", 60.0)
        assert first is not None
        assert second is not None
        assert {first.run_id, second.run_id} >= {run_id}
        job = first if first.run_id == run_id else second
        store.finish_job(job, measures={"y": 1e-300}, duration_s=2.0)
        capture(store, run_id, "later")
    require_clean(site)
    after = rows_of(site, run_id)
    status, said = move(site, cart, run_id)
    assert (status, f"Moved: {run_id} (2 events, 4 files)" in said) == (0, True), said
    require_clean(cart, site)
    assert rows_of(cart, run_id) == rows_of(site, run_id) == after
    with Store.open(cart) as store:
        assert [job.state for job in store.jobs(run_id)] == ["finished", "finished"]
        store.record(run_id, [NOTE], actor="Ada")
    with Store.open(site) as store, pytest.raises(StoreError, match="was moved and goes on in"):
        store.record(run_id, [NOTE], actor="Ada")
    require_clean(cart, site)


def test_a_run_that_somebody_works_at_stays(tmp_path: Path) -> None:
    cart, site = tmp_path / "cart", tmp_path / "site"
    run_id = fill(cart)
    with Store.open(cart) as store:
        with store.lease(run_id, "runner", 60.0):
            assert move(cart, site, run_id)[0] == 1
        job = store.claim_job("worker", 60.0)
        assert job is not None
        status, said = move(cart, site, run_id)
        assert (status, "is being computed" in said) == (1, True)
        store.finish_job(job, measures={}, duration_s=1.0)
        lost = next(row.ref.sha256 for row in store.artefacts(run_id) if row.ref.kind == "image")
        path = store.artefact_path(lost)
        content = path.read_bytes()
        path.unlink()
        status, said = move(cart, site, run_id)
        assert (status, "a stored file is missing" in said) == (1, True), said
        store.put_bytes(content, kind="image", media_type="image/jpeg", original_name="v0.JPG")
        store.record(run_id, [NOTE], actor="Ada")
    with Store.open(site) as store:
        assert store.runs() == []
    assert move(cart, site, run_id)[0] == 0
    require_clean(cart, site)


def test_an_interrupted_move_is_repeated_and_a_run_moves_to_one_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cart, site, third = tmp_path / "cart", tmp_path / "site", tmp_path / "third"
    run_id = fill(cart)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as killed:
        killed.setattr("service.store.moving._receive", interrupted)
        assert move(cart, site, run_id)[0] != 0
    with Store.open(cart) as store, pytest.raises(StoreError, match="was moved and goes on in"):
        store.record(run_id, [NOTE], actor="Ada")
    status, said = move(cart, third, run_id)
    assert (status, "was moved before and goes on in" in said) == (1, True), said
    assert move(cart, site, run_id)[0] == 0
    status, said = move(cart, site, run_id)
    assert (status, "an earlier try had copied it" in said) == (0, True), said
    require_clean(cart, site)
    status, said = move(cart, cart, run_id)
    assert (status, "the same record" in said) == (1, True), said


def test_a_run_that_went_on_elsewhere_is_not_copied_over(tmp_path: Path) -> None:
    cart, site = tmp_path / "cart", tmp_path / "site"
    run_id = fill(cart)
    with Store.open(cart) as store:
        store.record(run_id, [NOTE], actor="Ada")
    status, said = move(cart, site, run_id)
    assert status == 0, said
    with Store.open(site) as store:
        store.record(run_id, [NOTE], actor="Ada")  # it goes on there
    status, said = move(cart, site, run_id)
    assert (status, "does not go on as this one does" in said) == (1, True), said
