"""Goes through the demonstration as two people at two tablets do, and takes a picture of each moment.

With one view taken again, one lost connection to the robot, and one change of control. Look at the pictures: they
lie in build/by_hand. Printed is what was done, and what the page said then.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml
from playwright.sync_api import TimeoutError as PlaywrightTimeoutError
from playwright.sync_api import expect

from bench.machine import REPOSITORY
from tests.support.pages.accounts import add_people
from tests.support.pages.browser import TABLET, Screen, Served, chromium, screen, served
from tests.support.pages.technician import ANSWER_MS, Technician
from tests.support.protocols.small_demo import COARSE, SLICE_MM
from tests.support.rig.rig import simulated_rig

FOLDER = REPOSITORY / "build" / "by_hand"
HOST = "127.0.0.49"
DROPPED_MOTION = 5  # of the calibration
STEP_S = 600.0  # after which a step does not end any more
REDO_AT, HAND_OVER_AT = "Viewpoint capture at station 1", "Move the robot to station 2"
REASON = "A drape hung into the picture"


def main(arguments: Sequence[str] | None = None) -> int:
    """Walk through the demonstration, and list what was done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, default=FOLDER)
    parser.add_argument("--scene", type=int, default=7)
    parser.add_argument("--speed-up", type=float, default=6.0)
    options = parser.parse_args(arguments)
    options.into.mkdir(parents=True, exist_ok=True)
    for old in options.into.glob("*.png"):
        old.unlink()
    fault = {"device": "robot", "on": "move", "kind": "drop", "nth": DROPPED_MOTION}
    rig = ("--scene", str(options.scene), "--image-width", "720", "--speed-up", str(options.speed_up), *COARSE)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "rig").mkdir()
        protocols = _protocols(folder / "protocols")
        with (
            simulated_rig(folder / "rig", *rig, "--faults", json.dumps([fault]), host=HOST) as ready,
            served(Path(ready["rig"]), folder / "data", "--protocols", str(protocols)) as server,
        ):
            add_people(folder / "data", [("tina", "technician"), ("sam", "supervisor")])
            with (
                chromium() as browser,
                screen(browser, server.url, TABLET) as first,
                screen(browser, server.url, TABLET) as second,
            ):
                walk = Walk(server, first, second, options.into)
                walk.go()
    return 0


