"""A run in every state in which a person meets it, with the person at the page and the forms that the page has."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from service.core.records.run_events import DeviceOpened, DeviceTrouble, OperatorAction, StepStarted
from service.monitor.snapshot import Snapshot, write_snapshot
from tests.support.pages.at_the_table import left_at
from tests.support.pages.forms import PageForm, forms_of
from tests.support.pages.web import Browser, WebSite, password_of
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import begin_calibrated_run, capture
from tests.support.runs.bench_run import PROTOCOL
from tests.support.runs.held_run import left_held_run

ACCEPTING = PROTOCOL.replace("viewpoints_captured, min: 3", "viewpoints_captured, min: 5, accept_by: supervisor")
SKIPPED = OperatorAction(action="skip", step="fixation", reason="done before")
BEGUN = (SKIPPED, OperatorAction(action="confirm", step="capture"), StepStarted(step="capture", attempt=1))
PARTS = {
    "": "banner,control,vitals,step,actions,dialogs,side",
    "capture/": "image,plan,sheet",
    "held/": "way,image,plan,overlay",
}


@dataclass
class Seen:
    """A person at a run."""

    web: WebSite
    browser: Browser
    run: str

    def forms(self) -> list[PageForm]:
        """The forms in all parts that this person sees of the run."""
        found: list[PageForm] = []
        for folder, names in PARTS.items():
            answer = self.browser.get(f"/runs/{self.run}/{folder}parts/{names}")
            assert answer.status_code == 200, answer.text
            found += forms_of(answer.text)
        return found

    def form(self, address: str, verb: str = "") -> PageForm:
        """The one form of that address and verb."""
        (found,) = [f for f in self.forms() if f.action.endswith(address) and f.hidden.get("verb", "") == verb]
        return found

    def send(self, form: PageForm, **other: str) -> tuple[int, str]:
        """Fill a form in and send it; `other` fields in place of the page's."""
        filled = {key: value or self._own(form, key) for key, value in form.sent(**other).items()}
        return submit(self.browser, form.action, filled)

    def _own(self, form: PageForm, field: str) -> str:
        account = "emmy" if form.hidden.get("verb") == "accept" else self.browser.person.account
        return {"account": account, "password": password_of(account)}.get(field, "")


def submit(browser: Browser, action: str, filled: dict[str, str]) -> tuple[int, str]:
    """Send a form as the page's script does; returns the status, and what was wrong."""
    answer = browser.post(action, data=filled, headers={"Accept": "application/json"}, follow_redirects=False)
    return answer.status_code, answer.json()["what"] if answer.is_error else ""


def at(web: WebSite, run: str, *, doing: str = "asking") -> Seen:
    """The technician, who controls the run, which a runner drives."""
    web.site.launcher.start(run)
    write_snapshot(web.site.data, run, Snapshot.model_validate({"at_utc_s": web.now_utc_s, "doing": doing}))
    browser = web.browser("technician")
    web.take_control(run, browser)
    return Seen(web, browser, run)


def asked(web: WebSite) -> Seen:
    return at(web, web.begin_run().run_id)


def about_to_move(web: WebSite) -> Seen:
    run = web.begin_run().run_id
    web.store.record(run, [SKIPPED], actor="grace")
    return at(web, run)


def paused(web: WebSite) -> Seen:
    run = web.begin_run().run_id
    web.store.record(run, [*BEGUN, OperatorAction(action="pause")], actor="grace")
    return at(web, run, doing="paused")


def stopped(web: WebSite) -> Seen:
    return at(web, left_at(web, "capture", "recovery", ACCEPTING).run_id)


def to_sign(web: WebSite) -> Seen:
    return at(web, left_at(web, "spraying", "sign").run_id)


def died(web: WebSite) -> Seen:
    run = web.begin_run().run_id
    browser = web.browser("technician")
    web.take_control(run, browser)
    return Seen(web, browser, run)


def arm_lost(web: WebSite) -> Seen:
    run = web.begin_run().run_id
    opened = DeviceOpened(device="robot", report={"identity": {"kind": "robot"}})
    lost = DeviceTrouble(device="robot", error="DeviceUnavailableError", message="no answer", connection="died")
    web.store.record(run, [opened, lost], actor="runner")
    return at(web, run)


def asked_for_control(web: WebSite) -> Seen:
    mine = asked(web)
    other = Seen(web, web.browser("supervisor"), mine.run)
    assert other.send(other.form("control/ask"))[0] == 303
    return mine


def looking_on(web: WebSite) -> Seen:
    return Seen(web, web.browser("supervisor"), asked(web).run)


def waiting_for_an_answer(web: WebSite) -> Seen:
    other = looking_on(web)
    assert other.send(other.form("control/ask"))[0] == 303
    return other


def on_another_screen(web: WebSite) -> Seen:
    return Seen(web, web.browser("technician"), asked(web).run)


def capturing(web: WebSite) -> Seen:
    run = begin_calibrated_run(web)
    capture(web, run, "capture", "v1_001", EYE, shade=1)
    return at(web, run, doing="working")


@contextmanager
def by_hand(folder: Path, web: WebSite) -> Generator[Seen]:
    with pytest.MonkeyPatch.context() as patch:
        bench = left_held_run(web.begin_run, patch, folder)
        yield at(web, bench.run_id)


STATES: tuple[Callable[[WebSite], Seen], ...] = (
    asked,
    about_to_move,
    paused,
    stopped,
    to_sign,
    died,
    arm_lost,
    asked_for_control,
    looking_on,
    waiting_for_an_answer,
    on_another_screen,
    capturing,
)
