"""Inputs that contradict one another are named and left out, or counted in the stated sigma; clean ones are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import INTRINSICS, PipelineResult, register_images
from service.compute.registration.contradictions import UNEXPLAINED, held_lens_covariance, require_handedness
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse, skew
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, exact_outlines, scene

N = 10
# A lens that shows most of the spheres in every image.
WIDE = CameraModel(1920, 1280, 1500.0, 1501.0, 967.0, 635.0, -0.05, 0.03, 2e-4, -3e-4)
MADE = replace(scene(N, width=1920, seed=8), camera=WIDE)
CENTRE_M = REGISTRATION_M.mean(axis=0)
Outlines = list[tuple[SphereOutline, ...]]
FOUND = [exact_outlines(MADE, i, REGISTRATION_M, 0.1, seed=8) for i in range(N)]
NAMED = [
    Assignment(dict(enumerate(names)), inverse(T) @ MADE.T_world_scan)
    for (_, names), T in zip(FOUND, MADE.T_world_camera, strict=True)
]


def seen() -> Outlines:
    return [outlines for outlines, _ in FOUND]


def registered(
    outlines: Outlines,
    poses: Array = MADE.T_world_camera,
    camera: CameraModel = MADE.camera,
    listed_m: Array = REGISTRATION_M,
    radius_m: float = RADIUS_M,
    lens_covariance: Array | None = None,
    check: bool = True,
    named: bool = True,
) -> PipelineResult:
    """The registration; `named` says that the outlines are known to be those of the list, which takes less time."""
    return register_images(
        outlines,
        PosedImages(poses, camera, names=[f"view_{i}.jpg" for i in range(len(poses))]),
        ScanSpheres(listed_m, radius_m),
        assignments=NAMED if named else None,
        lens_covariance=lens_covariance,
        check=check,
    )


def error_m(result: PipelineResult) -> float:
    return float(
        np.linalg.norm(apply(result.registration.T_world_scan, CENTRE_M) - apply(MADE.T_world_scan, CENTRE_M))
    )


def in_sigma(result: PipelineResult) -> float:
    return error_m(result) / result.registration.sigma_at_m(CENTRE_M)


def through(camera: CameraModel) -> Callable[[SphereOutline], SphereOutline]:
    """The outline as another camera model sees its pixels, by the cone's rim."""

    def seen_by(outline: SphereOutline) -> SphereOutline:
        azimuth = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        rim = outline.cone.rays(azimuth, np.full(60, outline.cone.half_angle_rad))
        plane = np.column_stack([camera.normalise(MADE.camera.project(rim)), np.ones(60)])
        rays = plane / np.linalg.norm(plane, axis=1, keepdims=True)
        # All rays of a cone have one cosine with its axis: rays @ (axis / cosine) = 1.
        scaled = np.linalg.lstsq(rays, np.ones(60), rcond=None)[0]
        length = float(np.linalg.norm(scaled))
        return replace(outline, cone=Cone(scaled / length, float(np.arccos(1 / length))))

    return seen_by


def changed(outlines: Outlines, change: Callable[[SphereOutline], SphereOutline]) -> Outlines:
    return [tuple(map(change, found)) for found in outlines]


def test_clean_inputs_have_no_finding_and_the_sigma_that_they_had() -> None:
    outlines = seen()
    result = registered(outlines)
    assert result.findings == ()
    assert result.left_out == {}
    assert UNEXPLAINED not in result.registration.components
    plain = registered(outlines, check=False)
    assert result.registration.sigma_at_m(CENTRE_M) == plain.registration.sigma_at_m(CENTRE_M)
    assert result.beyond is not None
    assert [e.name for e in result.beyond.errors if e.significant] == []


