"""Every form on every page that is kept up to date sends what it is about, and that is checked."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from html import unescape
from pathlib import Path

import pytest

from service.core.records.run_events import ActionRefused, OperatorAction, SessionStarted
from tests.support.pages.browsed_run import BrowsedRun
from tests.support.pages.forms import PageForm, forms_of
from tests.support.pages.states import STATES, Seen, asked_for_control, by_hand, capturing, looking_on, submit
from tests.support.pages.web import WebSite, web_site
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import capture

# Not what a form is about: who sends it, what kind of thing is done, and where the page goes then.
NOT_SUBJECT = {"csrf", "verb", "back", "seen_seq"}
# What is done to the run as a whole, whatever it does meanwhile.
OF_THE_RUN = {("actions", "pause"), ("actions", "abort"), ("go-on", "")}


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def kind(form: PageForm) -> tuple[str, str]:
    """What a form does: the end of its address, and its verb."""
    return re.sub(r"^/runs/[^/]+/", "", form.action), form.hidden.get("verb", "")


def changed(value: str) -> str:
    """Another subject of the same kind."""
    if value in ("true", "false"):
        return "false" if value == "true" else "true"
    return str(int(value) + 1) if value.isdecimal() else f"{value}x"


def refuse_every_other_subject(seen: Seen) -> set[tuple[str, str]]:
    """Send each form as if it were about something else; returns the kinds of the forms."""
    log = seen.web.site.run(seen.run)
    kinds: set[tuple[str, str]] = set()
    for form in seen.forms():
        subject = set(form.hidden) - NOT_SUBJECT
        assert bool(subject) != (kind(form) in OF_THE_RUN), f"{kind(form)} sends {sorted(subject)}"
        for field in subject:
            status, said = seen.send(form, **{field: changed(form.hidden[field])})
            assert status in (404, 409), f"{kind(form)} about another {field}: {status} {said}"
        kinds.add(kind(form))
    now = seen.web.site.run(seen.run)
    new = [event.payload for event in now.events[len(log.events) :]]
    assert all(isinstance(payload, ActionRefused) for payload in new), new
    return kinds


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.__name__)
def test_a_form_about_something_else_is_refused(web: WebSite, state: Callable[[WebSite], Seen]) -> None:
    seen = state(web)
    assert refuse_every_other_subject(seen)


@pytest.mark.slow
def test_a_form_of_a_capture_by_hand_about_something_else_is_refused(web: WebSite, tmp_path: Path) -> None:
    with by_hand(tmp_path, web) as seen:
        assert ("held", "") in refuse_every_other_subject(seen)


def test_the_walk_meets_every_form_of_every_part(tmp_path: Path) -> None:
    """A form that no state of the walk shows would not be judged."""
    templates = Path("service/web/templates")
    live = [
        *templates.glob("run/parts/*.j2"),
        *templates.glob("*/macros.html.j2"),
        templates / "run/notes.html.j2",
        templates / "page/banner.html.j2",
    ]
    written = {
        re.sub(r"^/runs/{{ *[\w.]+ *}}/", "", action)
        for path in live
        for action in re.findall(r'<form[^>]* method="post" action="(/runs/[^"]+)"', path.read_text())
    }
    met: set[tuple[str, str]] = set()
    for number, state in enumerate((*STATES, None)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with web_site(folder) as web:
            if state is not None:
                met |= {kind(form) for form in state(web).forms()}
                continue
            with by_hand(folder, web) as seen:
                met |= {kind(form) for form in seen.forms()}
    assert written <= {address for address, _ in met}
    verbs = {verb for address, verb in met if address == "actions"}
    assert verbs == {"confirm", "sign", "redo", "skip", "accept", "pause", "resume", "abort"}


# --- redo --------------------------------------------------------------------------------------------------------


@pytest.fixture
def shown(web: WebSite) -> BrowsedRun:
    seen = capturing(web)
    return BrowsedRun(web, seen.browser, seen.run)


def redo_of(shown: BrowsedRun) -> PageForm:
    (form,) = (f for f in forms_of(shown.html()) if f.hidden.get("viewpoint"))
    return form


def sent(shown: BrowsedRun, form: PageForm) -> tuple[int, str]:
    return submit(shown.browser, form.action, form.sent())


def redone(shown: BrowsedRun) -> list[str]:
    done = (event.payload for event in shown.site.store.events(shown.run))
    return [act.viewpoint or "" for act in done if isinstance(act, OperatorAction) and act.action == "redo"]


def test_an_open_redo_is_of_the_image_that_it_named(shown: BrowsedRun) -> None:
    form = redo_of(shown)
    capture(shown.site, shown.run, "capture", "v1_002", EYE, shade=2)
    assert redo_of(shown).hidden["viewpoint"] == "v1_002", "the page goes on with the newest image"
    assert sent(shown, form)[0] == 303
    assert redone(shown) == ["v1_001"]


def test_a_redo_of_an_image_that_was_replaced_meanwhile_is_refused(shown: BrowsedRun) -> None:
    form = redo_of(shown)
    assert sent(shown, form)[0] == 303
    status, said = sent(shown, form)
    assert status == 409
    assert "v1_001 has no image any more" in said
    capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=2)
    status, said = sent(shown, form)
    assert status == 409
    assert "v1_001 has another image by now" in said
    assert redone(shown) == ["v1_001"]


def test_a_redo_says_whether_the_robot_drives_and_does_no_other(shown: BrowsedRun) -> None:
    store, run = shown.site.store, shown.run
    moving = redo_of(shown)
    assert moving.held
    assert "Hold for 1.5 s." in shown.words()
    assert "the robot will drive to v1_001" in shown.words()
    store.record(run, [OperatorAction(action="pause")], actor="grace")
    still = redo_of(shown)
    assert not still.held
    assert "The run is paused: nothing moves until it is resumed." in shown.words()
    assert "will drive" not in shown.words()
    status, said = sent(shown, moving)
    assert status == 409
    assert "the robot would not drive to v1_001 at once, which the form did not say" in said
    store.record(run, [OperatorAction(action="resume")], actor="grace")
    status, said = sent(shown, still)
    assert status == 409
    assert "the robot would drive to v1_001 at once, which the form did not say" in said
    assert redone(shown) == []
    store.record(run, [SessionStarted(resumed=True, software={}, host="bench", pid=1)], actor="runner")
    assert not redo_of(shown).held, "a restarted runner asks before the robot moves"


def test_the_address_of_an_image_leads_to_its_own_redo(shown: BrowsedRun) -> None:
    capture(shown.site, shown.run, "capture", "v1_002", EYE, shade=2)
    html = shown.html(viewpoint="v1_001")
    assert 'data-keep="redo-v1_001"' in unescape(html)


# --- control -----------------------------------------------------------------------------------------------------


def test_control_goes_to_the_one_whom_the_notice_named(web: WebSite) -> None:
    mine = asked_for_control(web)
    form = mine.form("control/answer")
    web.store.clock.sleep(61)
    third = Seen(web, web.browser("supervisor"), mine.run)
    assert third.send(third.form("control/ask"))[0] == 303
    status, said = mine.send(form)
    assert status == 409
    assert "by now it is Emmy Noether who asks for control" in said


def test_a_take_over_is_from_the_one_whom_the_dialog_named(web: WebSite) -> None:
    other = looking_on(web)
    form = other.form("control/take")
    web.take_control(other.run, web.browser("technician"))
    status, said = other.send(form)
    assert status == 409
    assert "by now Grace Hopper has control" in said
