"""Five tasks by somebody who knows only the page; the clicks that each takes are stated in docs/screens/tasks.md."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import yaml
from playwright.sync_api import Browser, Locator, Page, expect

from tests.support.pages.accounts import PASSWORD, add_people
from tests.support.pages.browser import Screen, Served, screen, served
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, simulated_rig

pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.timeout(600)]

LONG_MS = 240_000
STATED = REPOSITORY / "docs" / "screens" / "tasks.md"


@dataclass
class Person:
    """A person at a screen, whose clicks, typed fields and seconds per task are counted."""

    tablet: Screen
    page: Page = field(init=False)
    clicks: int = 0
    fields: int = 0

    def __post_init__(self) -> None:
        self.page = self.tablet.page

    def click(self, button: Locator) -> None:
        """Press a visible button once it is enabled."""
        expect(button).to_be_enabled(timeout=LONG_MS)
        button.click()
        self.clicks += 1

    def hold(self, button: Locator) -> None:
        """Hold the button that moves the robot until it reports success; again if the page changed meanwhile."""
        held = button.locator("xpath=self::*[contains(@class, 'held')]")
        for _ in range(3):
            expect(button).to_be_enabled(timeout=LONG_MS)
            button.hover()
            self.page.mouse.down()
            self.page.wait_for_timeout(1800)
            until(lambda: held.count() == 0, "it was held")
            self.page.mouse.up()
            if self._taken(button):
                break
        self.clicks += 1

    def _taken(self, button: Locator) -> bool:
        """Whether the page goes on within ten seconds."""
        for _ in range(50):
            if button.and_(self.page.locator(":not(:disabled)")).count() == 0:
                return True
            self.page.wait_for_timeout(200)
        return False

    def write(self, into: Locator, words: str) -> None:
        """Fill in a field."""
        into.fill(words)
        self.fields += 1

    def tick_all(self) -> None:
        """Tick every item of a checklist, in order."""
        unticked = self.page.locator("[role=checkbox][aria-checked=false]:not([disabled])")
        expect(unticked.first).to_be_visible(timeout=LONG_MS)
        while left := unticked.count():
            self.click(unticked.first)
            expect(unticked).to_have_count(left - 1)

    def main_action(self, words: str) -> Locator:
        """The large button."""
        return self.page.locator(".actions").get_by_role("button", name=re.compile(words))


@dataclass
class Tasks:
    """The measurements: clicks, fields and seconds of each task."""

    measured: dict[str, tuple[int, int, float]] = field(default_factory=dict[str, tuple[int, int, float]])

    @contextmanager
    def task(self, name: str, person: Person) -> Generator[None]:
        """Measure what the person does inside the block; at its end the page says what to do next."""
        clicks, fields, began_s = person.clicks, person.fields, time.monotonic()
        yield
        seconds = time.monotonic() - began_s
        self.measured[name] = person.clicks - clicks, person.fields - fields, round(seconds, 1)
        nexts = person.page.locator("main").get_by_role("button").or_(person.page.locator("main").get_by_role("link"))
        assert nexts.count(), f"{name} ends without a next action: {person.tablet.words()}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("tasks")
    options = ("--scene", "7", "--image-width", "780", "--speed-up", "10")
    (folder / "rig").mkdir()
    with (
        simulated_rig(folder / "rig", *options, host="127.0.0.50") as ready,
        served(Path(ready["rig"]), folder / "data", "--protocols", str(_protocols(folder))) as running,
    ):
        add_people(folder / "data", [("tina", "technician"), ("sam", "supervisor")])
        yield running


def _protocols(folder: Path) -> Path:
    """Steps of demo.yaml, with too few board poses for the calibration, and a gate that only supervisors accept."""
    protocol = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    steps: dict[str, dict[str, Any]] = {step["id"]: step for step in protocol["steps"]}
    calibration, capture = steps["camera_calibration"], steps["viewpoint_capture_1"]
    for arc, count in zip(calibration["params"]["viewpoints"][0]["arcs"], (2, 2, 4), strict=True):
        arc["count"] = count
    capture["params"].pop("live", None)
    capture["params"]["viewpoints"][0]["arcs"] = [
        {"tilt_deg": 25, "azimuth_from_deg": -40, "azimuth_to_deg": 40, "count": 4, "distance_m": 0.62}
    ]
    capture["requires"] = ["camera_calibration"]
    capture["gates"] = [
        {"measure": "viewpoints_captured", "min": 5, "unit": "views", "accept_by": "another_supervisor"}
    ]
    protocol |= {"id": "tasks", "title": "Five tasks", "release": "none"}
    protocol["steps"] = [steps["camera_set_up"], calibration, steps["board_removal"], capture]
    (folder / "protocols").mkdir()
    (folder / "protocols" / "tasks.yaml").write_text(yaml.safe_dump(protocol, sort_keys=False))
    return folder / "protocols"


def stated() -> dict[str, tuple[int, int]]:
    """Clicks and fields of each task, from the table in the documentation."""
    rows = re.findall(r"^\| ([^|]+) \| (\d+) \| (\d+) \|", STATED.read_text(encoding="utf-8"), re.MULTILINE)
    return {name.strip(): (int(clicks), int(fields)) for name, clicks, fields in rows}


def failed(page: Page) -> Locator:
    """The page's message when figures are outside their limits."""
    return page.locator(".notice-stop.stopped")