def _protocols(folder: Path) -> Path:
    """Write demo.yaml with a coarse CT and without structure from motion; all else is the demonstration's."""
    document: dict[str, Any] = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    for step in document["steps"]:
        if step["kind"] == "registration":
            step["params"]["poses"] = ["robot", "robot_corrected"]
        if step["kind"] == "ground_truth":
            step["params"]["chamfer_spacing_mm"] = 2.0
        for gate in step.get("gates", []):
            if gate["measure"] == "slice_spacing_mm":
                gate["max"] = SLICE_MM
    folder.mkdir()
    (folder / "demo.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    return folder


class Walk:
    """One run, by Tina until she hands over, and then by Sam."""

    def __init__(self, server: Served, first: Screen, second: Screen, into: Path) -> None:
        self._server, self._first, self._second, self._into = server, first, second, into
        self._hands = Technician(first)
        self._mends, self._taken, self._began_s = 0, 0, time.monotonic()
        self._shown: set[str] = set()
        self._done: set[str] = set()  # of redo, lost, control
        self._run = ""

    def go(self) -> None:
        """Start the run and go on to its end."""
        self._start()
        step, since_s = "", time.monotonic()
        while self._hands.page.get_by_role("heading", name="The run is complete").count() == 0:
            if time.monotonic() - since_s > STEP_S:
                self._picture("stuck")
                raise SystemExit(f"{step}: no progress\n{self._server.log()}\n{self._hands.tablet.words()}")
            try:
                now = self._hands.page.get_by_role("heading", level=1).inner_text(timeout=5_000)
                step, since_s = (step, since_s) if now == step else (now, time.monotonic())
                self._look(now)
                self._hands.do_what_is_asked()
            except PlaywrightTimeoutError:  # the page changed meanwhile: look again
                continue
        self._end()

    def _start(self) -> None:
        tablet, page = self._first, self._first.page
        tablet.sign_in("tina")
        tablet.go("/")
        self._picture("home")
        page.get_by_role("button", name="Start Demonstration on a simulated rig").click()
        page.get_by_label("Specimen").fill("S1")
        self._picture("start")
        page.get_by_role("button", name="Start the run").click()
        expect(page.get_by_role("checkbox").first).to_be_visible(timeout=ANSWER_MS)
        self._run = page.url.rpartition("/")[2]

    def _look(self, step: str) -> None:
        """Take a picture of what is new, and do what this walk adds to what the page asks for."""
        page = self._hands.page
        stopped = page.locator(".notice-stop:has(dl)")
        looked = page.get_by_role("button", name=re.compile("^I have looked"))
        if looked.count():
            self._lost(looked)
        elif stopped.count():
            self._once(f"stopped {step}")
        elif step.startswith(REDO_AT) and "redo" not in self._done and self._works():
            self._redo()
        elif step.startswith(HAND_OVER_AT) and "control" not in self._done:
            self._hand_over()
        else:
            self._once(f"{step}{' works' if self._works() else ''}")

    def _works(self) -> bool:
        return self._hands.page.locator("section.working").count() > 0

    def _lost(self, looked: Any) -> None:
        if "lost" not in self._done:
            self._done.add("lost")
            self._picture("lost")
            self._hands.page.locator("h1").scroll_into_view_if_needed()
            self._hands.page.goto(f"{self._first.url}/runs/{self._run}/capture")
            self._picture("lost, capture page")
            self._hands.page.goto(f"{self._first.url}/runs/{self._run}")
        looked.first.click()
        expect(looked).to_have_count(0, timeout=ANSWER_MS)
        self._picture("lost, looked")

    def _redo(self) -> None:
        """Take the newest view again, from the page of the images, while the robot goes on."""
        page = self._hands.page
        page.goto(f"{self._first.url}/runs/{self._run}/capture")
        redo = page.locator("details.redo summary")
        expect(redo.first).to_be_visible(timeout=ANSWER_MS)
        self._picture("capture")
        redo.first.click()
        page.get_by_label("Reason in your own words").fill(REASON)
        self._picture("redo form")
        button = page.locator("details[open] form button[data-hold]")
        said = button.inner_text().splitlines()[0]
        button.focus()
        page.keyboard.down("Enter")
        expect(page.locator("details[open] form")).to_have_count(0, timeout=ANSWER_MS)
        page.keyboard.up("Enter")
        self._done.add("redo")
        self._say(f"held: {said}")
        self._picture("redo asked for")
        page.wait_for_timeout(4_000)
        self._picture("redo done")
        page.goto(f"{self._first.url}/runs/{self._run}")
        self._picture("step after the redo")

    def _hand_over(self) -> None:
        """Sam asks, Tina hands over, and Sam goes on."""
        mine, other = self._first.page, self._second.page
        self._second.sign_in("sam")
        self._second.go(f"/runs/{self._run}")
        self._picture("sam looks on", self._second)
        other.get_by_role("button", name="Ask for control").click()
        grant = mine.get_by_role("button", name="Hand over")
        expect(grant).to_be_visible(timeout=ANSWER_MS)
        self._picture("tina is asked")
        self._picture("sam waits", self._second)
        grant.click()
        expect(other.get_by_role("button", name="End run")).to_be_visible(timeout=ANSWER_MS)
        expect(mine.get_by_role("button", name="Ask for control")).to_be_visible(timeout=ANSWER_MS)
        self._picture("tina has handed over")
        self._picture("sam has control", self._second)
        self._mends = self._hands.mends.total()
        self._hands = Technician(self._second)
        self._done.add("control")

    def _end(self) -> None:
        self._picture("complete")
        self._picture("complete, on the first screen", self._first)
        tablet, page = self._second, self._second.page
        for name, path in (
            ("audit", f"/audit/runs/{self._run}"),
            ("deviations", f"/audit/runs/{self._run}/deviations"),
            ("images", f"/runs/{self._run}/capture"),
            ("verification", f"/audit/runs/{self._run}/verification"),
        ):
            tablet.go(path)
            self._picture(name)
        page.get_by_role("button", name="Verify now").click()
        expect(page.get_by_role("heading", name="Verifies")).to_be_visible(timeout=2 * ANSWER_MS)
        self._picture("verified")
        missing = {"redo", "lost", "control"} - self._done
        if missing:
            raise SystemExit(f"this walk had no {', '.join(sorted(missing))}")
        followed = self._mends + self._hands.mends.total()
        self._say(f"{followed} times advice was followed; {self._taken} pictures in {self._into}")

    def _once(self, moment: str, do: Callable[[str], None] | None = None) -> None:
        if moment not in self._shown:
            self._shown.add(moment)
            (do or self._picture)(moment)

    def _picture(self, moment: str, tablet: Screen | None = None) -> None:
        shown = tablet or self._hands.tablet
        self._taken += 1
        name = f"{self._taken:02d}-{re.sub('[^a-z0-9]+', '_', moment.lower()).strip('_')}.png"
        shown.page.wait_for_timeout(400)
        shown.page.screenshot(path=self._into / name)
        banner = shown.page.locator("#robot-banner")
        said = " ".join(banner.inner_text(timeout=5_000).split()) if banner.count() else ""
        self._say(f"{name}: {shown.page.title()} | {said}")

    def _say(self, what: str) -> None:
        sys.stdout.write(f"{time.monotonic() - self._began_s:6.1f} s  {what}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
