"""The paper's errors on control spheres, and the true error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.accuracy import evaluate, leave_one_out, radial_errors_m, true_error_m
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import inverse, transform
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, exact_outlines, scene
from tests.support.stated_errors import normalised_rms

EVERYTHING = np.vstack([REGISTRATION_M, CONTROL_M])


@dataclass(frozen=True)
class Registered:
    """A registration, and control spheres that were not used for it."""

    outlines: list[tuple[SphereOutline, ...]]
    controls: list[Assignment]
    result: RegistrationResult
    camera: CameraModel


def test_exact_outlines_have_no_error_and_a_shift_has_its_size() -> None:
    made = scene(4, seed=1)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    found = [exact_outlines(made, i, CONTROL_M) for i in range(4)]
    outlines = [f[0] for f in found]
    assignments = [Assignment(dict(enumerate(f[1]))) for f in found]
    exact = evaluate(outlines, assignments, PosedImages(truth, made.camera), ScanSpheres(CONTROL_M, RADIUS_M))
    assert exact.mean_radial_error_mm < 1e-6
    assert exact.mean_reprojection_error_px < 1e-6
    # A sphere moved by d across the view meets its outline's rays at d |cos|, 2 d / π on average.
    shifted = np.array([T @ transform(np.eye(3), np.array([0.001, 0.0, 0.0])) for T in truth])
    moved = evaluate(outlines, assignments, PosedImages(shifted, made.camera), ScanSpheres(CONTROL_M, RADIUS_M))
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
        evaluate(
            [(), ()],
            [Assignment(), Assignment()],
            PosedImages(made.T_world_camera, made.camera),
            ScanSpheres(CONTROL_M, RADIUS_M),
        )


def registered(seed: int, noise_px: float, pose_sigma: tuple[float, float] = (0.0, 0.0)) -> Registered:
    """A capture of ten registration and three control spheres, and its registration."""
    made = scene(6, seed=seed)
    rng = np.random.default_rng(seed)
    found = [exact_outlines(made, i, EVERYTHING, noise_px, seed) for i in range(6)]
    poses = made.T_world_camera.copy()
    for T in poses:
        T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * pose_sigma[1]).as_matrix() @ T[:3, :3]
        T[:3, 3] += rng.normal(size=3) * pose_sigma[0]
    outlines = [f[0] for f in found]
    spheres = [{j: k for j, k in enumerate(f[1]) if k < 10} for f in found]
    controls = [Assignment({j: k - 10 for j, k in enumerate(f[1]) if k >= 10}) for f in found]
    assignments = [Assignment(m, inverse(T) @ made.T_world_scan) for m, T in zip(spheres, poses, strict=True)]
    result = register(outlines, assignments, PosedImages(poses, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M))
    return Registered(outlines, controls, result, made.camera)


@pytest.mark.parametrize("pose_sigma", [(0.0, 0.0), (3e-4, 3e-4)])
def test_errors_of_control_and_left_out_spheres_have_the_size_predicted(pose_sigma: tuple[float, float]) -> None:
    normalised: dict[str, list[float]] = {"control": [], "spared": []}
    for seed in range(4):
        made = registered(seed, 0.1, pose_sigma)
        for refined, cameras in ((False, made.result.T_scan_camera), (True, made.result.T_scan_camera_refined)):
            control = evaluate(
                made.outlines,
                made.controls,
                PosedImages(cameras, made.camera),
                ScanSpheres(CONTROL_M, RADIUS_M),
                registration=made.result,
            )
            spared = leave_one_out(made.result, refined=refined)
            assert len(spared.per_sphere()) >= 6
            for name, evaluation in (("control", control), ("spared", spared)):
                rms = normalised_rms(evaluation)
                assert rms is not None
                normalised[name].append(rms)
                sigma = np.array([e.sigma_mm for e in evaluation.errors], dtype=np.float64)
                radial = np.array([e.radial_error_mm for e in evaluation.errors])
                assert 0.5 < np.mean(radial) / np.mean(sigma) < 1.5
    for values in normalised.values():
        assert 0.7 < np.sqrt(np.mean(np.square(values))) < 1.4


def test_a_sphere_displaced_in_the_list_stands_out() -> None:
    made = scene(6, seed=5)
    found = [exact_outlines(made, i, REGISTRATION_M, 0.1, 1) for i in range(6)]
    listed = REGISTRATION_M.copy()
    listed[4] += [0.0, 0.0005, 0.0]
    assignments = [
        Assignment(dict(enumerate(f[1])), inverse(T) @ made.T_world_scan)
        for f, T in zip(found, made.T_world_camera, strict=True)
    ]
    result = register(
        [f[0] for f in found],
        assignments,
        PosedImages(made.T_world_camera, made.camera),
        ScanSpheres(listed, RADIUS_M),
        RegistrationSettings(robust=False),
    )
    radial = {s: r[0] for s, r in leave_one_out(result).per_sphere().items()}
    assert max(radial, key=lambda s: radial[s]) == 4
    assert 0.15 < radial[4] < 0.6


def test_the_last_three_spheres_cannot_be_spared() -> None:
    made = scene(4, seed=1)
    often = np.argsort(-np.bincount([k for i in range(4) for k in exact_outlines(made, i, REGISTRATION_M)[1]]))
    three = REGISTRATION_M[often[:3]]
    found = [exact_outlines(made, i, three) for i in range(4)]
    assignments = [
        Assignment(dict(enumerate(f[1])), inverse(T) @ made.T_world_scan)
        for f, T in zip(found, made.T_world_camera, strict=True)
    ]
    result = register(
        [f[0] for f in found],
        assignments,
        PosedImages(made.T_world_camera, made.camera),
        ScanSpheres(REGISTRATION_M[[0, 3, 6]], RADIUS_M),
    )
    with pytest.raises(ComputeError, match="left out"):
        leave_one_out(result)


def test_true_error_ignores_the_frame_but_not_the_registration() -> None:
    made = scene(6, seed=3)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    assert true_error_m(truth, truth, np.zeros(3)) < 1e-9
    wrong = transform(Rotation.from_rotvec([0, 0, 0.01]), np.array([0.0005, 0, 0]))
    centre = np.array([0.1, 0.0, 0.05])
    expected = np.linalg.norm(wrong[:3, :3] @ centre + wrong[:3, 3] - centre)
    assert true_error_m(inverse(wrong) @ truth, truth, centre) == pytest.approx(expected, rel=1e-6)
