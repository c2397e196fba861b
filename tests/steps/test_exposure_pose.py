"""The flange pose during an exposure: its mean, its spread, and the judgement whether the arm stands still."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.arm.stream import judge
from drivers.errors import DeviceUnavailableError
from drivers.interfaces import RobotSample, SafetyState, SettleCriteria
from service.core.geometry import Array, rotation_angle_rad, transform
from service.steps.exposure import exposure_pose

TURNED = Rotation.from_euler("xyz", [0.4, -2.0, 1.1])


def stream(turns_rad: Array, positions_m: Array | None = None) -> list[RobotSample]:
    """Samples at 125 Hz of a flange with these rotation vectors (N, 3) and positions."""
    places = np.zeros((len(turns_rad), 3)) if positions_m is None else positions_m
    poses = [transform(TURNED * Rotation.from_rotvec(turn), p) for turn, p in zip(turns_rad, places, strict=True)]
    still, no_joints = np.zeros(6), np.zeros(6)
    return [
        RobotSample(0.008 * i, 0.008 * i, no_joints, still, still, T, 0.0, SafetyState.NORMAL)
        for i, T in enumerate(poses)
    ]


def wobble(count: int, amplitude: float, axis: int = 0) -> Array:
    out = np.zeros((count, 3))
    out[:, axis] = amplitude * (-1.0) ** np.arange(count)
    return out


def test_a_flange_that_wobbles_to_both_sides_by_the_same_angle_does_not_stand_still() -> None:
    spread = exposure_pose(stream(wobble(40, 1e-4))).spread
    assert spread.rotation_peak_to_peak_rad == pytest.approx(2e-4, rel=1e-6)
    assert spread.rotation_sigma_rad == pytest.approx(1e-4, rel=1e-6)
    assert not spread.within(SettleCriteria())


def test_the_rotation_of_an_exposure_is_the_mean_of_its_samples() -> None:
    turns = np.zeros((41, 3))
    turns[:, 2] = np.linspace(0.0, 4e-5, 41) ** 2 / 4e-5  # the middle sample is at 1e-5, the mean a third of the way
    T = exposure_pose(stream(turns)).spread.T_base_flange
    mean = transform(TURNED * Rotation.from_rotvec(turns.mean(axis=0)), np.zeros(3))
    assert rotation_angle_rad(np.linalg.inv(mean) @ T) < 1e-9


@pytest.mark.parametrize("amplitude_m", [6e-6, 9e-6])
def test_an_exposure_and_the_settling_before_it_are_judged_alike(amplitude_m: float) -> None:
    """±9 µm along two axes are 18 µm each, and 25 µm along the diagonal."""
    places = wobble(63, amplitude_m) + wobble(63, amplitude_m, axis=1)
    samples = stream(np.zeros((63, 3)), places)
    settled = judge(samples, SettleCriteria())
    exposed = exposure_pose(samples).spread
    assert exposed.within(SettleCriteria()) == settled.settled == (amplitude_m < 7e-6)
    assert exposed.position_peak_to_peak_m == settled.position_peak_to_peak_m
    assert np.array_equal(exposed.T_base_flange, settled.T_base_flange)


def test_an_exposure_without_a_sample_has_no_pose() -> None:
    with pytest.raises(DeviceUnavailableError, match="no sample during the exposure"):
        exposure_pose([])