@pytest.mark.slow
def test_a_wrong_focal_length_is_measured_and_named_and_its_effect_is_counted() -> None:
    wrong = replace(MADE.camera, fx=MADE.camera.fx * 1.001, fy=MADE.camera.fy * 1.001)
    outlines = changed(seen(), through(wrong))
    result = registered(outlines, camera=wrong)
    assert error_m(result) > 0.3e-3
    assert in_sigma(registered(outlines, camera=wrong, check=False)) > 5  # as it was
    assert in_sigma(result) < 3
    (finding,) = result.findings
    assert finding.kind == "focal length"
    assert finding.what.count("% too large") == 2
    assert "hand-eye" in finding.remedy  # the images cannot tell these causes apart
    assert result.beyond is not None
    focal = {e.name: e.value for e in result.beyond.errors}
    assert focal["focal_x"] == pytest.approx(1e-3, rel=0.1)
    assert focal["focal_y"] == pytest.approx(1e-3, rel=0.1)
    # A calibration that states to know no better does not contradict.
    lens = np.diag([(7e-4 * wrong.fx) ** 2] * 2 + [1e-8] * 2 + [1e-18] * 4)
    unsure = registered(outlines, camera=wrong, lens_covariance=lens)
    assert unsure.findings == ()
    assert in_sigma(unsure) < 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_list", "of_positions", "wrong"),
    [(1.01, 1.0, "so that the list is wrong"), (1.0, 1.01, "so that the positions are wrong"), (0.9985, 1.0, "")],
)
def test_a_list_in_another_scale_than_the_positions_is_told_from_a_wrong_lens(
    of_list: float, of_positions: float, wrong: str
) -> None:
    poses = MADE.T_world_camera.copy()
    poses[:, :3, 3] *= of_positions
    result = registered(seen(), poses=poses, listed_m=of_list * REGISTRATION_M)
    assert [finding.kind for finding in result.findings if finding.refuses] == ["scale"]
    finding = next(finding for finding in result.findings if finding.kind == "scale")
    assert wrong in finding.what
    assert ("larger" if of_list > of_positions else "smaller") in finding.what
    assert result.beyond is not None
    (scale,) = (e for e in result.beyond.errors if e.name == "scale")
    assert scale.value == pytest.approx(of_list / of_positions - 1, abs=3 * scale.uncertainty)
    assert in_sigma(result) < 3


@pytest.mark.parametrize(
    ("factor", "words"), [(0.93, "multiplied by about 1.0"), (1 / 25.4, "inches taken as milli")]
)
def test_a_list_so_far_off_that_nothing_fits_is_told_with_its_scale(factor: float, words: str) -> None:
    with pytest.raises(ComputeError, match=words):
        registered(seen()[:3], poses=MADE.T_world_camera[:3], listed_m=factor * REGISTRATION_M, named=False)


@pytest.mark.slow
def test_positions_in_another_unit_than_list_and_radius_are_told_with_their_scale() -> None:
    poses = MADE.T_world_camera.copy()
    poses[:, :3, 3] /= 25.4
    with pytest.raises(
        ComputeError, match=r"multiplied by 25\.\d+ \(inches taken as millimetres\), \d+ images agree"
    ):
        registered(seen(), poses=poses, named=False)


def test_a_principal_point_that_is_off_is_named_with_its_sign() -> None:
    wrong = replace(MADE.camera, cx=MADE.camera.cx + 2.0)
    result = registered(changed(seen(), through(wrong)), camera=wrong)
    (finding,) = result.findings
    assert finding.kind == "principal point"
    assert "cx by " in finding.what
    assert "too large" in finding.what
    assert result.beyond is not None
    assert {e.name: e.value for e in result.beyond.errors}["shift_x_px"] == pytest.approx(-2, abs=0.1)
    assert in_sigma(result) < 3


def test_a_wrong_radius_is_named_with_the_radius_by_the_images() -> None:
    result = registered(seen(), radius_m=1.01 * RADIUS_M)
    (finding,) = result.findings
    assert finding.kind == "size of outlines"
    assert "radius 15.15 mm" in finding.what
    by_images_mm = float(finding.what.split("the radius is ")[1].split()[0])
    assert by_images_mm == pytest.approx(1e3 * RADIUS_M, abs=0.02)
    assert in_sigma(result) < 3


