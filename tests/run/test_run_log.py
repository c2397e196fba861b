"""A run's log that many requests read at once."""

from __future__ import annotations

import threading
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.core.errors import IntegrityError
from service.core.records.run_events import StepNote, StepPassed
from service.followed_run import RunFollower
from service.run_start import recorded_run
from tests.support.pages.web import WebSite, web_site
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def test_a_log_that_many_threads_bring_up_to_date_takes_every_event_once(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        run_id = begin_run(store, PROTOCOL, tmp_path).run_id
        protocol, _ = recorded_run(store, run_id)
        run = RunFollower(store, run_id, protocol)
        problems: list[BaseException] = []
        together = threading.Barrier(6)

        def read() -> None:
            together.wait()
            try:
                for _ in range(40):
                    run.refresh()
            except Exception as error:  # noqa: BLE001 - told to the test
                problems.append(error)

        readers = [threading.Thread(target=read) for _ in range(6)]
        for reader in readers:
            reader.start()
        for number in range(60):
            note = StepNote(step="fixation", attempt=1, note=f"note {number}")
            store.record(run_id, [note], actor="runner")
        for reader in readers:
            reader.join()
        assert problems == []
        assert [event.seq for event in run.now().events] == list(range(1, store.head(run_id) + 1))


def test_an_event_that_cannot_have_happened_stays_an_error_for_everybody(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        run_id = begin_run(store, PROTOCOL, tmp_path).run_id
        run = RunFollower(store, run_id, recorded_run(store, run_id)[0])
        sound = run.now()
        store.record(run_id, [StepPassed(step="spraying", attempt=7)], actor="runner")
        for look in (run.refresh, run.now, run.refresh):
            with pytest.raises(IntegrityError, match="cannot have happened here"):
                look()
        assert run.state == sound.state
        with pytest.raises(IntegrityError, match="cannot have happened here"):
            RunFollower(store, run_id, sound.protocol)


def test_what_a_page_was_given_of_a_run_stays_of_one_moment(web: WebSite) -> None:
    run_id = web.begin_run().run_id
    shown = web.site.run(run_id)
    seq = shown.state.seq
    web.store.record(run_id, [StepNote(step="fixation", attempt=1, note="meanwhile")], actor="runner")
    later = web.site.run(run_id)
    assert (later.state.seq, len(later.events)) == (seq + 1, seq + 1)
    assert (shown.state.seq, len(shown.events)) == (seq, seq)
    assert web.site.run(run_id) is later, "nothing has happened since"


def test_an_impossible_event_is_shown_by_every_page_that_is_asked(web: WebSite) -> None:
    run_id = web.begin_run().run_id
    web.site.run(run_id)
    web.store.record(run_id, [StepPassed(step="spraying", attempt=7)], actor="runner")
    browser = web.browser("auditor")
    for _ in range(2):
        page = browser.get(f"/runs/{run_id}")
        assert page.status_code == 409
        assert "cannot have happened here" in page.text


def test_the_slow_first_read_of_a_run_holds_up_no_page_of_another(web: WebSite) -> None:
    slow, quick = (web.begin_run().run_id for _ in range(2))
    began, go_on = threading.Event(), threading.Event()
    read = web.site.runs.first_read

    def first_read(run_id: str) -> RunFollower:
        if run_id == slow:
            began.set()
            assert go_on.wait(60)
        return read(run_id)

    web.site.runs.first_read = first_read
    browsers = [web.browser("technician") for _ in range(3)]
    with ThreadPoolExecutor(3) as people:
        try:
            waiting = [people.submit(browser.get, f"/runs/{slow}") for browser in browsers[:2]]
            assert began.wait(60)
            assert people.submit(browsers[2].get, f"/runs/{quick}").result(60).status_code == 200
            assert not any(page.done() for page in waiting)
        finally:
            go_on.set()
        assert [page.result(60).status_code for page in waiting] == [200, 200]


def test_a_run_whose_first_read_failed_is_read_again(web: WebSite) -> None:
    assert web.browser("auditor").get("/runs/20260101-000000-000000").status_code == 404
    run_id = web.begin_run().run_id
    assert web.browser("auditor").get(f"/runs/{run_id}").status_code == 200
