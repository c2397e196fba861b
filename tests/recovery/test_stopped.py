"""A stopped run looks stopped, on the first page and at its step: one line says what it lacks and what to do."""

from __future__ import annotations

import re
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.core.protocol import Protocol
from service.core.records.run_events import GateVerdict, StepFailed, StepMeasured, StepNote, StepStarted
from service.core.run.decide import AskOperator, decide, evaluate_gates
from service.web.run_frame import needs, stopped_words
from tests.support.pages.browsed_run import words
from tests.support.pages.shown_site import skip
from tests.support.pages.web import WebSite, web_site
from tests.support.runs.attended import attended
from tests.support.runs.bench_run import Bench

STANDING = {"doing": "asking", "robot": "standing"}


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


@contextmanager
def driven(web: WebSite, run: Bench) -> Generator[None]:
    with attended(web.site.data, {run.run_id: STANDING}):
        yield


def plain(page: str) -> str:
    """The words of a page."""
    return words(re.sub(r"<(svg|script|dialog).*?</\1>", "", page, flags=re.DOTALL)).strip()


def at_the_capture(web: WebSite) -> Bench:
    run = web.begin_run()
    web.store.record(run.run_id, [skip("fixation")], actor="grace")
    return run


def fall_short(web: WebSite, run: Bench) -> None:
    """Two of four images, and advice to take two more."""
    step = run_protocol(web, run).step("capture")
    measures = {"viewpoints_captured": 2.0, "settings_departures": 0.0, "moved_during_exposure": 0.0}
    note = StepNote(
        step="capture",
        attempt=1,
        note="retakes",
        data={"viewpoints": ["v003", "v004"], "advice": "Take v003 and v004 again: a cable was in the picture"},
    )
    begun = StepStarted(step="capture", attempt=1)
    measured = StepMeasured(step="capture", attempt=1, measures=measures, artefacts=(), result={})
    run.act("confirm", step="capture")
    payloads = [begun, note, measured, evaluate_gates(step, 1, measures)]
    web.store.record(run.run_id, payloads, actor="runner")


def test_a_run_that_falls_short_says_what_it_lacks_and_what_to_do(web: WebSite) -> None:
    run = at_the_capture(web)
    fall_short(web, run)
    browser = web.browser("technician")
    web.take_control(run.run_id, browser)
    with driven(web, run):
        home, page = plain(browser.get("/").text), plain(browser.get(f"/runs/{run.run_id}").text)
        source = browser.get(f"/runs/{run.run_id}").text
    line = "Stopped: Viewpoints captured 2, needs at least 3 →"
    assert line in home
    assert "Under way at" not in home
    assert line in page
    assert source.index("stopped-line") < source.index('id="ways-title"')
    assert "Step 2 of 3 · stopped" in page


def test_what_failed_is_told_with_the_remedy(web: WebSite) -> None:
    run = at_the_capture(web)
    run.act("confirm", step="capture")
    failed = StepFailed(
        step="capture", attempt=1, error="DeviceUnavailableError", message="no link to the arm", recovery="ask"
    )
    web.store.record(run.run_id, [StepStarted(step="capture", attempt=1), failed], actor="runner")
    with driven(web, run):
        home = plain(web.browser("auditor").get("/").text)
    assert "Stopped: No link to the arm → check that the device is switched on" in home


def test_what_waits_and_what_nobody_drives_is_told_apart(web: WebSite) -> None:
    run = web.begin_run()
    browser = web.browser("auditor")
    assert "Stopped: the program that drives it does not run → open it and go on" in plain(browser.get("/").text)
    with driven(web, run):
        assert "Waits for a confirmation at Fix the specimen" in plain(browser.get("/").text)
        run.act("pause")
        assert "Paused at Fix the specimen" in plain(browser.get("/").text)


def test_the_views_that_mend_are_counted(web: WebSite) -> None:
    run = at_the_capture(web)
    fall_short(web, run)
    state = run.state()
    question = decide(run_protocol(web, run), state)
    assert isinstance(question, AskOperator)
    assert stopped_words(run_protocol(web, run), state, question).endswith("→ take these 2 views")


def run_protocol(web: WebSite, run: Bench) -> Protocol:
    return web.site.run(run.run_id).protocol


def test_a_limit_from_above_and_one_that_is_not_decided() -> None:
    high = GateVerdict(measure="five_fold_rms_px", value=0.71, minimum=None, maximum=0.5, unit="px", passed=False)
    assert needs(high) == "RMS reprojection error in cross-validation 0.71 px, needs at most 0.5 px"


def test_the_line_of_a_stop_is_short_and_place_and_remedy_stand_below(web: WebSite) -> None:
    run = at_the_capture(web)
    run.act("confirm", step="capture")
    message = "nobody has let the arm move [127.0.0.1]. Look for the cause, and whether anybody is in reach"
    failed = StepFailed(step="capture", attempt=1, error="LeaveNeededError", message=message, recovery="ask")
    web.store.record(run.run_id, [StepStarted(step="capture", attempt=1), failed], actor="runner")
    with driven(web, run):
        page = plain(web.browser("technician").get(f"/runs/{run.run_id}").text)
    assert "Stopped: Nobody has let the arm move →" in page
    assert page.count("127.0.0.1") == 1
    assert page.count("Look for the cause") == 1