def test_blurred_outlines_have_a_larger_sigma_and_blur_is_a_cause() -> None:
    def blurred(outline: SphereOutline) -> SphereOutline:
        cone = Cone(outline.cone.axis, outline.cone.half_angle_rad + 0.5 / MADE.camera.fx)
        return replace(outline, cone=cone, systematic_px=0.15)

    sharp, result = registered(seen()), registered(changed(seen(), blurred))
    (finding,) = result.findings
    assert result.beyond is not None
    assert {e.name: e.value for e in result.beyond.errors}["growth_px"] == pytest.approx(0.5, abs=0.1)
    assert "blurred over 3.0 px" in finding.what
    assert "blur" in finding.remedy
    assert result.registration.sigma_at_m(CENTRE_M) > 3 * sharp.registration.sigma_at_m(CENTRE_M)


def test_one_pose_that_is_off_is_left_out_and_not_averaged() -> None:
    poses = MADE.T_world_camera.copy()
    poses[7, :3, 3] += [3e-3, -3e-3, 2.6e-3]
    result = registered(seen(), poses)
    (finding,) = result.findings
    assert finding.kind == "image left out"
    assert finding.what.startswith("view_7.jpg is left out: its pose is ")
    assert float(finding.what.split("its pose is ")[1].split()[0]) == pytest.approx(5, abs=0.3)
    assert set(result.left_out) == {7}
    assert np.isnan(result.registration.T_scan_camera[7]).all()
    assert error_m(result) < 0.1 * error_m(registered(seen(), poses, check=False))
    assert in_sigma(result) < 3


def test_two_exchanged_images_are_named_with_each_other() -> None:
    poses = MADE.T_world_camera.copy()
    poses[[2, 8]] = poses[[8, 2]]
    result = registered(seen(), poses, named=False)
    assert set(result.left_out) == {2, 8}
    assert (
        "fit the pose of view_8.jpg, and those of view_8.jpg fit its pose: the two are exchanged"
        in (result.left_out[2])
    )
    assert in_sigma(result) < 3


def test_an_image_of_another_scene_is_left_out() -> None:
    outlines = seen()
    other = np.random.default_rng(3).uniform([-0.2, -0.15, 0.03], [0.2, 0.15, 0.09], (9, 3))
    outlines[4] = exact_outlines(MADE, 4, other, 0.1, seed=8)[0]
    result = registered(outlines, named=False)
    assert set(result.left_out) == {4}
    assert "not in the arrangement of the list" in result.left_out[4]
    assert in_sigma(result) < 3


@pytest.mark.slow
def test_if_too_many_images_contradict_one_another_none_is_left_out_and_the_result_is_refused() -> None:
    poses = MADE.T_world_camera.copy()
    for i in range(5):
        poses[i, :3, 3] += np.random.default_rng(i).normal(size=3) * 20e-3
    result = registered(seen(), poses)
    assert result.left_out == {}
    assert result.findings[0].refuses
    assert "too many to leave them out" in result.findings[0].what
    assert result.measures()["contradictions"] == 1


def test_a_registration_sphere_that_was_moved_is_named_with_its_distance() -> None:
    listed = REGISTRATION_M.copy()
    listed[4] += [0.0, 1.6e-3, 1.2e-3]
    result = registered(seen(), listed_m=listed)
    (finding,) = result.findings
    assert finding.kind == "sphere not found"
    assert finding.what.startswith("Sphere 4 is ")
    assert float(finding.what.split()[3]) == pytest.approx(2, abs=0.1)
    assert not finding.refuses


def test_a_registration_sphere_that_is_not_there_is_named() -> None:
    listed = np.vstack([REGISTRATION_M, [0.0, 0.08, 0.05]])
    (finding,) = registered(seen(), listed_m=listed).findings
    assert finding.what.startswith("Sphere 10 was not found in 10 images")


