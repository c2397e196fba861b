"""The error predicted from views: its covariance, the next best view, and the coverage of the specimen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.compute.markers.records import SphereOutline
from service.compute.planning.coverage import (
    CoverageLimits,
    CoverageSurface,
    CurrentInformation,
    ViewGain,
    coverage_surface,
    covered_fraction,
    lens_covariance_of_pose,
    mounting_covariance,
    next_best_views,
    point_sigmas_m,
    pose_covariance,
    pose_scatter,
    predicted_information,
    seen,
    view_information,
)
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import CommonErrors, RegistrationSettings
from service.compute.registration.solve import register
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse, transform
from tests.support.runs.measuring_rig import CENTRE_M, SPHERES_M, hill, informations
from tests.support.scenes.sphere_images import (
    RADIUS_M,
    REGISTRATION_M,
    Scene,
    exact_outlines,
    scene,
)

NO_SCATTER = np.zeros((6, 6))


# --- predicted error -------------------------------------------------------------------------------------


def test_the_predicted_covariance_is_that_of_many_repetitions() -> None:
    made = scene(4, seed=3)
    sigma_m = 0.5e-3
    P = np.diag([sigma_m**2 / 3] * 3 + [0.0] * 3)
    answers: list[Array] = []
    for seed in range(80):
        views = informations(made, pose_noise_m=sigma_m, seed=seed)
        normal = sum((v.information for v in views), np.zeros((6, 6)))
        right = sum((v.information @ v.offset for v in views), np.zeros(6))
        answers.append(np.asarray(np.linalg.solve(normal, right), dtype=np.float64))
    predicted = pose_covariance([v.information for v in informations(made)], P)
    spread = np.cov(np.array(answers).T)
    assert np.sqrt(np.trace(spread[:3, :3]) / np.trace(predicted[:3, :3])) == pytest.approx(1.0, abs=0.15)
    assert np.sqrt(np.trace(spread[3:, 3:]) / np.trace(predicted[3:, 3:])) == pytest.approx(1.0, abs=0.2)


def test_the_calibrations_share_is_how_far_a_wrong_focal_length_moves_the_scan() -> None:
    share = 1e-3
    made = dataclasses.replace(scene(6, seed=3), camera=CameraModel(1536, 1024, 1200.0, 1200.0, 768.0, 512.0))
    centre = apply(made.T_world_scan, CENTRE_M)

    def through_wrong_lens(outline: SphereOutline) -> SphereOutline:
        axis = outline.cone.axis / [1 + share, 1 + share, 1.0]
        cone = Cone(axis / np.linalg.norm(axis), outline.cone.half_angle_rad / (1 + share))
        return dataclasses.replace(outline, cone=cone)

    found = [exact_outlines(made, i, SPHERES_M, 0.02, seed=1) for i in range(6)]
    assignments = [
        Assignment(dict(enumerate(which)), inverse(T) @ made.T_world_scan)
        for (_, which), T in zip(found, made.T_world_camera, strict=True)
    ]
    solved = register(
        [tuple(map(through_wrong_lens, outlines)) for outlines, _ in found],
        assignments,
        made.images,
        ScanSpheres(SPHERES_M, RADIUS_M),
        RegistrationSettings(pose_covariance="exact", robust=False, common_errors=CommonErrors(1e-5, 1e-5, 1e-5)),
    )
    moved = np.linalg.norm(apply(solved.T_world_scan, CENTRE_M) - centre)
    error = share * np.array([made.camera.fx, made.camera.fy, 0.0, 0.0])
    views = zip((v.information for v in informations(made)), made.T_world_camera, strict=True)
    predicted = lens_covariance_of_pose(views, made.camera, np.outer(error, error), centre)
    assert np.sqrt(np.trace(predicted[:3, :3])) == pytest.approx(moved, rel=0.25)


def test_the_scatter_of_the_views_shows_how_much_the_arm_errs() -> None:
    views = informations(scene(40, seed=5), pose_noise_m=2e-3)
    P = pose_scatter(views, 1e-4, 1e-4)
    assert np.sqrt(np.trace(P[:3, :3])) == pytest.approx(2e-3, rel=0.25)


def test_more_views_predict_less_error_and_one_sphere_none_at_all() -> None:
    made = scene(8, seed=1)
    views = informations(made)
    centre = apply(made.T_world_scan, CENTRE_M)
    errors: list[float] = []
    for n in (1, 3, 8):
        scatter = pose_scatter(views[:n], 1e-3, 1e-3)
        covariance = pose_covariance([view.information for view in views[:n]], scatter)
        errors.append(float(point_sigmas_m(covariance, np.zeros((1, 3)))[0]))
    assert errors[0] > errors[1] > errors[2] > 0
    one = predicted_information(made.T_world_camera[0], centre[None], RADIUS_M, centre, np.eye(3) * 1e-8)
    with pytest.raises(ComputeError, match="do not determine"):
        pose_covariance([one], NO_SCATTER)


def test_an_error_of_the_mounting_moves_the_scan_with_the_cameras() -> None:
    made = scene(6, seed=4)
    centre = apply(made.T_world_scan, CENTRE_M)
    views = informations(made)
    T_flange_camera = transform(Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix(), np.array([0.0, -0.05, 0.1]))
    error = 1e-5 * np.array([3.0, -2.0, 5.0, 1.0, 2.0, -1.0])  # (d, w) in flange axes
    wrong = transform(
        Rotation.from_rotvec(error[3:]).as_matrix() @ T_flange_camera[:3, :3], T_flange_camera[:3, 3] + error[:3]
    )
    seen_from = [T @ inverse(T_flange_camera) @ wrong for T in made.T_world_camera]
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for i, T in enumerate(seen_from):
        outlines, which = exact_outlines(made, i, SPHERES_M, 0.0)
        view = view_information(
            T, made.T_world_scan, outlines, dict(enumerate(which)), ScanSpheres(SPHERES_M, RADIUS_M), centre, 1e-2
        )
        normal += view.information
        right += view.information @ view.offset
    moved = np.linalg.solve(normal, right)
    pairs = [(v.information, T) for v, T in zip(views, made.T_world_camera, strict=True)]
    predicted = mounting_covariance(pairs, T_flange_camera, np.outer(error, error), centre)
    assert predicted == pytest.approx(np.outer(moved, moved), rel=0.05, abs=1e-12)


# --- next best view --------------------------------------------------------------------------------------


def choice(made: Scene, taken: int) -> tuple[CurrentInformation, list[ViewGain]]:
    centre = apply(made.T_world_scan, CENTRE_M)
    views = informations(made)
    P = np.diag([1e-7] * 3 + [1e-8] * 3)
    targets = apply(made.T_world_scan, SPHERES_M) - centre
    present = CurrentInformation(tuple(v.information for v in views[:taken]), P, targets, np.zeros(4, dtype=np.int64))
    rng = np.random.default_rng(0)
    rest = [ViewGain(f"x{i}", v.information, rng.random(4) > 0.5, float(i)) for i, v in enumerate(views[taken:])]
    return present, rest


@pytest.mark.parametrize("seed", range(4))
def test_the_next_best_view_helps_at_least_as_much_as_any_other(seed: int) -> None:
    present, candidates = choice(scene(12, seed=seed), 2)
    (first, *_) = next_best_views(present, candidates, limit_m=0.0, min_coverage=0.0)
    errors = [present.error_m(c.information) for c in candidates]
    assert first.predicted_error_m <= 1.01 * min(errors)
    assert first.predicted_error_m < np.mean(errors) < present.error_m()


def test_views_are_suggested_until_error_and_coverage_are_within_their_limits() -> None:
    present, candidates = choice(scene(12, seed=2), 2)
    few = next_best_views(present, candidates, limit_m=0.8 * present.error_m(), min_coverage=0.0, at_most=10)
    assert few[-1].predicted_error_m <= 0.8 * present.error_m()
    assert all(view.predicted_error_m > 0.8 * present.error_m() for view in few[:-1])
    assert next_best_views(present, candidates, limit_m=1.0, min_coverage=0.0) == ()
    covered = next_best_views(present, candidates, limit_m=1.0, min_coverage=1.0, at_most=10)
    assert covered[-1].coverage == 1.0


# --- coverage --------------------------------------------------------------------------------------------


def test_coverage_counts_what_two_views_have_seen_of_what_can_be_seen() -> None:
    limits = CoverageLimits()
    surface = coverage_surface(*hill(), REGISTRATION_M, RADIUS_M, limits, n_points=600)
    assert np.all(surface.points_m[:, 2] > 0), "the board's underside and what is inside cannot be seen"
    on_hill = np.linalg.norm(surface.points_m, axis=1) < 0.062
    assert on_hill.mean() > 0.9, "the board does not count"
    top = seen(surface, np.array([0.0, 0.0, 0.6]), limits)
    side = seen(surface, np.array([0.45, 0.0, 0.4]), limits)
    slope = surface.normals @ np.array([1.0, 0.0, 0.0])
    assert np.all(side[slope > 0.7])
    assert not np.any(side[slope < -0.7])
    assert covered_fraction([top, side], 2) == pytest.approx(np.mean(top & side))
    assert covered_fraction([top], 2) == 0.0
    assert not seen(surface, np.array([0.0, 0.0, 1.2]), limits).any(), "too far away"


def test_what_stands_in_between_hides_the_surface() -> None:
    ring = np.array([[0.0, 0.0, 0.06]]) + 0.05 * np.stack(
        [np.cos(np.arange(40)), np.sin(np.arange(40)), np.zeros(40)], 1
    )
    up = np.tile([0.0, 0.0, 1.0], (40, 1))
    dome = CoverageSurface(ring, up, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    plate = trimesh.creation.box((0.8, 0.8, 0.001), transform=trimesh.transformations.translation_matrix((0, 0, 0.3)))
    hidden = CoverageSurface(ring, up, np.asarray(plate.vertices), np.asarray(plate.faces))
    above = np.array([0.0, 0.0, 0.65])
    assert seen(dome, above, CoverageLimits()).mean() > 0.9
    assert not seen(hidden, above, CoverageLimits()).any()