def test_five_tasks_need_no_more_clicks_than_are_stated(server: Served, browser: Browser) -> None:
    tasks = Tasks()
    with screen(browser, server.url) as tablet:
        person, page = Person(tablet), tablet.page
        tablet.sign_in("tina")
        tablet.go("/")
        with tasks.task("Start a run", person):
            person.click(page.get_by_role("button", name="Start Five tasks"))
            person.write(page.get_by_label("Specimen"), "pig spine 12")
            person.click(page.get_by_role("button", name="Start the run"))
            expect(page.get_by_role("checkbox").first).to_be_visible(timeout=LONG_MS)
        person.tick_all()
        person.click(person.main_action("^Confirm"))
        person.hold(person.main_action("^Confirm: the robot"))

        expect(failed(page)).to_be_visible(timeout=LONG_MS)
        with tasks.task("Mend a failed calibration", person):
            person.hold(person.main_action("^Try again"))
            expect(page.get_by_role("heading", level=1, name="Remove the calibration board")).to_be_visible(
                timeout=LONG_MS
            )
        person.tick_all()
        person.click(person.main_action("^Confirm"))
        person.hold(person.main_action("^Confirm: the robot"))

        expect(failed(page)).to_be_visible(timeout=LONG_MS)
        with tasks.task("Redo a viewpoint", person):
            person.click(page.get_by_role("link", name=re.compile("^Capture")).first)
            person.click(page.get_by_role("link", name=re.compile("v1_002")).last)
            person.click(page.get_by_text("Redo v1_002…"))
            person.click(page.get_by_label("Something stood in the view"))
            person.click(page.get_by_role("button", name="Redo v1_002"))
            person.click(page.get_by_role("link", name="Step", exact=True))
            person.hold(person.main_action("^Try again|^Confirm"))
            expect(failed(page)).to_be_visible(timeout=LONG_MS)

        with tasks.task("Accept a gate with a supervisor", person):
            person.click(page.locator("table.ways").get_by_role("button", name="Accept…"))
            person.click(page.get_by_label("Only just outside"))
            person.write(page.get_by_label("Name of the supervisor"), "sam")
            person.write(page.get_by_label("Password of the supervisor"), PASSWORD)
            person.click(page.get_by_role("button", name="Accept and sign"))
            expect(page.get_by_role("heading", name="The run is complete")).to_be_visible(timeout=LONG_MS)
        run = page.url.rpartition("/")[2]

    with screen(browser, server.url) as desk:
        person, page = Person(desk), desk.page
        desk.sign_in("sam")
        desk.go(f"/runs/{run}")
        with tasks.task("Export", person):
            person.click(page.get_by_role("link", name="Release and export"))
            person.click(page.get_by_role("button", name="Evidence bundle"))
            expect(page.get_by_role("link", name=re.compile("SIMULATED.*zip")).first).to_be_visible(timeout=LONG_MS)

    measured = server.data.parent / "tasks.json"
    measured.write_text(json.dumps(tasks.measured, indent=1) + "\n")
    said = stated()
    for name, (clicks, fields, _seconds) in tasks.measured.items():
        assert (clicks, fields) <= said[name], f"{name}: {clicks} clicks and {fields} fields, stated {said[name]}"
