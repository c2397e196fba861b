"""The error budget: closures are near 1 if the stated errors are right, and otherwise show the factor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.computations.evaluate.compute import budget_record
from service.compute.pipeline import register_images
from service.compute.registration.accuracy import (
    Alignment,
    ErrorBudget,
    MeasuredSpheres,
    Observation,
    compare_in_frame,
    compare_shapes,
    contributions,
    control_observation,
    locate_in_images,
    loop_observations,
)
from service.compute.registration.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import apply, inverse, transform
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, exact_outlines, scene
from tests.support.stated_errors import sigma_components_m

SIGMA_M = 0.02e-3


def measured(centres: Any, seed: int, sigma_m: float = SIGMA_M, stated_m: float = SIGMA_M) -> MeasuredSpheres:
    """Centres as measured by an instrument: with errors of `sigma_m`, stated as `stated_m`."""
    noise = np.random.default_rng(seed).normal(size=np.shape(centres)) * sigma_m
    return MeasuredSpheres(centres + noise, np.tile(np.eye(3) * stated_m**2, (len(centres), 1, 1)), 0.03e-3)


def test_spheres_are_located_in_images_within_their_stated_covariance() -> None:
    chi2: list[float] = []
    for seed in range(12):
        made = scene(8, seed=seed)
        seen = [exact_outlines(made, i, CONTROL_M, noise_px=0.05, seed=seed) for i in range(8)]
        assignments = [Assignment(dict(enumerate(which))) for _, which in seen]
        T_scan_camera = inverse(made.T_world_scan) @ made.T_world_camera
        found = locate_in_images([o for o, _ in seen], assignments, T_scan_camera, CONTROL_M + 1e-3, RADIUS_M)
        assert set(found) == {0, 1, 2}
        for m, sphere in found.items():
            assert sphere.n_images >= 7
            error = sphere.centre_m - CONTROL_M[m]
            assert np.linalg.norm(error) < 0.1e-3
            chi2.append(float(error @ np.linalg.solve(sphere.covariance_m2, error)) / 3)
    assert 0.6 < np.mean(chi2) < 1.5


def test_an_outline_of_something_else_does_not_move_a_sphere() -> None:
    made = scene(8, seed=3)
    seen = [exact_outlines(made, i, CONTROL_M, noise_px=0.05, seed=3) for i in range(8)]
    assignments = [Assignment(dict(enumerate(which))) for _, which in seen]
    wrong = dict(assignments[2].markers)
    swapped = list(wrong)[:2]
    wrong[swapped[0]], wrong[swapped[1]] = wrong[swapped[1]], wrong[swapped[0]]
    assignments[2] = Assignment(wrong)
    T_scan_camera = inverse(made.T_world_scan) @ made.T_world_camera
    found = locate_in_images([o for o, _ in seen], assignments, T_scan_camera, CONTROL_M, RADIUS_M)
    assert max(np.linalg.norm(s.centre_m - CONTROL_M[m]) for m, s in found.items()) < 0.1e-3


def test_spheres_seen_in_too_few_images_are_left_out() -> None:
    made = scene(3, seed=1)
    seen = [exact_outlines(made, i, CONTROL_M, noise_px=0.05) for i in range(3)]
    assignments = [Assignment(dict(enumerate(which))) for _, which in seen]
    T_scan_camera = inverse(made.T_world_scan) @ made.T_world_camera
    assert not locate_in_images([o for o, _ in seen], assignments, T_scan_camera, CONTROL_M, RADIUS_M, least_images=4)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_shapes_are_compared_whatever_their_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = transform(Rotation.random(rng=rng), rng.uniform(-1, 1, 3))
    a = measured(REGISTRATION_M, seed)
    b = measured(REGISTRATION_M, seed + 1)
    here, _ = compare_shapes(a.centres_m, a.covariance_m2, b.centres_m, b.covariance_m2)
    turned_covariance = T[:3, :3] @ b.covariance_m2 @ T[:3, :3].T
    there, alignment = compare_shapes(a.centres_m, a.covariance_m2, apply(T, b.centres_m), turned_covariance)
    assert there.normalised_chi2 == pytest.approx(here.normalised_chi2, rel=1e-4)
    assert there.rms_m == pytest.approx(here.rms_m, rel=1e-4)
    np.testing.assert_allclose(apply(alignment.T_a_b, apply(T, b.centres_m)), a.centres_m, atol=8 * SIGMA_M)


def test_closures_are_near_one_when_the_covariances_are_right_and_larger_when_a_sphere_moved() -> None:
    right: list[float] = []
    for seed in range(40):
        a, b = measured(REGISTRATION_M, 2 * seed), measured(REGISTRATION_M, 2 * seed + 1)
        right.append(compare_shapes(a.centres_m, a.covariance_m2, b.centres_m, b.covariance_m2)[0].normalised_chi2)
        assert compare_in_frame(a.centres_m, a.covariance_m2, b.centres_m, b.covariance_m2).predicted_m > 0
    assert 0.85 < np.mean(right) < 1.15
    a, b = measured(REGISTRATION_M, 1), measured(REGISTRATION_M, 2)
    b.centres_m[4] += [0.0, 0.3e-3, 0.0]
    moved, _ = compare_shapes(a.centres_m, a.covariance_m2, b.centres_m, b.covariance_m2)
    assert moved.normalised_chi2 > 2


def test_three_spheres_close_no_loop() -> None:
    a = measured(REGISTRATION_M[:3], 1)
    with pytest.raises(ComputeError, match="four"):
        compare_shapes(a.centres_m, a.covariance_m2, a.centres_m, a.covariance_m2)


def budget_of(seed: int, stated_m: float = SIGMA_M) -> ErrorBudget:
    """A budget from exact outlines with noise, a noisy scan and a noisy CT."""
    made = scene(6, seed=seed)
    every = np.vstack([REGISTRATION_M, CONTROL_M])
    scan = measured(every, seed, stated_m=stated_m)
    seen = [exact_outlines(made, i, every, noise_px=0.05, seed=seed)[0] for i in range(6)]
    solved = register_images(
        seen,
        PosedImages(made.T_world_camera, made.camera),
        ScanSpheres(scan.centres_m[:10], RADIUS_M, control_m=scan.centres_m[10:]),
    )
    registration = solved.registration
    controls = MeasuredSpheres(scan.centres_m[10:], scan.covariance_m2[10:], scan.surface_rms_m)
    scanned = MeasuredSpheres(scan.centres_m[:10], scan.covariance_m2[:10], scan.surface_rms_m)
    T = registration.T_scan_camera
    found = locate_in_images(seen, solved.control_assignments, T, controls.centres_m, RADIUS_M)
    places = locate_in_images(seen, solved.assignments, T, scanned.centres_m, RADIUS_M)
    ct = measured(
        apply(transform(Rotation.random(rng=np.random.default_rng(seed)), np.ones(3)), REGISTRATION_M), seed
    )
    centre = REGISTRATION_M.mean(axis=0)
    placed = Alignment(registration.T_world_scan, registration.covariance)
    return ErrorBudget(
        contributions(sigma_components_m(registration, centre), scanned, ct),
        (control_observation(placed, found, controls), *loop_observations(places, scanned, ct)),
    )


@pytest.mark.slow
def test_the_budget_sums_its_parts_and_agrees_with_what_is_observed() -> None:
    chi2: dict[str, list[float]] = {}
    for seed in range(5):
        budget = budget_of(seed)
        counted = [c.sigma_m for c in budget.contributions if c.counted]
        assert budget.total_m == pytest.approx(np.sqrt(np.sum(np.square(counted))))
        assert [c.name for c in budget.contributions if not c.counted] == ["ct"]
        for observation in budget.observations:
            chi2.setdefault(observation.name, []).append(observation.normalised_chi2)
    assert set(chi2) == {"control spheres", "camera ↔ scan", "scan ↔ CT", "camera ↔ CT"}
    for name in ("control spheres", "camera ↔ scan", "scan ↔ CT", "camera ↔ CT"):
        assert 0.4 < np.mean(chi2[name]) < 2, name


def test_stated_errors_that_are_too_small_are_called_so() -> None:
    budget = budget_of(1, stated_m=SIGMA_M / 5)
    camera_scan = next(o for o in budget.observations if o.name == "camera ↔ scan")
    assert "too small" in camera_scan.verdict
    record = budget_record(budget).plain()
    assert record["total_mm"] == pytest.approx(1e3 * budget.total_m)


@pytest.mark.parametrize(("chi2", "word"), [(1.0, "as predicted"), (9.0, "3.0 times too small"), (0.04, "too large")])
def test_verdicts(chi2: float, word: str) -> None:
    assert word in Observation("x", 1e-3, 1e-3, chi2, 5, "").verdict