def test_a_mirrored_list_is_refused_by_name() -> None:
    mirrored = ScanSpheres(REGISTRATION_M * [1.0, -1.0, 1.0], RADIUS_M)
    with pytest.raises(ComputeError, match="mirrored"):
        require_handedness(seen()[:3], MADE.images, mirrored)
    require_handedness(seen()[:3], MADE.images, ScanSpheres(REGISTRATION_M, RADIUS_M))


def test_the_covariance_of_the_calibration_is_a_component() -> None:
    lens = np.diag([0.5**2] * 2 + [0.3**2] * 2 + [1e-8] * 2 + [1e-10] * 2)
    with_it, without = registered(seen(), lens_covariance=lens), registered(seen())
    assert INTRINSICS in with_it.registration.components
    assert with_it.registration.sigma_at_m(CENTRE_M) > without.registration.sigma_at_m(CENTRE_M)
    both = np.sum(list(with_it.registration.components.values()), axis=0)
    assert np.allclose(both, with_it.registration.covariance, rtol=1e-6)


@pytest.mark.parametrize("refined", [False, True], ids=["cameras as given", "cameras refined"])
def test_an_error_of_the_lens_moves_the_scan_as_its_component_says(refined: bool) -> None:
    """The camera is held as calibrated: what the outlines would tell of it is not taken off."""
    off = np.array([0.8, 0.8, 0.5, -0.4, 0.0, 0.0, 0.0, 0.0])
    wrong = replace(MADE.camera, fx=MADE.camera.fx + 0.8, fy=MADE.camera.fy + 0.8, cx=MADE.camera.cx + 0.5)
    wrong = replace(wrong, cy=wrong.cy - 0.4)
    exact = changed([exact_outlines(MADE, i, REGISTRATION_M, 0.001, seed=8)[0] for i in range(N)], through(wrong))
    poses = PosedImages(MADE.T_world_camera, wrong)
    held = register(exact, NAMED, poses, ScanSpheres(REGISTRATION_M, RADIUS_M))
    lens = np.outer(off, off) + np.diag([1e-6] * 4 + [1e-14] * 4)
    unsure = register(
        exact, NAMED, poses, ScanSpheres(REGISTRATION_M, RADIUS_M), RegistrationSettings(intrinsics_covariance=lens)
    )
    component = held_lens_covariance(unsure, lens, refined=refined)
    placed = held.T_scan_camera_refined if refined else held.T_scan_camera
    # Seen from the cameras, where they are in truth.
    seen_m = [apply(T @ inverse(there), CENTRE_M) for T, there in zip(MADE.T_world_camera, placed, strict=True)]
    error_m = np.mean(seen_m, axis=0) - apply(MADE.T_world_scan, CENTRE_M)
    lever = np.hstack([np.eye(3), -skew(held.T_world_scan[:3, :3] @ CENTRE_M)])
    stated_m = np.sqrt(np.trace(lever @ component @ lever.T))
    assert np.linalg.norm(error_m) == pytest.approx(stated_m, rel=0.15)


def test_control_spheres_are_judged_without_the_images_that_were_left_out() -> None:
    poses = MADE.T_world_camera.copy()
    poses[7, :3, 3] += [3e-3, -3e-3, 2.6e-3]
    every = np.vstack([REGISTRATION_M, CONTROL_M])
    found = [exact_outlines(MADE, i, every, 0.1, seed=8) for i in range(N)]
    named = [
        Assignment({j: k for j, k in enumerate(names) if k < len(REGISTRATION_M)}, a.T_camera_scan)
        for (_, names), a in zip(found, NAMED, strict=True)
    ]
    spheres = ScanSpheres(REGISTRATION_M, RADIUS_M, control_m=CONTROL_M)
    images = PosedImages(poses, MADE.camera)
    result = register_images([outlines for outlines, _ in found], images, spheres, assignments=named)
    assert result.controls is not None
    assert result.controls.findings == ()
    assert max(s.expected for s in result.controls.spheres) <= N - 1
