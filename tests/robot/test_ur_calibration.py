"""The calibration that a controller computes with: its message, and what the driver reports of it."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from drivers.interfaces import answers_of
from drivers.ur.primary import ControllerKinematics, calibration_of, take_kinematics
from service.core.arms import arm_model
from simulators.ur_controller.kinematics import MODELS
from simulators.ur_controller.primary import kinematics_message
from tests.support.arms.ur_driver import SPEED_UP, opened
from tests.support.arms.ur_simulator import address, simulated_ur

UR10E = arm_model("UR10e")
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.3])


def kinematics(*, d6_m: float = 0.11655, alpha4_rad: float = np.pi / 2) -> ControllerKinematics:
    a, d, alpha = UR10E.a_m.copy(), UR10E.d_m.copy(), UR10E.alpha_rad.copy()
    d[5], alpha[3] = d6_m, alpha4_rad
    return ControllerKinematics((0.0,) * 6, tuple(a), tuple(d), tuple(alpha))


def test_the_message_is_found_however_it_is_cut() -> None:
    mode = struct.pack(">IB", 5 + 3, 0) + b"abc"  # another part of the state
    message = kinematics_message(MODELS["UR10e"])
    (first,) = struct.unpack_from(">I", message)
    greeting, state = message[:first], message[first:]
    longer = struct.pack(">IB", len(state) + len(mode), 16) + mode + state[5:]
    stream = greeting + struct.pack(">IB", 5 + len(mode), 16) + mode + longer
    for step in (1, 7, 100, len(stream)):
        left, found = b"", []
        for at in range(0, len(stream), step):
            one, left = take_kinematics(left + stream[at : at + step])
            found += [one] if one is not None else []
        assert len(found) == 1, step
        np.testing.assert_allclose(found[0].d_m, UR10E.d_m)
        np.testing.assert_allclose(found[0].a_m, UR10E.a_m)
        np.testing.assert_allclose(found[0].alpha_rad, UR10E.alpha_rad)


def test_noise_is_no_kinematics() -> None:
    for data in (b"HTTP/1.1 400", struct.pack(">IB", 9, 16) + struct.pack(">I", 1000), b"\x00" * 40):
        with pytest.raises(ConnectionError):
            take_kinematics(data + b"\xff" * 8)
    state = bytearray(kinematics_message(MODELS["UR10e"]))
    state[-12:-4] = struct.pack(">d", float("nan"))
    with pytest.raises(ConnectionError, match="no number"):
        take_kinematics(bytes(state))


def test_the_words_say_whose_dimensions_they_are() -> None:
    assert kinematics().words(UR10E, HOME).startswith("the published dimensions")
    own = kinematics(d6_m=0.11655 - 0.00094).words(UR10E, HOME)
    assert own == "this arm's own: the flange is 0.94 mm from where the published dimensions put it"
    assert "not known here" in kinematics().words(None, HOME)


def test_the_driver_reports_it_and_does_without_it() -> None:
    with simulated_ur(address(76), "--speed-up", SPEED_UP), opened(address(76)) as arm:
        assert arm.report().details["calibration"].startswith("the published dimensions")
    mute = '[{"device": "robot", "on": "primary", "kind": "stall", "times": 9}]'
    with simulated_ur(address(77), "--faults", mute), opened(address(77)) as arm:
        assert arm.report().details["calibration"].startswith("the calibration is not stated: timed out")
        assert arm.report().problems == ()
    assert "not stated: Connection refused" in calibration_of("127.7.77.77", 1.0)(UR10E, HOME)


def test_the_calibration_is_asked_for_by_the_report_and_not_to_open_the_arm() -> None:
    """Before, each opening asked: the second client of the primary interface was the first who wanted to know."""
    plan = json.dumps([{"device": "robot", "on": "primary", "kind": "drop", "nth": 2}])
    with simulated_ur(address(72), "--faults", plan), opened(address(72)) as arm:
        assert answers_of(arm).samples[0].source == "primary interface, kinematics"
        told = [arm.report().details["calibration"] for _ in range(2)]
    assert told == ["the calibration is not stated: the interface answers without it"] * 2
