"""The layout check asks for one more photograph: its normal course, and not an accident, on every page."""

from __future__ import annotations

import re
from collections.abc import Generator
from pathlib import Path

import pytest

from service.computations.job import JobAnswer, RecordedContext
from service.computations.layout import Answer, LayoutDetails
from service.core.records.run_events import JobFinished, OperatorAction, StepMeasured, StepNote, StepPassed
from service.core.records.run_events import Uncertainty as Bounds
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.monitor.snapshot import Snapshot, write_snapshot
from service.worker import loop
from tests.support.pages.browsed_run import words
from tests.support.pages.web import Browser, WebSite, web_site
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import PROTOCOL, Bench
from tests.support.runs.computing_run import compute_jobs

LAYOUT = """\
  - id: layout
    kind: layout_check
    title: Check the layout
    gates: [{measure: spheres_seen, min: 10}, {measure: layout_margin_mm, min: 0.4, unit: mm}]
"""
WITH_LAYOUT = PROTOCOL.replace("  - id: capture\n", LAYOUT + "  - id: capture\n")


def judge(context: RecordedContext) -> JobAnswer:
    """As if one photograph left the margin open, and two decided it."""
    images = context.arguments["images"]
    lower = 0.3 if len(images) == 1 else 0.45
    bounds = {"layout_margin_mm": Bounds(sigma=0.05, lower=lower, upper=0.6)}
    measures = {"spheres_seen": 13.0, "photographs_used": float(len(images)), "layout_margin_mm": 0.5}
    return JobAnswer(measures, (), Answer(spheres_m=(), details=LayoutDetails(passed=True, bounds=bounds)))


class _LeftError(BaseException):
    """The technician leaves the run where it is; no error of the run, which would be asked about."""


@pytest.fixture
def web(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[WebSite]:
    monkeypatch.setitem(loop.HANDLERS, "layout", judge)
    with web_site(tmp_path) as site:
        yield site


def left(web: WebSite, step: str, kind: str) -> tuple[Bench, Browser]:
    """A run that computes its own jobs, left at a question, and the technician who controls it."""
    bench = web.begin_run(WITH_LAYOUT)

    def leave(_question: AskOperator, _state: RunState) -> OperatorAction:
        raise _LeftError

    def compute(_seconds: float) -> None:
        compute_jobs(bench.store)

    def photograph(question: AskOperator, _state: RunState) -> OperatorAction:
        return answer(question, "confirm")

    bench.on_wait = compute
    bench.script("layout", "recovery", photograph)
    bench.script(step, kind, leave)
    with pytest.raises(_LeftError):
        bench.run()
    web.site.launcher.start(bench.run_id)
    snapshot = Snapshot.model_validate({"at_utc_s": web.now_utc_s, "doing": "asking", "robot": "standing"})
    write_snapshot(web.site.data, bench.run_id, snapshot)
    browser = web.browser("technician")
    web.take_control(bench.run_id, browser)
    return bench, browser


def test_one_more_photograph_is_asked_for_and_nothing_is_called_stopped(web: WebSite) -> None:
    bench, browser = left(web, "layout", "recovery")
    html = browser.get(f"/runs/{bench.run_id}").text
    said = words(html)
    assert "One more photograph" in said
    assert "notice-attention more" in html
    assert "notice-stop stopped" not in html
    assert not re.search(r"Stopped|did not work|Try again", said)
    assert said.count("Hold the camera on the side of the left edge") == 1, "said once"
    assert re.search(
        r'<button class="target primary"[^>]*>\s*<span class="button-words"><span>Take photograph 2', html
    )
    assert "So far: Margin against confusing four spheres 0.5" in said
    assert "data-lens-step" in html
    assert "Live view, to aim by" in said
    assert re.search(r'data-attention="waits" data-words="Check the layout: one more photograph', html)
    steps = browser.get(f"/runs/{bench.run_id}/parts/side").text
    assert "stopped" not in steps
    home = words(browser.get("/").text)
    assert "word-stop" not in browser.get("/").text
    assert "Waits for a confirmation: One more photograph" in home


def test_the_other_ways_are_one_press_away(web: WebSite) -> None:
    bench, browser = left(web, "layout", "recovery")
    html = browser.get(f"/runs/{bench.run_id}").text
    assert re.search(r"<details[^>]*><summary>What else can be done</summary>", html)
    assert "End the run here and keep what there is" in words(html)


def test_a_run_recorded_before_the_words_reads_as_it_did(web: WebSite) -> None:
    bench, browser = left(web, "layout", "recovery")
    state = bench.state()
    old = StepNote(step="layout", attempt=1, note="layout_photograph_wanted", data={"advice": "Take one more"})
    assert state.step.in_course is not None
    web.store.record(bench.run_id, [old], actor="runner")
    assert bench.state().step.in_course is None
    assert "Try again: take one more" in words(browser.get(f"/runs/{bench.run_id}").text)


def test_the_second_photograph_decides_and_its_verdict_stays_while_the_next_step_begins(web: WebSite) -> None:
    bench, browser = left(web, "capture", "confirm")
    assert [one.attempt for one in bench.payloads(StepPassed) if one.step == "layout"] == [2]
    assert len(bench.payloads(StepMeasured)) >= 2
    assert bench.payloads(JobFinished)
    page = f"/runs/{bench.run_id}"
    html = browser.get(page).text
    assert "Check the layout: passed" in words(html)
    assert "Margin against confusing four spheres 0.5" in words(html)
    (seq,) = re.findall(r'data-judged="(\d+)"', html)
    assert int(seq) == bench.state().steps["layout"].passed_seq
    assert "data-judged" not in browser.get(page, params={"step": "fixation"}).text, "there it stands itself"
    web.store.record(bench.run_id, [OperatorAction(action="pause"), OperatorAction(action="resume")], actor="grace")
    assert "data-judged" not in browser.get(page).text, "a person has decided something since"


def test_a_pause_does_not_take_a_verdict_away(web: WebSite) -> None:
    bench, browser = left(web, "capture", "confirm")
    web.store.record(bench.run_id, [OperatorAction(action="pause")], actor="grace")
    assert "data-judged" in browser.get(f"/runs/{bench.run_id}").text


def test_the_answer_is_confirmed_by_one_press(web: WebSite) -> None:
    bench, _browser = left(web, "layout", "recovery")
    bench.operator.script = {}
    bench.script("layout", "recovery", lambda question, _state: answer(question, "confirm"))
    assert bench.run().status == "completed"
