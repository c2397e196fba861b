"""By hand without a cable and without a CT: photographs arrive as files, and the spheres are located from them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.rig.rig import orthocapture
from tests.support.runs.run_by_hand import run_by_hand, small_protocol

pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.timeout(900)]


def without_ct(folder: Path) -> Path:
    """The small protocol without the CT steps and without comparisons with them."""
    path = small_protocol(folder)
    protocol = yaml.safe_load(path.read_text())
    protocol["steps"] = [step for step in protocol["steps"] if not step["id"].startswith(("ct_", "ground_truth"))]
    for step in protocol["steps"]:
        step["gates"] = [gate for gate in step["gates"] if gate.get("unless_skipped") != "ct_import"]
        params = step.get("params", {})
        if params.get("compare_with") == "ct_import":
            del params["compare_with"]
        if "spheres_of" in params:
            params["spheres_of"].remove("ct_import")
    path.write_text(yaml.safe_dump(protocol, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One run, shared by the tests of this file."""
    folder = tmp_path_factory.mktemp("without_ct")
    return run_by_hand(folder, without_ct(folder), "--scene", "21", "--without-cable", host="127.0.0.12")


def test_the_spheres_are_known_better_with_each_image(run: dict[str, Any]) -> None:
    known_mm = [float(found) for found in re.findall(r"spheres known to (\d+\.\d+) mm", run["told"])]
    assert len(known_mm) >= 8
    assert known_mm[-1] < known_mm[0]
    assert known_mm[-1] < 0.5


def test_the_registration_is_as_good_as_with_a_ct(run: dict[str, Any]) -> None:
    assert run["steps"]["handheld_capture"]["measures"]["hemisphere_coverage"] >= 0.9
    assert run["steps"]["evaluation"]["measures"]["best_mean_radial_error_mm"] < 0.2


def test_the_evidence_verifies(run: dict[str, Any]) -> None:
    answer = orthocapture("audit", "verify", run["run"], "--data", run["data"])
    assert answer.returncode == 0, answer.stdout
