"""The size of a board by the robot: fitted with its tolerance, told in words, refused if it is not credible."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from service.compute.calibration.hand_eye import HandEyeResult, HandEyeViews, calibrate_hand_eye
from service.compute.calibration.hand_eye_fit import Method
from service.compute.calibration.hand_eye_setup import Setup, inverted
from service.compute.calibration.reprojection import BoardCorners
from service.core.errors import ComputeError
from tests.support.boards.board_sessions import BOARD, T_BASE_BOARD, T_FLANGE_CAMERA, Session, noisy_session


def _stated(session: Session, ratio: float) -> HandEyeViews:
    """The same images and poses if the board's true size is `ratio` times the one that is stated."""
    boards, corners = session.T_camera_board.copy(), session.corners
    boards[:, :3, 3] /= ratio
    board = dataclasses.replace(BOARD, square_m=BOARD.square_m / ratio)
    scaled = BoardCorners(corners.points_m / ratio, corners.corners_px, corners.camera)
    return HandEyeViews(session.T_base_flange, boards, corners=scaled, board=board)


def _error_mm(result: HandEyeResult) -> float:
    return 1e3 * float(np.linalg.norm((result.T_flange_camera - T_FLANGE_CAMERA)[:3, 3]))


@pytest.fixture(scope="module")
def session() -> Session:
    return noisy_session(20, 0.05, 0.005, 3)


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (0.9667, "15.5167 were given (ratio 0.96"),
        (0.9667, "a printer that fits pages to paper does this"),
        (10.0, "1.5 were given"),
        (10.0, "centimetres taken as millimetres have this ratio"),
        (25.4, "inches taken as millimetres have this ratio"),
        (2.0, "the distance of two rows of circles"),
        (0.75, "the side of a square given for that of its marker"),
    ],
)
def test_a_board_of_another_size_is_refused_with_the_size_that_fits(
    session: Session, ratio: float, words: str
) -> None:
    with pytest.raises(ComputeError) as refused:
        calibrate_hand_eye(_stated(session, ratio), bootstrap=10)
    assert words in str(refused.value)
    assert "the squares are 15.0" in str(refused.value) or "the squares are 14.9" in str(refused.value)


@pytest.mark.parametrize("method", ["park", "reprojection"])
def test_every_method_and_mount_compares_the_size(session: Session, method: Method) -> None:
    views = _stated(session, 0.9667)
    with pytest.raises(ComputeError, match="by the robot"):
        calibrate_hand_eye(views, method=method, bootstrap=5)
    beside: Setup = "eye-to-hand"
    with pytest.raises(ComputeError, match="by the robot"):
        calibrate_hand_eye(
            dataclasses.replace(views, T_base_flange=inverted(views.T_base_flange)), setup=beside, bootstrap=5
        )


def test_a_board_within_its_tolerance_is_accepted_and_the_sigma_holds() -> None:
    """The distance is nearly constant, so the tolerance decides how well the camera's height is known."""
    rng = np.random.default_rng(2)
    for seed in range(3):
        ratio = 1 + rng.uniform(-5e-4, 5e-4)
        result = calibrate_hand_eye(_stated(noisy_session(20, 0.1, 0.01, seed), ratio), bootstrap=30)
        assert _error_mm(result) < 3 * result.sigma_mm
        assert abs(result.size.ratio - ratio) < 3 * result.size.sigma
        assert abs(result.size.used - ratio) < 3 * 5e-4
        assert result.findings == ()


def test_the_sigma_grows_little_where_the_size_is_well_known() -> None:
    session = noisy_session(20, 0.15, 0.02, 4)
    sigmas = [
        calibrate_hand_eye(
            HandEyeViews(
                session.T_base_flange,
                session.T_camera_board,
                corners=session.corners,
                board=dataclasses.replace(BOARD, size_tolerance=tolerance),
            ),
            bootstrap=20,
        ).sigma_mm
        for tolerance in (0.0, 1e-4, 5e-4)
    ]
    assert sigmas[1] < 1.15 * sigmas[0]
    assert sigmas[2] > 1.5 * sigmas[0]  # the camera's height is as uncertain as the distance


def test_positions_that_scatter_more_than_rotations_explain_are_a_finding(session: Session) -> None:
    poses = session.T_base_flange.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 2e-3, (len(poses), 3))
    result = calibrate_hand_eye(
        HandEyeViews(poses, session.T_camera_board, corners=session.corners, board=BOARD), bootstrap=5
    )
    (finding,) = result.findings
    assert "the robot's positions scatter by" in finding
    assert np.allclose(result.T_base_board, T_BASE_BOARD, atol=0.02)
