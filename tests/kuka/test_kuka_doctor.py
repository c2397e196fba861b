"""`orthocapture doctor` on a simulated KUKA shows what docs/howto/kuka.md has a person compare with the smartPAD."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from service.cli.main import app
from simulators.kuka_controller.kinematics import MODELS, frames
from tests.support.arms.kuka_simulator import pendant, simulated_kuka
from tests.support.arms.ur_simulator import address

HOST = address(86)
RIG = f"""\
name: OR 3
devices:
  robot: {{driver: kuka_sunrise, host: {HOST}}}
payload: {{mass_kg: 1.6, centre_of_gravity_m: [0, 0, 0.08]}}
"""


def told(folder: Path) -> tuple[int, dict[str, Any]]:
    """The doctor's exit status, and what it says of the arm."""
    rig = folder / "rig.yaml"
    rig.write_text(RIG, encoding="utf-8")
    words = ["doctor", "--rig", str(rig), "--data", str(folder / "data"), "--json"]
    result = CliRunner().invoke(app, words, catch_exceptions=False)
    return result.exit_code, json.loads(result.stdout)["devices"]["robot"]


def numbers(words: str) -> list[float]:
    return [float(word) for word in words.split()]


def test_an_arm_that_stands_stopped_is_shown_with_its_joints(tmp_path: Path) -> None:
    with simulated_kuka(HOST):
        pendant(HOST, "mode T1")
        pendant(HOST, "stop external_stop")
        status, arm = told(tmp_path)
        assert status == 1
        assert arm["details"]["safety"] == "safeguard_stop"
        assert arm["details"]["operating mode"] == "T1"
        assert len(numbers(arm["details"]["joints (rad)"])) == 7
        assert "safeguard stop" in arm["problems"][0]
        pendant(HOST, "release")
        pendant(HOST, "mode AUT")
        assert told(tmp_path)[0] == 0


def test_the_flange_is_shown_as_the_smartpad_shows_it(tmp_path: Path) -> None:
    with simulated_kuka(HOST):
        _, arm = told(tmp_path)
    joints_rad = np.array(numbers(arm["details"]["joints (rad)"]))
    T_base_flange = frames(MODELS["LBR Med 14"], joints_rad)[-1]
    x, y, z, a, b, c = numbers(arm["details"]["flange (X Y Z in mm, A B C in °)"])
    np.testing.assert_allclose([x, y, z], T_base_flange[:3, 3] * 1000, atol=0.2)
    shown = Rotation.from_euler("ZYX", [a, b, c], degrees=True)
    assert (shown.inv() * Rotation.from_matrix(T_base_flange[:3, :3])).magnitude() < np.radians(0.05)
