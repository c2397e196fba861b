"""How many images of a step count: header, notice, capture page and audit say one number, whatever was done again."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from service.audit.recorded_run import read_run
from service.core.records.events import Payload
from service.core.records.run_events import OperatorAction, StepFailed, StepStarted, ViewpointFailed
from tests.support.pages.browsed_run import BrowsedRun, words
from tests.support.pages.web import web_site
from tests.support.processes.waiting import until
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import begin_calibrated_run, capture

VIEWS = ("v1_001", "v1_002", "v1_003", "v1_004")
AFRESH = OperatorAction(action="redo", step="capture", reason="the lamp fell over")
FAILED = StepFailed(step="capture", attempt=1, error="DeviceError", message="no link", recovery="ask")
Course = Callable[["Capturing"], None]


class Capturing:
    """A run at its capture of four views."""

    def __init__(self, shown: BrowsedRun) -> None:
        self.shown = shown
        self._shade = 0

    def take(self, *views: str, attempt: int = 1) -> None:
        for view in views:
            self._shade += 1
            capture(self.shown.site, self.shown.run, "capture", view, EYE, shade=self._shade, attempt=attempt)

    def record(self, *payloads: Payload) -> None:
        self.shown.site.store.record(self.shown.run, list(payloads), actor="grace")

    def redo(self, view: str) -> None:
        act = {"action": "redo", "step": "capture", "viewpoint": view, "reason": "a hand was in it"}
        self.record(OperatorAction.model_validate(act))

    def give_up(self, view: str) -> None:
        failed = {"step": "capture", "attempt": 1, "viewpoint": view, "error": "MotionError", "message": "blocked"}
        self.record(ViewpointFailed.model_validate({**failed, "skipped": True}))


@pytest.fixture
def capturing(tmp_path: Path) -> Iterator[Capturing]:
    with web_site(tmp_path) as web:
        run = begin_calibrated_run(web)
        yield Capturing(BrowsedRun(web, web.browser("auditor"), run))


def _all(run: Capturing) -> None:
    run.take(*VIEWS)


def _one_again(run: Capturing) -> None:
    run.take(*VIEWS)
    run.redo("v1_002")


def _one_taken_again(run: Capturing) -> None:
    _one_again(run)
    run.take("v1_002")


def _from_the_beginning(run: Capturing) -> None:
    run.take(*VIEWS)
    run.record(AFRESH)


def _half_of_the_second_attempt(run: Capturing) -> None:
    _from_the_beginning(run)
    run.record(StepStarted(step="capture", attempt=2))
    run.take(*VIEWS[:2], attempt=2)


def _one_given_up(run: Capturing) -> None:
    run.take(*VIEWS[:3])
    run.give_up(VIEWS[3])


def _two_more_than_planned(run: Capturing) -> None:
    run.take(*VIEWS, "v1_005", "v1_006")


def _given_up_and_replaced(run: Capturing) -> None:
    run.take(*VIEWS[:3])
    run.give_up(VIEWS[3])
    run.take("v1_t20+00")


COURSES: Sequence[tuple[Course, int, int]] = (
    (_all, 4, 4),
    (_one_again, 3, 4),
    (_one_taken_again, 4, 4),
    (_from_the_beginning, 0, 4),
    (_half_of_the_second_attempt, 2, 4),
    (_one_given_up, 3, 4),
    (_two_more_than_planned, 6, 6),
    (_given_up_and_replaced, 4, 5),
)


def _audit(shown: BrowsedRun, page_of_it: str = "") -> str:
    """A page of the audit, once it is computed."""
    page = ""

    def complete() -> bool:
        nonlocal page
        page = shown.browser.get(f"/audit/runs/{shown.run}{page_of_it}").text
        return "data-pending" not in page

    until(complete, "the page of the audit", every_s=0.05)
    return words(page)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("course", "taken", "known"),
    [
        pytest.param(*row, id=row[0].__name__[1:], marks=pytest.mark.sweep(always=row[0] is _one_taken_again))
        for row in COURSES
    ],
)
def test_every_place_counts_the_same(capturing: Capturing, course: Course, taken: int, known: int) -> None:
    course(capturing)
    shown = capturing.shown
    of = f"{taken} of {known}"
    step = shown.words("")
    assert f"This step {of} " in step
    assert f"Images of the data set {of} " in step
    assert f"{of} images of this step are in the record" in step  # nothing drives the run
    assert f"Viewpoints from above {of} " in shown.words("capture")
    row = re.search(r"Capture (\d+) (\d+) (\d+) (\d+) (\d+)", _audit(shown))
    assert row is not None
    assert int(row[2]) == taken
    state = read_run(shown.site.site.data, shown.run).state  # what report, bundle and data set show pictures of
    assert len(state.steps["capture"].captured) == taken


@pytest.mark.parametrize("course", [_all, _one_again, _two_more_than_planned])
def test_a_stop_keeps_as_many_as_the_header_counts(capturing: Capturing, course: Course) -> None:
    course(capturing)
    capturing.record(FAILED)
    with capturing.shown.site.store.lease(capturing.shown.run, "test", 600.0):
        step = capturing.shown.words("")
    (taken, _) = re.findall(r"This step (\d+) of (\d+)", step)[0]
    assert f"Nothing. The {taken} images are" in step


def test_a_deviation_has_one_name_on_the_page_of_the_run_and_in_the_audit(capturing: Capturing) -> None:
    _one_again(capturing)
    shown = capturing.shown
    assert "Deviations 1 View taken again v1_002: a hand was in it" in shown.words("")
    assert "View taken again" in _audit(shown, "/deviations")
