"""Planned board poses: within the tolerances the whole board is in every frame, and together they cover the image."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.board_design import (
    NOTHING,
    CalibrationTargets,
    DesignProblem,
    board_candidates,
    choose_poses,
)
from service.compute.calibration.board_knowledge import (
    BoardKnowledge,
    Tolerances,
    nominal_knowledge,
    refined_knowledge,
)
from service.compute.calibration.intrinsics import calibrate_intrinsics
from service.compute.calibration.intrinsics_quality import board_distance_m, projection_uncertainty
from service.compute.camera_model import CameraModel
from service.compute.photography import ViewRange
from service.core.geometry import Array, Transform, apply, increment, inverse, transform
from service.steps.board_plan import FIRST

BOARD = Board(16, 23, 0.015)
CAMERA = CameraModel(1920, 1280, 2688.0, 2688.0, 959.5, 639.5)
TRUE = CameraModel(1920, 1280, 2719.0, 2719.6, 966.0, 635.0, -0.05, 0.03, 3e-4, -2e-4)
MOUNT = transform(np.eye(3), np.array([0.0, -0.055, 0.095]))
MIDDLE = np.array([0.77, 0.0, 0.21])
APPROACH = np.array([-1.0, 0.0, 0.0])
SMALL = Tolerances(0.001, 0.002, 0.003, 0.003, 0.005, 0.005, 0.004, 0.002)
AIMS = CalibrationTargets()


USUAL = Tolerances()


def nominal(tolerances: Tolerances = USUAL) -> BoardKnowledge:
    return nominal_knowledge(CAMERA, MOUNT, MIDDLE, APPROACH, BOARD, tolerances=tolerances)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wishes", "tolerances"), [(FIRST, Tolerances()), pytest.param(ViewRange(), SMALL, marks=pytest.mark.sweep)]
)
def test_every_planned_pose_holds_the_whole_board_within_the_tolerances(
    wishes: ViewRange, tolerances: Tolerances
) -> None:
    known = nominal(tolerances)
    found = board_candidates(known, BOARD, wishes, APPROACH)
    assert len(found.T_base_camera) > 20
    hands, boards, zoom, shift = known.draws(200, seed=99)  # not those that the planner has used
    size = np.array([CAMERA.width, CAMERA.height])
    cut = 0
    for T in found.T_base_camera:
        for hand, board, z, s in zip(hands, boards, zoom, shift, strict=True):
            seen = apply(inverse(T @ inverse(MOUNT) @ hand) @ board, BOARD.points())
            lens = dataclasses.replace(CAMERA, fx=CAMERA.fx * z, fy=CAMERA.fy * z)
            pixels = lens.project(seen) + s
            cut += not ((pixels > 12) & (pixels < size - 13)).all()
    assert cut <= 0.001 * 200 * len(found.T_base_camera)


def test_a_design_covers_the_image_and_predicts_what_its_images_come_to() -> None:
    known = nominal(SMALL)
    candidates = board_candidates(known, BOARD, ViewRange(), APPROACH)
    problem = DesignProblem(known, BOARD, CalibrationTargets(coverage=1.0, corner_sigma_px=0.05))
    poses = choose_poses(problem, candidates, 30)
    prediction = problem.predict(problem.as_taken(poses))
    assert prediction.images == len(poses) == 30
    assert prediction.coverage > 0.95
    assert prediction.tilt_deg > 30
    assert prediction.rotation_spread_deg > 40
    rng = np.random.default_rng(3)
    views = [_view(T, known.T_base_board, TRUE, rng, sigma_px=0.05) for T in poses]
    solved = calibrate_intrinsics(views, BOARD, (1920, 1280))
    assert solved.coverage > prediction.coverage - 0.03
    reached = projection_uncertainty(solved, board_distance_m(solved)).worst_mm
    assert 0.5 < reached / prediction.uncertainty_mm < 2
    chosen_by_chance = candidates.T_base_camera[rng.permutation(len(candidates.T_base_camera))[:30]]
    by_chance = problem.predict(problem.as_taken(chosen_by_chance))
    assert prediction.uncertainty_mm < by_chance.uncertainty_mm


def test_what_the_arm_cannot_take_is_not_planned_and_enough_is_enough() -> None:
    known = nominal(SMALL)
    candidates = board_candidates(known, BOARD, ViewRange(), APPROACH)
    problem = DesignProblem(known, BOARD, AIMS)
    near = choose_poses(problem, candidates, 10, feasible=lambda T: T[0, 3] < MIDDLE[0])
    assert len(near) == 10
    assert (near[:, 0, 3] < MIDDLE[0]).all()
    assert len(choose_poses(problem, candidates, 10, feasible=lambda _T: False)) == 0
    few = choose_poses(problem, candidates, 10, enough=lambda p: p.images >= 4, taken=NOTHING)
    assert len(few) == 4


@pytest.mark.parametrize("seed", range(4))
def test_the_first_images_tell_where_board_mount_and_lens_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    known = nominal()
    hands, boards, _, _ = known.draws(1, seed=50 + seed)
    truth, board = hands[0], boards[0]
    wishes = ViewRange(tilts_deg=(8, 24, 38), distances_m=(0.78,))
    poses = board_candidates(nominal(SMALL), BOARD, wishes, APPROACH).T_base_camera
    flanges: list[Array] = []
    views: list[BoardView] = []
    for T in poses[rng.permutation(len(poses))[:6]]:
        flange = T @ inverse(MOUNT)
        reported = increment(flange, rng.normal(0, 0.3e-3, 3), rng.normal(0, 0.3e-3, 3))
        flanges.append(reported)
        views.append(_view(flange @ truth, board, TRUE, rng, sigma_px=0.1))
    one, _ = refined_knowledge(known, views[:1], np.array(flanges[:1]), BOARD)
    six, _ = refined_knowledge(known, views, np.array(flanges), BOARD)
    assert six.measured == 6
    assert abs(six.camera.fx / TRUE.fx - 1) < six.focal
    off = np.concatenate([_from(six.T_flange_camera, truth), _from(six.T_base_board, board)])
    assert (np.abs(np.linalg.solve(six.spread, off)) < 1).all(), "the truth is within what is called possible"
    assert six.focal < 0.5 * one.focal
    assert np.abs(six.spread).max() < 0.5 * np.abs(one.spread).max()


def test_a_board_laid_the_other_way_round_is_the_same_board() -> None:
    known = nominal()
    middle = BOARD.points().mean(axis=0)
    turned = known.T_base_board @ transform(Rotation.from_euler("z", np.pi), 2 * middle)
    poses = board_candidates(nominal(SMALL), BOARD, FIRST, APPROACH).T_base_camera[:3]
    rng = np.random.default_rng(0)
    views = [_view(T, turned, CAMERA, rng, sigma_px=0.05) for T in poses]
    found, _ = refined_knowledge(known, views, poses @ inverse(MOUNT), BOARD)
    assert np.linalg.norm(found.T_base_board - turned) < 0.05


def _view(
    T_base_camera: Transform, T_base_board: Transform, lens: CameraModel, rng: np.random.Generator, *, sigma_px: float
) -> BoardView:
    pixels = lens.project(apply(inverse(T_base_camera) @ T_base_board, BOARD.points()))
    return BoardView(np.arange(len(pixels)), pixels + rng.normal(0, sigma_px, pixels.shape))


def _from(start: Transform, end: Transform) -> Array:
    w = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate([end[:3, 3] - start[:3, 3], w])
