"""A field of the stream that is frozen contradicts the others once the arm moves, and a sound arm never does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import Array, SafetyState
from drivers.ur.agreement import Agreement, FrozenFieldError
from tests.support.arms.ur_driver import faulty, move, opened, turned, wait_for

PERIOD_S = 0.008
REACH_M = 0.8  # of the tool from the axis that turns


@dataclass(frozen=True)
class Packet:
    """What the controller tells at one time."""

    joints: Array
    speeds: Array
    targets: Array
    position: Array
    tcp_speed: float
    safety: SafetyState = SafetyState.NORMAL


def motion(speed_rad_s: float, *, lag_s: float = 0.0, target: float = 1.0) -> list[Packet]:
    """Rest, a motion of the first joint with ramps of 0.2 s, rest; speeds filtered so that they lag behind."""
    count = round(2.0 / PERIOD_S)
    ramp = np.minimum(np.minimum(np.arange(count), np.arange(count)[::-1]) * PERIOD_S / 0.2, 1.0)
    speed = np.concatenate([np.zeros(100), speed_rad_s * ramp, np.zeros(200)])
    told = speed.copy()
    for i in range(1, len(told)) if lag_s else ():
        told[i] = told[i - 1] + (speed[i] - told[i - 1]) * PERIOD_S / lag_s
    angle = np.cumsum(speed) * PERIOD_S
    first = np.eye(6)[0]
    return [
        Packet(
            a * first,
            t * first,
            target * v * first,
            REACH_M * np.array([np.cos(a), np.sin(a), 0.0]),
            REACH_M * abs(t),
        )
        for a, v, t in zip(angle, speed, told, strict=True)
    ]


def stopped(packet: Packet) -> Packet:
    return replace(packet, speeds=np.zeros(6), targets=np.zeros(6), tcp_speed=0.0)


def watched(packets: list[Packet], period_s: float = PERIOD_S) -> None:
    agreement = Agreement()
    for i, one in enumerate(packets):
        agreement.see(i * period_s, one.joints, one.speeds, one.targets, one.position, one.tcp_speed, one.safety)


@pytest.mark.parametrize(
    "packets",
    [
        motion(0.0),
        motion(3.1),
        motion(3.1, lag_s=0.06),
        motion(0.1, lag_s=0.06),
        motion(-1.0),
        motion(1.0, target=0.0),  # a hand turns it
        motion(1.0, target=0.3),  # the target with the slider applied twice
        [replace(one, safety=SafetyState.REDUCED) for one in motion(0.2, target=5.0)],  # held back by the limits
        [*motion(0.5)[:200], *[stopped(motion(0.5)[200])] * 300],
        [
            replace(one, position=one.position + np.array([0.0, 0.0, 0.1 * (i > 150)]))  # another tool, in mid-motion
            for i, one in enumerate(motion(1.0))
        ],
    ],
)
def test_a_sound_arm_agrees_with_itself(packets: list[Packet]) -> None:
    watched(packets)
    watched(packets[::3], 3 * PERIOD_S)  # the driver does not see every package


@pytest.mark.parametrize("speed_rad_s", [0.06, 1.0, 3.1])
@pytest.mark.parametrize(
    ("frozen", "at", "field"),
    [
        (lambda one, first: replace(one, joints=first.joints), 50, "actual_qd"),
        (lambda one, first: replace(one, joints=first.joints), 200, "actual_qd"),
        (lambda one, first: replace(one, joints=first.joints, position=first.position), 200, "actual_qd"),
        (lambda one, first: replace(one, speeds=first.speeds), 50, "actual_qd"),
        (lambda one, first: replace(one, speeds=first.speeds), 200, "actual_qd"),
        (lambda one, first: replace(one, targets=first.targets), 200, "target_qd"),
        (lambda one, first: replace(one, tcp_speed=first.tcp_speed), 50, "actual_TCP_speed"),
        (lambda one, first: replace(one, tcp_speed=first.tcp_speed), 200, "actual_TCP_speed"),
    ],
)
def test_a_frozen_field_is_named(
    frozen: Callable[[Packet, Packet], Packet], at: int, field: str, speed_rad_s: float
) -> None:
    packets = motion(speed_rad_s)
    told = [*packets[:at], *(frozen(one, packets[at]) for one in packets[at:])]
    told += [told[-1]] * 300  # it rests, and a speed that is frozen goes on
    with pytest.raises(FrozenFieldError, match=field):
        watched(told)


@pytest.mark.slow
@pytest.mark.parametrize("field", ["actual_qd", "actual_TCP_speed"])
def test_a_controller_whose_field_freezes_is_no_longer_believed(field: str) -> None:
    """Before, the motion came to its end as if all were well."""
    with faulty(71, {"on": f"field {field}", "kind": "freeze", "nth": 1}) as ready, opened(ready["host"]) as arm:
        move(arm, turned(arm, 2.0))
        with pytest.raises(DeviceUnavailableError, match=rf"{field} does not fit the motion.*may be frozen"):
            wait_for(lambda: not arm.is_moving())
