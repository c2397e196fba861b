"""NUL and surrogates, which other databases refuse, become escapes wherever text enters the record."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.audit.bundle import export_bundle
from service.cli.main import app
from service.computations.job import JobAnswer, JobContext
from service.core.records.run_events import JobFailed, StepNote
from service.core.words import storable, storable_data
from service.store import events as event_module
from service.store.records import NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from service.worker.loop import HANDLERS, work
from tests.support.hostile_places import STORED_AS, can_be_stored_as, refused_by_other_databases
from tests.support.hostile_text import UNSTORABLE, obeyed
from tests.support.record.bundled_site import check
from tests.support.record.store import CountedIds, start_run
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

texts = pytest.mark.parametrize("text", UNSTORABLE.values(), ids=list(UNSTORABLE))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data", ids=CountedIds()) as opened:
        yield opened
        assert verify(tmp_path / "data").ok


@pytest.mark.parametrize(
    ("place", "text"),
    [
        pytest.param(place, text, id=f"{place}-{name}")
        for place in STORED_AS
        for name, text in UNSTORABLE.items()
        if can_be_stored_as(place, text)
    ],
)
def test_every_text_can_be_recorded_verified_and_copied(store: Store, place: str, text: str) -> None:
    run = start_run(store)
    STORED_AS[place](store, run, text)
    data = store.database_path.parent
    assert verify(data).ok
    assert not refused_by_other_databases(data)
    assert all(event == again for event, again in zip(store.events(run), store.events(run), strict=True))
    done = CliRunner().invoke(app, ["audit", "show", run, "--data", str(data)], env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.exception
    assert obeyed(done.output) == []
    done = CliRunner().invoke(app, ["audit", "show", run, "--data", str(data), "--json"])
    assert json.loads(done.stdout)["run"] == run


@texts
def test_an_error_of_a_job_is_kept_and_the_worker_goes_on(
    tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(logging.root, "handlers", [])  # what pytest captures must be UTF-8 for pytest-xdist

    def fails(context: JobContext[Any]) -> JobAnswer:
        calls.append(context.arguments["of"])
        raise RuntimeError(text)

    monkeypatch.setitem(HANDLERS, "detect", fails)
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        jobs = [NewJob("detect", "capture", 1, f"key {number}", {"of": f"{number}"}) for number in (1, 2)]
        store.record(bench.run_id, [], actor="runner", jobs=jobs)
        assert work(store, until_idle=True, stop=lambda: False, progress=lambda *_: None) == 2
        assert calls == ["1", "2"]
        failed = [event.payload for event in store.events(bench.run_id) if isinstance(event.payload, JobFailed)]
        assert [end.message for end in failed] == [repr(RuntimeError(text))] * 2
        assert all(storable(text.split("\n", maxsplit=1)[0]) in end.traceback for end in failed)
        assert {job.state for job in store.jobs(bench.run_id)} == {"failed"}
        assert verify(tmp_path / "data").ok


@pytest.mark.sqlite("PostgreSQL keeps no NUL, so no older version has written one")
def test_a_record_of_an_older_version_with_nul_opens_and_verifies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unchanged(value: Any) -> Any:
        return value

    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        with monkeypatch.context() as older:
            older.setattr(event_module, "storable", unchanged)
            older.setattr(event_module, "storable_data", unchanged)
            store.record(bench.run_id, [StepNote(step="capture", attempt=1, note="a\x00b")], actor="a\x00da")
        assert bench.run().status == "completed"
        note = next(event for event in store.events(bench.run_id) if event.actor == "a\x00da")
        assert isinstance(note.payload, StepNote)
        assert note.payload.note == "a\x00b"
        assert verify(tmp_path / "data").ok
        assert check(export_bundle(store, bench.run_id, tmp_path / "b.zip", actor="ada").path) == []
    done = CliRunner().invoke(app, ["audit", "show", "--data", str(tmp_path / "data")], env={"COLUMNS": "200"})
    assert "a\\x00da" in done.output
    assert obeyed(done.output) == []


def test_what_is_storable_stays_as_it_is() -> None:
    for text in ("", "é 漢 😀", "a\nb\t", "\x1b[1m", "\\x00"):
        assert storable(text) == text
    assert storable("a\x00b\udcff") == "a\\x00b\\udcff"
    assert storable_data({"a": ["\x00", 1, 1.5, None, True], "\x00": ()}) == {
        "a": ["\\x00", 1, 1.5, None, True],
        "\\x00": [],
    }
