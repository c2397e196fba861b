"""In a real browser: what a person has open or under the finger stays what it was while the run goes on."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from service.core.gates import evaluate_gates
from service.core.protocol import parse_protocol
from service.core.records.run_events import (
    OperatorAction,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepStarted,
)
from service.steps import params_models
from service.store.store import Store
from tests.support.pages.at_the_table import STANDING, at_the_table, record
from tests.support.pages.browser import Screen, Served, screen, scripts_held_back, served
from tests.support.pages.shown_site import skip
from tests.support.pages.web import password_of, web_site
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import begin_calibrated_run, capture
from tests.support.runs.attended import attended
from tests.support.runs.bench_run import PROTOCOL

pytestmark = [pytest.mark.timeout(300)]
LATER_MS = 20_000
FAILED = StepFailed(step="capture", attempt=1, error="DeviceError", message="no link", recovery="ask")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("forms")
    with web_site(folder):  # creates its people
        pass
    with served(folder / "rig.yaml", folder / "data", "--protocols", str(folder / "protocols")) as running:
        yield running


def acts(server: Served, run_id: str) -> list[OperatorAction]:
    with Store.open(server.data, create=False) as store:
        return [e.payload for e in store.events(run_id) if isinstance(e.payload, OperatorAction)]


@contextmanager
def capturing(server: Served, browser: Browser) -> Generator[tuple[Screen, str]]:
    """A technician at the capture page of a run whose robot has taken its first image."""
    with web_site(server.data.parent) as web:
        run_id = begin_calibrated_run(web)
        capture(web, run_id, "capture", "v1_001", EYE, shade=1)
    with attended(server.data, {run_id: STANDING}), screen(browser, server.url) as tablet:
        tablet.sign_in("grace", password_of("grace"))
        tablet.go(f"/runs/{run_id}")
        tablet.page.get_by_role("button", name="Take control").click()
        expect(tablet.page.get_by_role("button", name="End run")).to_be_visible()
        tablet.go(f"/runs/{run_id}/capture")
        yield tablet, run_id


def next_image(server: Served, run_id: str, name: str) -> None:
    with web_site(server.data.parent) as web:
        capture(web, run_id, "capture", name, EYE, shade=int(name[-1]))


def open_redo_with_a_reason(page: Page) -> None:
    page.get_by_text("Redo v1_001…").click()
    page.get_by_label("Reason in your own words").fill("a drape hung into it")


@pytest.mark.slow
def test_an_open_redo_stays_about_its_viewpoint_while_images_arrive(server: Served, browser: Browser) -> None:
    with capturing(server, browser) as (tablet, run_id):
        page = tablet.page
        open_redo_with_a_reason(page)
        next_image(server, run_id, "v1_002")
        expect(page.get_by_role("heading", name="v1_002")).to_be_visible(timeout=LATER_MS)
        form = page.locator("details[open] form")
        expect(form.get_by_label("Reason in your own words")).to_have_value("a drape hung into it")
        expect(form.locator("[name=viewpoint]")).to_have_value("v1_001")
        form.get_by_role("button", name="Redo v1_001").focus()
        page.keyboard.down("Enter")
        expect(form).to_have_count(0, timeout=LATER_MS)
        page.keyboard.up("Enter")
        (redo,) = [act for act in acts(server, run_id) if act.action == "redo"]
        assert (redo.viewpoint, redo.reason) == ("v1_001", "a drape hung into it")
        page.get_by_text("Redo v1_002…").click()
        expect(page.get_by_label("Reason in your own words")).to_have_value("")


@pytest.mark.slow
def test_what_was_typed_before_the_scripts_had_come_counts(server: Served, browser: Browser) -> None:
    with capturing(server, browser) as (tablet, run_id), scripts_held_back(tablet.page) as come:
        page = tablet.page
        page.reload(wait_until="commit")
        open_redo_with_a_reason(page)
        button = page.get_by_role("button", name="Redo v1_001")
        instead_of_hold = page.locator("details[open] [data-instead-of-hold]")
        expect(instead_of_hold).to_have_count(1)
        come()
        expect(instead_of_hold).to_have_count(0, timeout=LATER_MS)
        expect(page.get_by_label("Something else, in my own words")).to_be_checked()
        button.focus()
        page.keyboard.down("Enter")
        expect(page.locator("details[open] form")).to_have_count(0, timeout=LATER_MS)
        page.keyboard.up("Enter")
        assert [act.reason for act in acts(server, run_id) if act.action == "redo"] == ["a drape hung into it"]


@pytest.mark.slow
def test_no_tap_sends_what_must_be_held_before_the_scripts_have_come(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        record(server, run_id, skip("fixation"))
        page = tablet.page
        go = page.get_by_role("button", name="Confirm: the robot takes 4 images")
        expect(go).to_be_enabled(timeout=LATER_MS)
        with scripts_held_back(tablet.page) as come:
            page.reload(wait_until="commit")
            go.click()
            page.wait_for_timeout(500)
            assert [act.action for act in acts(server, run_id) if act.action == "confirm"] == []
            come()
        expect(go).to_be_enabled(timeout=LATER_MS)
        assert [act.action for act in acts(server, run_id) if act.action == "confirm"] == []


@pytest.mark.slow
def test_a_reason_that_was_typed_for_one_viewpoint_is_not_kept_for_the_next(server: Served, browser: Browser) -> None:
    with capturing(server, browser) as (tablet, run_id):
        page = tablet.page
        open_redo_with_a_reason(page)
        next_image(server, run_id, "v1_002")
        expect(page.get_by_role("heading", name="v1_002")).to_be_visible(timeout=LATER_MS)
        page.get_by_text("Redo v1_001…").click()  # closes it
        expect(page.get_by_text("Redo v1_001…")).to_have_count(0)
        page.get_by_text("Redo v1_002…").click()
        expect(page.get_by_label("Reason in your own words")).to_have_value("")


@pytest.mark.slow
def test_a_tap_on_what_must_be_held_says_so(server: Served, browser: Browser) -> None:
    with capturing(server, browser) as (tablet, run_id):
        page = tablet.page
        open_redo_with_a_reason(page)
        button = page.get_by_role("button", name="Redo v1_001")
        expect(button).to_contain_text("Hold for 1.5 s.")
        expect(button.locator(".ring")).to_be_visible()
        button.click()
        expect(button).to_have_attribute("data-short", "yes")
        expect(page.locator("#news")).to_have_text("Let go too soon: nothing was sent.")
        assert [act.action for act in acts(server, run_id) if act.action == "redo"] == []


@pytest.mark.slow
def test_an_open_dialog_stays_when_its_question_is_over_and_what_it_says_is_refused(
    server: Served, browser: Browser
) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.get_by_role("button", name="Skip…").click()
        dialog = page.get_by_role("dialog", name="Skip this step")
        dialog.get_by_role("textbox").fill("fixed the day before")
        record(server, run_id, skip("fixation"), OperatorAction(action="confirm", step="capture"))
        record(server, run_id, StepStarted(step="capture", attempt=1))
        expect(page.locator("h1", has_text="Capture")).to_be_visible(timeout=LATER_MS)
        expect(dialog.locator("[name=step]")).to_have_value("fixation")
        dialog.get_by_role("button", name="Skip the step").click()
        expect(dialog.get_by_role("alert")).to_contain_text("The page was out of date", timeout=LATER_MS)
        expect(dialog.get_by_role("textbox")).to_have_value("fixed the day before")
        dialog.get_by_role("button", name="Cancel").click()
        expect(page.get_by_role("button", name="Skip…")).to_have_count(0, timeout=LATER_MS)
        expect(page.locator("#dialog-skip")).to_have_count(0)


@pytest.mark.slow
def test_a_hold_ends_when_the_button_comes_to_mean_something_else(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        record(server, run_id, skip("fixation"))
        go = page.get_by_role("button", name="Confirm: the robot takes 4 images")
        expect(go).to_be_enabled(timeout=LATER_MS)
        go.evaluate("button => { button.dataset.hold = 60000; }")
        go.hover()
        page.mouse.down()
        expect(page.locator("button.held")).to_have_count(1)
        seen = page.locator(".main-action [name=seen_seq]").input_value()
        record(server, run_id, OperatorAction(action="confirm", step="capture"))
        record(server, run_id, StepStarted(step="capture", attempt=1), FAILED)
        expect(page.get_by_role("heading", name="Capture did not work")).to_be_visible(timeout=LATER_MS)
        # The same step and verb, but another question: what was read when the press began is what would be sent.
        expect(page.locator(".main-action [name=seen_seq]")).to_have_value(seen)
        record(server, run_id, OperatorAction(action="pause"))
        expect(page.get_by_role("button", name="Resume")).to_be_visible(timeout=LATER_MS)
        expect(page.locator("button.held")).to_have_count(0)
        page.mouse.up()
        assert [act.action for act in acts(server, run_id)] == ["skip", "confirm", "pause"]


@pytest.mark.slow
def test_what_was_sent_says_so_until_the_answer_comes(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        waiting: list[Route] = []

        def hold_back(route: Route) -> None:
            waiting.append(route)

        page.route("**/actions", hold_back)
        page.get_by_role("button", name="Pause").click()
        button = page.locator(".actions .pause")
        expect(button).to_contain_text("Sent…")
        expect(button).to_have_attribute("aria-disabled", "true")
        button.click(force=True)
        page.evaluate("document.addEventListener('page-changed', () => { document.body.dataset.seen = ''; })")
        record(server, run_id, StepNote(step="fixation", attempt=1, note="looked at", data={}))
        expect(page.locator("body[data-seen]")).to_be_attached(timeout=LATER_MS)
        expect(button).to_contain_text("Sent…")
        expect(button).to_have_attribute("aria-disabled", "true")
        assert len(waiting) == 1, "it is sent once"
        waiting[0].continue_()
        expect(page.get_by_text("Sent…")).to_have_count(0, timeout=LATER_MS)


@pytest.mark.slow
def test_who_asks_for_control_and_who_refuses_it_is_said_without_a_reload(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (mine, run_id), screen(browser, server.url) as other:
        other.sign_in("emmy", password_of("emmy"))
        other.go(f"/runs/{run_id}")
        other.page.get_by_role("button", name="Ask for control").click()
        notice = mine.page.get_by_text("Emmy Noether asks to take over control of this run.")
        expect(notice).to_be_visible(timeout=LATER_MS)
        mine.page.get_by_role("button", name="Refuse").click()
        refusal = other.page.get_by_text("Grace Hopper refused your request and keeps control of this run")
        expect(refusal).to_be_visible(timeout=LATER_MS)
        other.page.get_by_role("button", name="Take over with a reason").click()
        dialog = other.page.get_by_role("dialog", name="Take over from Grace Hopper")
        dialog.get_by_label("Reason").fill("the specimen dries")
        dialog.get_by_role("button", name="Take over").click()
        lost = mine.page.get_by_text("Emmy Noether took over control of this run from you", exact=True)
        expect(lost).to_be_visible(timeout=LATER_MS)
        expect(mine.page.get_by_text("Reason: “the specimen dries”")).to_be_visible()


def test_a_verdict_stays_until_it_was_seen_although_the_next_step_has_begun(server: Served, browser: Browser) -> None:
    protocol = parse_protocol(PROTOCOL.encode(), params_models(), name="bench.yaml").protocol
    measures = {gate.measure: float(gate.min or 0.0) for gate in protocol.step("capture").gates}
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        record(server, run_id, skip("fixation"), OperatorAction(action="confirm", step="capture"))
        record(server, run_id, StepStarted(step="capture", attempt=1))
        measured = StepMeasured(step="capture", attempt=1, measures=measures)
        judged = evaluate_gates(protocol.step("capture"), 1, measures, frozenset())
        record(server, run_id, measured, judged, StepPassed(step="capture", attempt=1))
        expect(page.get_by_role("heading", name="Spray", level=1)).to_be_visible(timeout=LATER_MS)
        verdict = page.get_by_role("region", name="Judged meanwhile")
        expect(verdict).to_contain_text("Capture: passed")
        expect(verdict).to_contain_text("Viewpoints captured 3 (at least 3")
        page.reload()
        expect(verdict).to_be_visible()
        verdict.get_by_role("button", name="Seen").click()
        expect(verdict).to_be_hidden()
        note = StepNote(step="spraying", attempt=1, note="looked at", data={})
        page.evaluate("document.addEventListener('page-changed', () => { document.body.dataset.changed = ''; })")
        record(server, run_id, note)
        expect(page.locator("body[data-changed]")).to_be_attached(timeout=LATER_MS)
        expect(verdict).to_be_hidden()
