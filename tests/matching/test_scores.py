"""Scores of matches: poses, areas under curves, precision and epipolar errors, against values found by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, depth_map
from service.compute.matching.loader import VISIBLE, View, correspondences
from service.compute.matching.methods import Matches
from service.compute.matching.pairs import relative_pose
from service.compute.matching.scores import (
    PRECISION_PX,
    auc,
    epipolar_errors_px,
    fundamental_matrix,
    match_errors_px,
    pose_error,
    pose_from_matches,
    precisions,
)
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, look_at
from tests.support.scenes.posed import UP, scene

CAMERA = CameraModel(320, 240, 400.0, 404.0, 158.0, 121.0)
FIRST = look_at(np.array([0.2, 0.05, 0.4]), np.array([0.0, 0.01, 0.02]), UP)
SECOND = look_at(np.array([0.12, 0.2, 0.38]), np.array([0.0, 0.01, 0.02]), UP)
INFINITE = float("inf")


@pytest.fixture(scope="module")
def views() -> tuple[View, View]:
    mesh = scene().mesh
    surface = RayMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
    first, second = (
        View(Path("unread.png"), CAMERA.matrix, T, depth_map(surface, CAMERA, T)) for T in (FIRST, SECOND)
    )
    return first, second


def true_matches(views: tuple[View, View]) -> Matches:
    found = correspondences(*views, step=5)
    shown = found.status == VISIBLE
    return Matches(found.first_px[shown], found.second_px[shown], np.ones(np.count_nonzero(shown)))


# --- area under the curve, by hand ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("errors", "threshold", "area"),
    [
        ([0.0], 5.0, 1.0),
        ([INFINITE], 5.0, 0.0),
        # From (0, 0) to (2, 1), then level to 5: a triangle of 1 and a rectangle of 3.
        ([2.0], 5.0, 4.0 / 5.0),
        # (0, 0), (2, ½), (4, 1), level to 10: ½ + 3/2 + 6.
        ([4.0, 2.0], 10.0, 8.0 / 10.0),
        # Only one of two is below 5°: (0, 0), (1, ½), level: ¼ + 2.
        ([1.0, 7.0], 5.0, 2.25 / 5.0),
        ([1.0, INFINITE, 7.0, 30.0], 20.0, (0.5 * 1 * 0.25 + 6 * 0.375 + 13 * 0.5) / 20.0),
        ([5.0], 5.0, 0.0),  # an error equal to the threshold is not below it
    ],
)
def test_areas_found_by_hand(errors: list[float], threshold: float, area: float) -> None:
    assert auc(errors, threshold) == pytest.approx(area)


@pytest.mark.slow
@settings(deadline=None)
@given(st.lists(st.floats(0.0, 180.0), min_size=1, max_size=30), st.floats(0.5, 30.0))
def test_an_area_is_a_share_in_any_order_and_falls_with_errors(errors: list[float], threshold: float) -> None:
    area = auc(errors, threshold)
    assert -1e-12 <= area <= 1.0 + 1e-12
    assert auc(list(reversed(errors)), threshold) == pytest.approx(area)
    assert auc([*errors, INFINITE], threshold) <= area + 1e-12


def test_without_pairs_there_is_no_area() -> None:
    with pytest.raises(ComputeError, match="no pair"):
        auc([], 5.0)


# --- poses ------------------------------------------------------------------------------------------------------


def test_the_pose_error_is_the_larger_angle() -> None:
    T = relative_pose(FIRST, SECOND)
    turned = Rotation.from_rotvec(np.radians(3.0) * np.array([0.0, 0.6, 0.8])).as_matrix() @ T[:3, :3]
    across = np.cross(T[:3, 3], [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    direction = np.cos(np.radians(8.0)) * T[:3, 3] / np.linalg.norm(T[:3, 3]) + np.sin(np.radians(8.0)) * across
    for sign in (1.0, -1.0):  # an essential matrix does not tell
        error = pose_error(turned, sign * direction, T)
        assert error.rotation_deg == pytest.approx(3.0)
        assert error.translation_deg == pytest.approx(8.0)
        assert error.worst_deg == pytest.approx(8.0)


def test_true_matches_give_the_true_pose(views: tuple[View, View]) -> None:
    matches = true_matches(views)
    R, direction, inliers = pose_from_matches(matches, CAMERA.matrix, CAMERA.matrix)
    assert pose_error(R, direction, relative_pose(FIRST, SECOND)).worst_deg < 0.02
    assert inliers > 0.95 * len(matches.first_px)


def test_the_pose_survives_wrong_matches_and_is_the_same_again(views: tuple[View, View]) -> None:
    rng, matches = np.random.default_rng(3), true_matches(views)
    noisy = matches.second_px + rng.normal(0, 0.03, matches.second_px.shape)
    wrong = rng.random(len(noisy)) < 0.3
    noisy[wrong] = rng.uniform(0, [CAMERA.width, CAMERA.height], (np.count_nonzero(wrong), 2))
    spoilt = Matches(matches.first_px, noisy, matches.confidence)
    R, direction, inliers = pose_from_matches(spoilt, CAMERA.matrix, CAMERA.matrix)
    assert pose_error(R, direction, relative_pose(FIRST, SECOND)).worst_deg < 3.0
    assert inliers < 0.85 * len(noisy)
    again = pose_from_matches(spoilt, CAMERA.matrix, CAMERA.matrix)
    assert (again[0] == R).all()
    assert (again[1] == direction).all()


@pytest.mark.parametrize("count", [0, 4])
def test_too_few_matches_give_no_pose(views: tuple[View, View], count: int) -> None:
    matches = true_matches(views)
    few = Matches(matches.first_px[:count], matches.second_px[:count], matches.confidence[:count])
    with pytest.raises(ComputeError, match=f"{count} matches give no pose"):
        pose_from_matches(few, CAMERA.matrix, CAMERA.matrix)


def test_matches_of_one_point_give_no_pose() -> None:
    same = np.full((12, 2), 100.0)
    with pytest.raises(ComputeError):
        pose_from_matches(Matches(same, same, np.ones(12)), CAMERA.matrix, CAMERA.matrix)


# --- matches ----------------------------------------------------------------------------------------------------


def test_precision_counts_scored_matches() -> None:
    errors = np.array([0.4, 0.9, 2.5, 4.0, np.inf, np.nan])
    assert dict(zip(PRECISION_PX, precisions(errors), strict=True)) == {
        0.5: 0.2, 1.0: 0.4, 2.0: 0.4, 3.0: 0.6, 5.0: 0.8, 10.0: 0.8,
    }  # fmt: skip
    assert precisions(np.array([np.nan])) == (0.0,) * len(PRECISION_PX)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 6.0), st.floats(0.0, 2 * np.pi))
def test_a_shifted_match_is_off_by_its_shift(distance_px: float, angle: float) -> None:
    mesh = scene().mesh
    surface = RayMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
    pair = tuple(View(Path("unread.png"), CAMERA.matrix, T, depth_map(surface, CAMERA, T)) for T in (FIRST, SECOND))
    matches = true_matches((pair[0], pair[1]))
    shifted = matches.second_px + distance_px * np.array([np.cos(angle), np.sin(angle)])
    errors = match_errors_px(Matches(matches.first_px, shifted, matches.confidence), pair[0], pair[1])
    assert np.allclose(errors, distance_px, atol=1e-6)


def test_matches_of_hidden_points_are_wrong_and_those_beside_the_solid_are_not_scored(
    views: tuple[View, View],
) -> None:
    found = correspondences(*views)
    hidden = np.isin(found.status, (1, 2))
    assert hidden.any()
    wherever = np.nan_to_num(found.second_px[hidden])
    assert np.isinf(match_errors_px(Matches(found.first_px[hidden], wherever, np.ones(len(wherever))), *views)).all()
    beside = np.argwhere(views[0].depth_m == 0)[::50, ::-1].astype(np.float64)
    assert np.isnan(match_errors_px(Matches(beside, beside, np.ones(len(beside))), *views)).all()


def line_distance(F: Array, pixel: Array, other: Array) -> float:
    """Distance of `other` from the epipolar line of `pixel`, by the line's points."""
    a, b, c = F @ np.array([*pixel, 1.0])
    start = np.array([0.0, -c / b])
    along = np.array([b, -a]) / np.hypot(a, b)
    to = other - start
    return float(np.linalg.norm(to - (to @ along) * along))


def test_epipolar_errors_are_distances_from_lines(views: tuple[View, View]) -> None:
    T: Transform = relative_pose(FIRST, SECOND)
    F = fundamental_matrix(T, CAMERA.matrix, CAMERA.matrix)
    matches = true_matches(views)
    assert epipolar_errors_px(matches, F).max() < 1e-3  # the depth is in single precision
    rng = np.random.default_rng(5)
    off = Matches(matches.first_px, matches.second_px + rng.normal(0, 3, matches.second_px.shape), matches.confidence)
    errors = epipolar_errors_px(off, F)
    for k in range(0, len(errors), 40):
        both = (
            line_distance(F, off.first_px[k], off.second_px[k]),
            line_distance(F.T, off.second_px[k], off.first_px[k]),
        )
        assert errors[k] == pytest.approx(sum(both) / 2)
