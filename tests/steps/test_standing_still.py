"""Whether the arm stands still, judged from its pose stream, and how long it rings after a motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivers.arm.stream import judge, ringing_s
from drivers.interfaces import RobotSample, SafetyState, SettleCriteria
from service.core.geometry import transform


def still(count: int = 63, shake_m: float = 0.0, speed_rad_s: float = 0.0, target: float = 0.0) -> list[RobotSample]:
    samples: list[RobotSample] = []
    for i in range(count):
        T = transform(np.eye(3), np.array([0.5 + shake_m * np.sin(i), 0.0, 0.3]))
        speeds = np.full(6, speed_rad_s)
        t = i * 0.008
        samples.append(RobotSample(t, t, np.zeros(6), speeds, np.full(6, target), T, 0.0, SafetyState.NORMAL))
    return samples


def test_judge_counts_vibration_creep_and_a_short_window() -> None:
    criteria = SettleCriteria()
    assert judge(still(), criteria).settled
    assert judge(still(shake_m=9e-6), criteria).settled
    shaking = judge(still(shake_m=2e-5), criteria)
    assert not shaking.settled, "a camera mount that vibrates by 40 µm"
    assert shaking.position_peak_to_peak_m == pytest.approx(4e-5, rel=0.01)
    assert not judge(still(speed_rad_s=0.002), criteria).settled
    assert not judge(still(target=0.01), criteria).settled
    assert not judge(still(count=20), criteria).settled


def test_ringing_lasts_from_the_end_of_the_commanded_motion_to_the_last_loud_sample() -> None:
    criteria = SettleCriteria()
    course = [*still(5, target=0.1), *still(8, speed_rad_s=0.01), *still(80)]
    samples = [dataclasses.replace(sample, monotonic_s=0.008 * i) for i, sample in enumerate(course)]
    assert ringing_s(samples, criteria) == pytest.approx(8 * 0.008)
    assert ringing_s(samples[:5] + samples[13:], criteria) == 0, "an arm that stops dead"
    assert ringing_s(still(), criteria) == 0, "no motion in these samples"
