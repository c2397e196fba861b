"""NUL and surrogates, which other databases refuse, become escapes wherever text enters the record."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.audit.bundle.export import export_bundle
from service.cli.main import app
from service.core.records.events import JobFailed, StepNote
from service.core.shown_text import storable, storable_data
from service.store import events as event_module
from service.store.records import NewArtefact, NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from service.worker.job import JobAnswer, JobContext
from service.worker.loop import HANDLERS, work
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


def dumped(data: Path) -> str:
    """Every row of the database as text. A copy to PostgreSQL takes it unless it holds NUL or a surrogate."""
    with closing(sqlite3.connect(data / "orthocapture.sqlite")) as database:
        # The index of words keeps no text that could be read back.
        listed = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'event_words%'"
        tables = [name for (name,) in database.execute(listed)]
        return "\n".join(repr(row) for name in tables for row in database.execute(f'SELECT * FROM "{name}"'))


def as_a_note(store: Store, run: str, text: str) -> None:
    store.record(run, [StepNote(step=text, attempt=1, note=text, data={"x": [text], text: {text: text}})], actor=text)


def as_a_file(store: Store, run: str, text: str) -> None:
    ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name=text)
    note = StepNote(step="s", attempt=1, note="n", data={"file": ref.model_dump()})
    store.record(run, [note], actor="Ada", artefacts=[NewArtefact(ref, text, step=text, viewpoint=text, who=text)])


def can_name_a_file(text: str) -> bool:
    """Whether a file system has such names; a surrogate stands for a byte that is not text."""
    try:
        return b"\0" not in os.fsencode(text) and "/" not in text
    except UnicodeEncodeError:
        return False


def as_a_name_of_a_file(store: Store, run: str, text: str) -> None:
    path = store.database_path.parent.parent / text
    path.write_bytes(b"x")
    ref = store.put_file(path, kind="image", media_type="image/jpeg")
    note = StepNote(step="s", attempt=1, note="n", data={"file": ref.model_dump()})
    store.record(run, [note], actor="Ada", artefacts=[NewArtefact(ref, "camera")])


def as_a_job(store: Store, run: str, text: str) -> None:
    job = NewJob("detect", text, 1, text, {"of": text})
    store.record(run, [], actor=text, jobs=[job])
    store.record(run, [], actor=text, jobs=[job])
    assert len(store.jobs(run)) == 1


def as_a_result(store: Store, run: str, text: str) -> None:
    store.record(run, [], actor="runner", jobs=[NewJob("detect", "s", 1, "k", {})])
    job = store.claim_job(text.replace("\x00", "").encode("utf-8", "ignore").decode(), 10)
    assert job is not None
    store.finish_job(job, measures={}, duration_s=1.0, result={"words": [text]})


def in_the_sites_chain(store: Store, run: str, text: str) -> None:
    note = StepNote(step=run, attempt=1, note=text)
    store.record_site([note], actor=text, software={"orthocapture": text})


PLACES: dict[str, Callable[[Store, str, str], None]] = {
    "note": as_a_note,
    "file": as_a_file,
    "file's own name": as_a_name_of_a_file,
    "job": as_a_job,
    "result": as_a_result,
    "site": in_the_sites_chain,
}


@pytest.mark.parametrize(
    ("place", "text"),
    [
        pytest.param(place, text, id=f"{place}-{name}")
        for place in PLACES
        for name, text in UNSTORABLE.items()
        if place != "file's own name" or can_name_a_file(text)
    ],
)
def test_every_text_can_be_recorded_verified_and_copied(store: Store, place: str, text: str) -> None:
    run = start_run(store)
    PLACES[place](store, run, text)
    data = store.database_path.parent
    assert verify(data).ok
    stored = dumped(data)
    assert "\\x00" not in stored.replace("\\\\x00", "")
    assert "\\\\u0000" not in stored.replace("\\\\\\\\u0000", "")
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
