"""The protocol without a robot as its user runs it: a simulated hand follows the words to a registered data set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.audit.recorded_run import read_run
from service.dataset.view_covariances import view_covariances
from tests.support.rig.rig import orthocapture
from tests.support.runs.run_by_hand import run_by_hand, small_protocol

pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One run, shared by the tests of this file."""
    folder = tmp_path_factory.mktemp("handheld")
    return run_by_hand(folder, small_protocol(folder), "--scene", "7", host="127.0.0.9")


def test_the_hand_covers_the_hemisphere_in_spite_of_its_mistakes(run: dict[str, Any]) -> None:
    measures = run["steps"]["handheld_capture"]["measures"]
    assert measures["hemisphere_coverage"] >= 0.9
    assert measures["predicted_target_error_mm"] < 0.15
    taken = [run["steps"][name]["measures"] for name in ("board_capture", "handheld_capture")]
    # Of the mishaps of every fourth press, a blurred board, a finger and half a way still leave a usable image.
    assert sum(m["images_not_used"] for m in taken) >= 2, "settings turned, and an image taken twice"
    assert sum(m["images_used"] for m in taken) >= 19


def test_every_image_that_was_not_used_says_why(run: dict[str, Any]) -> None:
    refused = [line for line in run["told"].splitlines() if "not used: " in line]
    assert len(refused) >= 2
    assert any("ISO 200; required are" in line for line in refused)
    assert run["told"].count("next: ") >= 19


def test_the_registration_is_as_good_as_with_a_robot(run: dict[str, Any]) -> None:
    measures = run["steps"]["evaluation"]["measures"]
    assert measures["best_mean_radial_error_mm"] < 0.2


def test_the_covariance_of_each_pose_by_the_spheres_is_whole(run: dict[str, Any]) -> None:
    summary = read_run(Path(run["data"]), run["run"]).summary()
    registered = summary.registrations()["spheres"]
    names = sorted(registered.T_scan_camera)
    stated = view_covariances(summary, "spheres", registered, names)
    assert stated.words.startswith("all of it: what the outlines of the spheres in each image leave open")
    assert stated.joint is not None
    assert stated.joint.shape == (6 * len(names), 6 * len(names))
    sigmas_m = [np.sqrt(np.trace(stated.covariance[name][:3, :3])) for name in names]
    assert min(sigmas_m) > 5e-5
    assert max(sigmas_m) < 3e-3


def test_the_evidence_verifies(run: dict[str, Any]) -> None:
    answer = orthocapture("audit", "verify", run["run"], "--data", run["data"], "--json")
    assert answer.returncode == 0, answer.stdout
    shown = json.loads(orthocapture("audit", "show", run["run"], "--data", run["data"], "--json").stdout)
    kinds = [event["kind"] for event in shown["events"]]
    assert "view_held" in kinds
    assert "viewpoint_captured" not in kinds
