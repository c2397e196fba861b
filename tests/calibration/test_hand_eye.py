"""Hand-eye calibration against ground truth: accuracy, consistent uncertainties, half-turned boards, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import half_turn
from service.compute.calibration.hand_eye import HandEyeViews, calibrate_hand_eye
from service.compute.calibration.hand_eye_fit import Method
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, inverse, look_at, transform

T_FLANGE_CAMERA = transform(Rotation.from_rotvec([0.02, -0.03, 1.55]), np.array([0.012, -0.055, 0.093]))
T_BASE_BOARD = transform(Rotation.from_euler("xyz", [176, 3, 40], degrees=True), np.array([0.7, -0.1, 0.05]))


def _session(
    count: int,
    *,
    noise_mm: float = 0.0,
    noise_deg: float = 0.0,
    seed: int = 0,
    T_base_board: Transform = T_BASE_BOARD,
) -> tuple[Array, Array]:
    """Noisy robot poses and exact board poses of a camera that looks at the board from all sides."""
    rng = np.random.default_rng(seed)
    hands: list[Transform] = []
    boards: list[Transform] = []
    for _ in range(count):
        tilt, azimuth = np.deg2rad(rng.uniform(5, 40)), rng.uniform(0, 2 * np.pi)
        eye = -0.6 * np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        T_board_camera = look_at(eye, rng.uniform(-0.03, 0.03, 3), rng.normal(0, 1, 3))
        hand = T_base_board @ T_board_camera @ inverse(T_FLANGE_CAMERA)
        wobble = transform(
            Rotation.from_rotvec(np.deg2rad(rng.normal(0, noise_deg, 3))), rng.normal(0, noise_mm, 3) * 1e-3
        )
        hands.append(hand @ wobble)
        boards.append(inverse(T_board_camera))
    return np.stack(hands), np.stack(boards)


def _error_mm(T: Transform) -> float:
    return float(np.linalg.norm(T[:3, 3] - T_FLANGE_CAMERA[:3, 3]) * 1e3)


@pytest.mark.parametrize("method", ["weighted", "park", "daniilidis", "tsai", "horaud", "andreff"])
def test_exact_data_gives_the_exact_answer(method: Method) -> None:
    result = calibrate_hand_eye(HandEyeViews(*_session(12)), method=method, bootstrap=5)
    assert _error_mm(result.T_flange_camera) < 1e-6
    np.testing.assert_allclose(result.T_base_board, T_BASE_BOARD, atol=1e-9)
    assert result.method == method
    assert set(result.methods) == {"weighted", "park", "daniilidis", "tsai", "horaud", "andreff"}
    assert result.spread_mm < 1e-5
    assert result.held_out_mm.max() < 1e-5


@pytest.mark.slow
def test_noisy_robot_stays_within_the_bootstrap_sigma() -> None:
    ratios: list[float] = []
    for seed in range(6):
        result = calibrate_hand_eye(HandEyeViews(*_session(40, noise_mm=0.15, noise_deg=0.02, seed=seed)), seed=seed)
        assert _error_mm(result.T_flange_camera) < 0.2
        assert result.held_out_mm.mean() >= result.residual_mm.mean()
        assert 0.1 < result.held_out_mm.mean() < 0.8
        assert result.rotation_spread_deg > 60
        assert result.second_axis_deg > 20
        assert result.condition < 10
        ratios.append(_error_mm(result.T_flange_camera) / result.sigma_mm)
    # the stated uncertainty is neither far too small nor far too large
    assert 0.3 < float(np.sqrt(np.mean(np.square(ratios)))) < 2.0


@pytest.mark.slow
@given(flips=st.lists(st.booleans(), min_size=14, max_size=14), seed=st.integers(0, 50))
@settings(max_examples=15, deadline=None)
def test_half_turned_boards_are_turned_back(flips: list[bool], seed: int) -> None:
    turn = half_turn(9, 7, 0.02)
    assert turn is not None
    hands, boards = _session(14, noise_mm=0.1, noise_deg=0.02, seed=seed)
    mixed = np.where(np.array(flips)[:, None, None], boards @ turn, boards)
    result = calibrate_hand_eye(HandEyeViews(hands, mixed), T_board_turned=turn, bootstrap=2)
    assert _error_mm(result.T_flange_camera) < 0.5
    # the whole group may be turned: this cannot be detected and does not matter
    assert list(result.turned) in (flips, [not f for f in flips])


def test_unresolved_half_turns_show_in_the_residuals() -> None:
    turn = half_turn(9, 7, 0.02)
    assert turn is not None
    hands, boards = _session(14)
    boards[3] = boards[3] @ turn
    assert calibrate_hand_eye(HandEyeViews(hands, boards), bootstrap=2).residual_mm.max() > 5


def test_motions_that_determine_nothing_are_refused() -> None:
    hands, boards = _session(12)
    with pytest.raises(ComputeError, match="at least 6"):
        calibrate_hand_eye(HandEyeViews(hands[:5], boards[:5]))
    axis = [transform(Rotation.from_euler("z", 8 * k, degrees=True), np.array([0.01 * k, 0, 0])) for k in range(10)]
    with pytest.raises(ComputeError, match="one axis only"):
        calibrate_hand_eye(HandEyeViews(np.stack(axis), np.stack(axis)))
    small = [
        transform(Rotation.from_rotvec(np.deg2rad(v)), v) for v in np.random.default_rng(0).uniform(-3, 3, (10, 3))
    ]
    with pytest.raises(ComputeError, match="turned by"):
        calibrate_hand_eye(HandEyeViews(np.stack(small), np.stack(small)))


def test_data_that_do_not_belong_together_are_refused() -> None:
    hands, boards = _session(8)
    with pytest.raises(DataError, match="do not match"):
        calibrate_hand_eye(HandEyeViews(hands, boards[:-1]))
    boards[2, 0, 3] = np.nan
    with pytest.raises(DataError, match="finite"):
        calibrate_hand_eye(HandEyeViews(hands, boards))
