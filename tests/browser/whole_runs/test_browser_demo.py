"""The whole demonstration protocol, operated by a technician and read by an auditor, in a real browser."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from playwright.sync_api import Browser, Page, expect

from tests.support.pages.accounts import PASSWORD, add_people
from tests.support.pages.browser import DESKTOP, Served, follow, screen, served
from tests.support.pages.technician import ANSWER_MS, Technician
from tests.support.protocols.small_demo import COARSE, SLICE_MM
from tests.support.rig.rig import REPOSITORY, command, simulated_rig

# A shorter run is led through the browser in every submission: test_browser_run.py.
pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.timeout(1800)]

STEP_S = 400  # after which a step, of seconds on a quiet machine, does not end any more


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("demo")
    options = ("--scene", "7", "--image-width", "720", "--speed-up", "10", *COARSE)
    rig_folder = folder / "rig"
    rig_folder.mkdir()
    with (
        simulated_rig(rig_folder, *options, host="127.0.0.48") as ready,
        served(Path(ready["rig"]), folder / "data", "--protocols", str(_protocols(folder))) as running,
    ):
        add_people(folder / "data", [("tina", "technician"), ("sam", "supervisor"), ("otto", "auditor")])
        yield running


def _protocols(folder: Path) -> Path:
    """demo.yaml with fewer views, a coarse CT and no structure from motion; test_demo.py has all of it."""
    protocol = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    (registration,) = (step for step in protocol["steps"] if step["id"] == "registration")
    registration["params"]["poses"] = ["robot", "robot_corrected"]
    counts = {"dataset": (1, 2), "control": (2,)}
    for step in protocol["steps"]:
        for gate in step.get("gates", []):
            if gate["measure"] == "slice_spacing_mm":
                gate["max"] = SLICE_MM
        if step["kind"] == "ground_truth":
            step["params"]["chamfer_spacing_mm"] = 2.0
        if step["kind"] == "viewpoint_capture":
            views = counts[step["params"]["purpose"]]
            for arc, count in zip(step["params"]["viewpoints"][0]["arcs"], views, strict=True):
                arc["count"] = count
            step["gates"][0]["min"] = sum(views)
    (folder / "protocols").mkdir()
    (folder / "protocols" / "demo.yaml").write_text(yaml.safe_dump(protocol, sort_keys=False))
    return folder / "protocols"


@pytest.fixture(scope="module")
def run(server: Served, browser: Browser) -> str:
    """Complete a run; returns its id."""
    with screen(browser, server.url) as tablet:
        tablet.sign_in("tina")
        technician = Technician(tablet)
        name = technician.start("Demonstration on a simulated rig")
        technician.complete_the_run(STEP_S, server.log)
        assert technician.held >= 5  # calibration and four captures
        assert technician.signed >= 3  # before irreversible changes of the scene
    return name


def test_the_technician_sees_the_accuracy_at_the_end(server: Served, browser: Browser, run: str) -> None:
    with screen(browser, server.url, DESKTOP) as desk:
        desk.sign_in("tina")
        desk.go(f"/runs/{run}")
        table = desk.page.get_by_role("table").first
        expect(table.get_by_role("rowheader", name="robot corrected", exact=True)).to_be_visible(timeout=ANSWER_MS)
        errors_mm = {
            row.locator("th, td").nth(0).inner_text(): float(row.locator("th, td").nth(1).inner_text())
            for row in table.locator("tbody tr").all()
        }
        assert errors_mm["robot corrected"] < 0.15
        assert errors_mm["robot"] > errors_mm["robot corrected"]


def test_the_auditor_reads_everything_and_changes_nothing(server: Served, browser: Browser, run: str) -> None:
    with screen(browser, server.url, DESKTOP) as desk:
        page = desk.page
        desk.sign_in("otto")
        desk.go("/audit")
        follow(page.get_by_role("main").get_by_role("link", name=run))
        expect(page.get_by_role("heading", name="Deviations")).to_be_visible(timeout=ANSWER_MS)
        for name in ("Timeline", "Artefacts", "Provenance", "Corrections", "Signatures", "Devices and clocks"):
            follow(page.get_by_role("navigation", name="Audit of this run").get_by_role("link", name=name))
            expect(page.get_by_role("heading", level=1)).to_be_visible(timeout=ANSWER_MS)
        desk.go(f"/audit/runs/{run}/signatures")
        expect(page.get_by_text("Tina Example").or_(page.get_by_text("tina")).first).to_be_visible(timeout=ANSWER_MS)
        desk.go(f"/audit/runs/{run}/provenance")
        expect(page.get_by_text(re.compile("registration", re.IGNORECASE)).first).to_be_visible(timeout=ANSWER_MS)
        desk.go(f"/audit/runs/{run}/verification")
        page.get_by_role("button", name="Verify now").click()
        expect(page.get_by_role("heading", name="Verifies")).to_be_visible(timeout=ANSWER_MS)
        # Scene and calibration show figures beside the pictures.
        desk.go(f"/runs/{run}/scene")
        expect(page.get_by_role("table").first).to_be_visible(timeout=ANSWER_MS)
        desk.go(f"/runs/{run}/calibration")
        expect(page.get_by_role("table").first).to_be_visible(timeout=ANSWER_MS)
        assert refused(page, f"/runs/{run}/actions", {"verb": "redo", "reason": "no"}) == 403
        assert refused(page, f"/runs/{run}/exports", {"what": "dataset"}) == 403


def refused(page: Page, path: str, fields: dict[str, str]) -> int:
    """Status of a POST that the page itself does not offer, sent with the user's own token."""
    return page.evaluate(
        """async ([path, fields]) => (await fetch(path, {
            method: "POST",
            headers: {"X-CSRF-Token": document.body.dataset.csrf, Accept: "application/json"},
            body: new URLSearchParams(fields),
        })).status""",
        [path, fields],
    )


def test_the_bundle_verifies_on_a_machine_without_orthocapture(server: Served, run: str, tmp_path: Path) -> None:
    bundle = tmp_path / "bundle.zip"
    words = ("audit", "export", run, str(bundle), "--data", str(server.data), "--operator", "otto")
    done = subprocess.run(
        command(*words, "--password-stdin"),
        cwd=REPOSITORY,
        input=PASSWORD,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = next(tmp_path.glob("*.zip"))
    with zipfile.ZipFile(found) as archive:
        verifier = next(name for name in archive.namelist() if name.endswith("verify.py"))
        (tmp_path / "verify.py").write_bytes(archive.read(verifier))
    checked = [sys.executable, "-I", str(tmp_path / "verify.py"), str(found)]
    answer = subprocess.run(checked, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
