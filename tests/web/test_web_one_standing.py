"""Every state of a run, on every page, for every role: one model of how it stands gives all words, and they agree."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from html import unescape

import pytest

from service.core.records.run_events import DeviceOpened, DeviceTrouble, FilesKept, OperatorAction, RecordedView
from service.core.recovery import ways_on
from service.monitor.snapshot import RobotPhase, Snapshot, write_snapshot
from service.people.person import ROLES, Role, may
from service.web.run_frame import RunStanding, run_standing
from tests.support.pages.browsed_run import words
from tests.support.pages.shown_site import ShownSite, shown_site
from tests.support.pages.states import BEGUN
from tests.support.pages.web import WebSite, web_site
from tests.support.record.outsider import copy_data

_PAGES = ("", "/capture", "/scene", "/calibration", "/dataset")
_STATES = (
    "listing", "moving", "signing", "failed", "acceptable", "held", "calibrated", "completed", "paused", "died",
    "aborted", "working", "pausing", "arm_stopped", "arm_emergency", "arm_fault", "arm_lost",
)  # fmt: skip
# What the runner reported last of the robot.
_ROBOTS: dict[str, RobotPhase] = {
    "working": "moving",
    "pausing": "moving",  # a pause was asked for, and the motion under way is not over yet
    "arm_stopped": "protective_stop",
    "arm_emergency": "emergency_stop",
    "arm_fault": "fault",
    "arm_lost": "not_connected",
}
_BANNERS = {"pausing": "pausing", "arm_lost": "lost"}  # where the banner's key is not the robot's phase
_STOPPED = {"arm_stopped", "arm_emergency", "arm_fault", "arm_lost"}
_LOST = (
    DeviceOpened(device="robot", report={"identity": {"kind": "robot"}}),
    DeviceTrouble(device="robot", error="DeviceUnavailableError", message="no answer", connection="died"),
)
_MODES = {"ask", "sign", "recover", "work", "paused", "died", "ended"}


@dataclass(frozen=True)
class Shown:
    """Runs in every state, each by the name of its state."""

    web: WebSite
    runs: dict[str, str]
    homes: dict[Role, tuple[str, ...]] = field(default_factory=dict[Role, tuple[str, ...]])

    def home(self, role: Role) -> tuple[str, ...]:
        """The first page, which is the same for all runs: both parts of its list."""
        if role not in self.homes:
            browser = self.web.browser(role)
            self.homes[role] = tuple(browser.get("/", params={"page": page}).text for page in (1, 2))
        return self.homes[role]

    def stands(self, which: str) -> RunStanding:
        log = self.web.site.run(self.runs[which])
        driven = self.web.site.launcher.driven(log.run_id)
        return run_standing(log.protocol, log.state, driven=driven, robot=_ROBOTS.get(which, "not_connected"))


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    recorded: ShownSite = shown_site(tmp_path_factory.mktemp("stands"))
    folder = copy_data(recorded.folder, tmp_path_factory.mktemp("stands") / "site")
    with web_site(folder) as web:
        runs = {name: str(getattr(recorded, name)) for name in _STATES[:8]}
        runs |= {name: web.begin_run().run_id for name in ("paused", "died", "aborted", *_ROBOTS)}
        for run_id in (*recorded.under_way, runs["paused"], *(runs[name] for name in _ROBOTS)):
            web.site.launcher.start(run_id)
        for name, robot in _ROBOTS.items():
            more = _LOST if name == "arm_lost" else ()
            web.store.record(runs[name], [*BEGUN, *more], actor="ada")
            reported = {"at_utc_s": web.now_utc_s, "doing": "working", "robot": robot}
            write_snapshot(web.site.data, runs[name], Snapshot.model_validate(reported))
        for name, verb in (("paused", "pause"), ("pausing", "pause"), ("aborted", "abort")):
            web.store.record(
                runs[name], [OperatorAction.model_validate({"action": verb, "reason": "x"})], actor="ada"
            )
        yield Shown(web, runs)


def test_the_states_are_all_there(shown: Shown) -> None:
    assert {shown.stands(which).mode for which in _STATES} == _MODES


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("which", _STATES)
def test_all_pages_tell_the_same(shown: Shown, which: str, role: Role) -> None:
    stands, run_id = shown.stands(which), shown.runs[which]
    browser = shown.web.browser(role)
    pages = {page: browser.get(f"/runs/{run_id}{page}").text for page in _PAGES}
    banners = {re.findall(r'data-robot="(\w+)"', html)[-1] for html in pages.values()}
    assert len(banners) == 1
    assert which not in _ROBOTS or banners == {_BANNERS.get(which, _ROBOTS[which])}
    for page, html in pages.items():
        alert = re.search(rf'data-attention="(\w+)" data-words="([^"]*)" data-of="{run_id}"', html)
        assert alert is not None, page
        assert (alert[1], unescape(alert[2])) == (stands.key, stands.alert), page
        goes_on = re.search(r"<span data-goes-on( hidden)?>", html)
        assert goes_on is not None
        assert bool(goes_on[1]) == (stands.mode == "ended"), page  # nothing goes on in a run that has ended
    _listed(shown.home(role), run_id, stands)
    _guided(pages[""], stands, role)
    _counted(shown, pages[""], which)


def test_a_stopped_or_lost_arm_is_said_before_all_else(shown: Shown) -> None:
    """Whatever the run works on or was paused at: people who look from afar learn of the arm first."""
    said = {which: shown.stands(which) for which in _ROBOTS}
    assert {which for which, stands in said.items() if stands.key == "stopped"} == _STOPPED
    assert len({stands.why for which, stands in said.items() if which in _STOPPED}) == len(_STOPPED)
    for which in _STOPPED:
        assert said[which].alert.lower().startswith(said[which].why.lower())


def _listed(pages: tuple[str, ...], run_id: str, stands: RunStanding) -> None:
    """What the first page says of the run."""
    mine = f'href="/runs/{run_id}"'
    if stands.mode == "ended":
        (row,) = {row for home in pages for row in home.split("<tr") if mine in row}
        assert stands.word.lower() in words(row).lower()
        return
    (row,) = {item for home in pages for item in home.split("<li") if mine in item and "<h3>" in item}
    assert stands.word in words(row)
    assert stands.why in words(row)


def _guided(page: str, stands: RunStanding, role: Role) -> None:
    """What the guided screen says, and what it offers."""
    assert unescape(re.findall(r'data-news="([^"]*)"', page)[-1]).startswith(stands.headline)
    title = re.search(r"<title>(.*?) · ", page)
    tab = re.search(r'data-title="([^"]*)"', page)
    assert title is not None
    assert tab is not None
    assert title[1] == tab[1]
    if stands.mode == "ended":
        assert tab[1].startswith("Run ")
        assert "decides on the next action" not in page
    if not may(role, "operate"):
        assert "Take control to act" not in page


def _counted(shown: Shown, page: str, which: str) -> None:
    """The numbers of photographs on one page are those of the record."""
    run_id = shown.runs[which]
    log = shown.web.site.run(run_id)
    payloads = [event.payload for event in log.events]
    taken = sum(isinstance(payload, RecordedView) for payload in payloads)
    kept = [ref for payload in payloads if isinstance(payload, FilesKept) for ref in payload.artefacts]
    taken += sum(ref.kind == "layout_image" for ref in kept)
    said = words(page)
    safe = re.search(r"Is the data safe Yes\. (?:(\d+) photographs? (?:is|are) recorded|Everything so far)", said)
    assert ("Is the data safe" in said) == (safe is not None)
    if safe is not None:
        assert int(safe[1] or 0) == taken
    step = re.search(r"This step (\d+) of (\d+)", said)
    notice = re.search(r"(\d+) of (\d+) images of this step are in the record", said)
    if step is not None and notice is not None:
        assert step.groups() == notice.groups()


@pytest.mark.parametrize("which", ["failed", "acceptable"])
def test_only_what_is_recommended_is_blue(shown: Shown, which: str) -> None:
    """The large button is the recommended way, or it says that it is not and stands back."""
    run_id = shown.runs[which]
    log = shown.web.site.run(run_id)
    first = next(way for way in ways_on(log.protocol, log.state) if way.available)
    browser = shown.web.browser("technician")
    shown.web.take_control(run_id, browser)
    page = browser.get(f"/runs/{run_id}").text
    row = page[page.index("Recommended") :].split("</tr>", 1)[0]
    main = re.search(r'<form class="main-action".*?<button class="target ([^"]*)"', page, re.DOTALL)
    assert main is not None
    assert ("primary" in main[1]) == (first.verb == "confirm")
    assert ('class="button primary"' in row) == (first.verb != "confirm")
    assert ("Not what is recommended." in page) == (first.verb != "confirm")
    shown.web.people.sign_out(browser.person)


def test_nobody_is_told_that_they_themselves_decide_somewhere_else(shown: Shown) -> None:
    """On another screen of the person in control, the page says You; on that of somebody else, the name."""
    run_id = shown.runs["listing"]
    first, second = shown.web.browser("technician"), shown.web.browser("technician")
    shown.web.take_control(run_id, first)
    mine, others = (
        words(browser.get(f"/runs/{run_id}").text) for browser in (second, shown.web.browser("supervisor"))
    )
    assert "You decide on the next action, on your other screen" in mine
    assert "Grace Hopper decides" not in mine
    assert "Grace Hopper decides on the next action" in others
    shown.web.people.sign_out(first.person)
