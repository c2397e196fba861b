"""The paper's errors on control spheres, and the true error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.registration.evaluation import evaluate, radial_errors_m, true_error_m
from service.compute.registration.identity import Assignment
from service.core.errors import ComputeError
from service.core.geometry import inverse, transform
from tests.support.sphere_images import CONTROL_M, RADIUS_M, exact_outlines, scene


def test_exact_outlines_have_no_error_and_a_shift_has_its_size() -> None:
    made = scene(4, seed=1)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    found = [exact_outlines(made, i, CONTROL_M) for i in range(4)]
    outlines = [f[0] for f in found]
    assignments = [Assignment(dict(enumerate(f[1]))) for f in found]
    exact = evaluate(outlines, assignments, truth, CONTROL_M, RADIUS_M, made.camera)
    assert exact.mean_radial_error_mm < 1e-6
    assert exact.mean_reprojection_error_px < 1e-6
    # A sphere moved by d across the view meets its outline's rays at d |cos|, 2 d / pi on average.
    shifted = np.array([T @ transform(np.eye(3), np.array([0.001, 0.0, 0.0])) for T in truth])
    moved = evaluate(outlines, assignments, shifted, CONTROL_M, RADIUS_M, made.camera)
    assert moved.mean_radial_error_mm == pytest.approx(2 / np.pi, rel=0.08)
    distance = np.mean(np.linalg.norm(truth[:, :3, 3], axis=1))
    expected_px = moved.mean_radial_error_mm * 1e-3 / distance * made.camera.fx
    assert moved.mean_reprojection_error_px == pytest.approx(expected_px, rel=0.2)
    assert set(moved.per_sphere()) == {0, 1, 2}


def test_radial_error_is_the_gap_between_ray_and_hull() -> None:
    centre = np.array([0.0, 0.0, 0.6])
    d = (RADIUS_M + 0.002) / 0.6
    off = np.tan(np.arcsin(d))
    assert radial_errors_m(np.array([[off, 0.0]]), centre, RADIUS_M)[0] == pytest.approx(0.002, abs=1e-9)


def test_no_control_sphere_is_refused() -> None:
    made = scene(2)
    with pytest.raises(ComputeError, match="control"):
        evaluate([(), ()], [Assignment(), Assignment()], made.T_world_camera, CONTROL_M, RADIUS_M, made.camera)


def test_true_error_ignores_the_frame_but_not_the_registration() -> None:
    made = scene(6, seed=3)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    assert true_error_m(truth, truth, np.zeros(3)) < 1e-9
    wrong = transform(Rotation.from_rotvec([0, 0, 0.01]), np.array([0.0005, 0, 0]))
    centre = np.array([0.1, 0.0, 0.05])
    expected = np.linalg.norm(wrong[:3, :3] @ centre + wrong[:3, 3] - centre)
    assert true_error_m(inverse(wrong) @ truth, truth, centre) == pytest.approx(expected, rel=1e-6)
