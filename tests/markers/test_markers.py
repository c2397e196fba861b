"""The sphere detector: cones, sub-pixel outlines, and disturbances that it must tolerate."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, angles_to, cone_ellipse, cone_of_sphere, fit_cone, ransac_cone
from service.compute.markers.detect import detect_spheres, options_for
from service.compute.markers.records import (
    DetectionOptions,
    SphereOutline,
    chromaticity,
    learn_colour,
    outline_from_record,
    outline_record,
)
from service.compute.markers.refine import approach_outlines, refine_outline
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array
from tests.support.scenes.sphere_conditions import COLOURS_BGR, Look, render_look
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, camera, render, scene

directions = st.tuples(st.floats(-0.35, 0.35), st.floats(-0.25, 0.25), st.floats(0.4, 1.5))


def sphere_at(where: tuple[float, float, float]) -> Array:
    return np.array([where[0] * where[2], where[1] * where[2], where[2]])


@given(directions)
def test_points_on_the_ellipse_are_on_the_conic_and_on_the_sphere(where: tuple[float, float, float]) -> None:
    centre = sphere_at(where)
    cone = cone_of_sphere(centre, RADIUS_M)
    points = cone_ellipse(cone).equidistant(200)
    lifted = np.column_stack([points, np.ones(200)])
    value = np.einsum("ni,ij,nj->n", lifted, cone.conic, lifted)
    assert np.abs(value).max() < 1e-12
    rays = lifted / np.linalg.norm(lifted, axis=1, keepdims=True)
    gap = np.linalg.norm(np.cross(rays, centre), axis=1)
    assert np.allclose(gap, RADIUS_M, atol=1e-10)
    spacing = np.linalg.norm(np.diff(np.vstack([points, points[:1]]), axis=0), axis=1)
    assert spacing.max() / spacing.min() < 1.01


@given(directions)
def test_conic_equals_the_papers_projection_of_the_quadric(where: tuple[float, float, float]) -> None:
    c = sphere_at(where)
    Q = np.block([[np.eye(3), -c[:, None]], [-c[None], np.array([[c @ c - RADIUS_M**2]])]])
    P = np.hstack([np.eye(3), np.zeros((3, 1))])
    conic = np.linalg.inv(P @ np.linalg.inv(Q) @ P.T)
    conic *= np.sign(np.trace(conic)) / np.linalg.norm(conic)
    assert np.allclose(conic, cone_of_sphere(c, RADIUS_M).conic, atol=1e-9)


@settings(max_examples=25)
@given(directions, st.integers(0, 10_000), st.floats(0.35, 0.9))
def test_ransac_finds_the_cone_among_outliers(where: tuple[float, float, float], seed: int, part: float) -> None:
    rng = np.random.default_rng(seed)
    truth = cone_of_sphere(sphere_at(where), RADIUS_M)
    start = Cone(truth.axis, truth.half_angle_rad)
    n = 120
    azimuth = np.arange(n) * 2 * np.pi / n
    visible = azimuth < part * 2 * np.pi
    wrong = truth.half_angle_rad * rng.uniform(0.75, 1.25, n)
    rays = truth.rays(azimuth, np.where(visible, truth.half_angle_rad, wrong))
    result = ransac_cone(
        rays, np.ones(n), np.arange(n), (0.5 * truth.half_angle_rad, 2 * truth.half_angle_rad), 2e-4, rng
    )
    assert result is not None
    cone, inlier = result
    # By chance a nearby cone can agree with as many points as the true one; then it is just as good.
    agreeing = np.abs(angles_to(truth, rays)) < 2e-4
    assert inlier.sum() >= 0.9 * agreeing.sum()
    if part > 0.6:
        assert inlier[visible].all()  # the ends of a short arc may be outside such a cone's tolerance
    final = fit_cone(rays[visible], np.ones(int(visible.sum())), start)
    assert float(np.linalg.norm(final.axis - truth.axis)) < 1e-9
    # A short arc amplifies an error within the tolerance several times in the radius.
    assert np.isclose(cone.half_angle_rad, truth.half_angle_rad, atol=8e-4)


def errors_px(
    found: tuple[SphereOutline, ...], centres: Array, fx: float
) -> tuple[list[float], list[float], list[int]]:
    """Axis errors, radius errors and identities of detections, compared with the true spheres."""
    truth = [cone_of_sphere(c, RADIUS_M) for c in centres]
    axes, radii, ids = [], [], []
    for o in found:
        gaps = [float(np.linalg.norm(o.cone.axis - t.axis)) * fx for t in truth]
        k = int(np.argmin(gaps))
        axes.append(gaps[k])
        radii.append((o.cone.half_angle_rad - truth[k].half_angle_rad) * fx)
        ids.append(k)
    return axes, radii, ids


@pytest.mark.slow
def test_all_whole_spheres_are_found_to_a_tenth_of_a_pixel_without_bias() -> None:
    made = scene(4)
    everything = np.vstack([REGISTRATION_M, CONTROL_M])
    all_axes: list[float] = []
    all_radii: list[float] = []
    for i in (0, 1):
        c = made.centres_camera(i, everything)
        found = detect_spheres(render(made.camera, c, i), made.camera)
        axes, radii, ids = errors_px(found, c, made.camera.fx)
        pixels = made.camera.project(c)
        whole = np.all((pixels > 60) & (pixels < np.array([made.camera.width, made.camera.height]) - 60), axis=1)
        assert set(np.nonzero(whole)[0]) <= set(ids)
        assert len(set(ids)) == len(ids)
        assert max(axes) < 0.2
        all_axes += axes
        all_radii += radii
    assert float(np.sqrt(np.mean(np.square(all_axes)))) < 0.08
    assert abs(float(np.mean(all_radii))) < 0.04


@pytest.mark.parametrize(
    ("colour", "blur_px"), [((0.1, 0.35, 0.12), 0.6), ((0.05, 0.25, 0.8), 0.9), ((0.25, 0.25, 0.25), 1.6)]
)
def test_other_colours_and_defocus(colour: tuple[float, float, float], blur_px: float) -> None:
    cam = camera(1024)
    centres = np.array([[-0.1, -0.05, 0.6], [0.08, 0.06, 0.65], [0.1, -0.06, 0.7]])
    found = detect_spheres(render(cam, centres, 3, colour=colour, blur_px=blur_px), cam)
    axes, radii, ids = errors_px(found, centres, cam.fx)
    assert sorted(ids) == [0, 1, 2]
    assert max(axes) < 0.25
    assert max(map(abs, radii)) < 0.25


def test_occlusion_and_border_leave_the_outline_right() -> None:
    cam = camera(1024)
    centres = np.array([[-0.1, -0.05, 0.6], [0.08, 0.04, 0.65], [0.0, 0.138, 0.6]])
    image = render(cam, centres, 5)
    first = cam.project(centres)[0].round().astype(int)
    cv2.line(
        image, (int(first[0]) - 60, int(first[1]) - 30), (int(first[0]) + 60, int(first[1]) + 5), (40, 40, 45), 9
    )
    found = detect_spheres(image, cam)
    axes, _, ids = errors_px(found, centres, cam.fx)
    assert {0, 1} <= set(ids)
    assert max(axes) < 0.4
    assert any(o.coverage < 0.9 for o in found)


def test_an_image_without_spheres_has_none() -> None:
    cam = camera(1024)
    assert detect_spheres(render(cam, np.zeros((0, 3)), 8, occluders=6), cam) == ()


def test_squares_and_ellipses_are_no_spheres() -> None:
    cam = camera(1024)
    image = render(cam, np.zeros((0, 3)), 9)
    cv2.rectangle(image, (200, 200), (280, 280), (190, 190, 190), -1)
    cv2.ellipse(image, (600, 300), (70, 35), 20, 0, 360, (190, 190, 190), -1, cv2.LINE_AA)
    assert detect_spheres(image, cam) == ()


def test_refining_near_a_prediction_gives_the_same_outline() -> None:
    cam = camera(1024)
    centre = np.array([0.05, 0.02, 0.6])
    image = render(cam, centre[None], 4)
    truth = cone_of_sphere(centre, RADIUS_M)
    shifted = Cone(truth.frame() @ np.array([0.001, -0.001, 1.0]), truth.half_angle_rad * 1.03)
    found = refine_outline(image, cam, Cone(shifted.axis / np.linalg.norm(shifted.axis), shifted.half_angle_rad))
    assert found is not None
    assert np.linalg.norm(found.cone.axis - truth.axis) * cam.fx < 0.1
    away = cone_of_sphere(np.array([-0.12, -0.06, 0.6]), RADIUS_M)
    assert refine_outline(image, cam, away) is None


def test_record_is_whole() -> None:
    cam = camera(1024)
    centre = np.array([0.05, 0.02, 0.6])
    (found,) = detect_spheres(render(cam, centre[None], 4), cam, DetectionOptions(n_points=150))
    assert found.points.shape == found.points_px.shape == found.captured_px(cam).shape == (150, 2)
    assert found.semi_axes_px[0] >= found.semi_axes_px[1] > 30
    assert np.allclose(found.centre_camera_m(RADIUS_M), centre, atol=0.003)
    assert 0.4 < found.coverage <= 1
    assert 0 < found.rms_px < 0.3


def test_an_outline_survives_its_record() -> None:
    cam = camera(1024)
    (found,) = detect_spheres(render(cam, np.array([[0.05, 0.02, 0.6]]), 4), cam)
    again = outline_from_record(json.loads(json.dumps(outline_record(found))), cam)
    for name in (field.name for field in dataclasses.fields(SphereOutline) if field.name != "cone"):
        assert np.array_equal(getattr(again, name), getattr(found, name)), name
    assert np.array_equal(again.cone.axis, found.cone.axis)


def test_wrong_size_is_refused() -> None:
    with pytest.raises(DataError, match="768×512"):
        detect_spheres(np.zeros((512, 768, 3), np.uint8), camera(1024))


TWO_LAMPS = (((0.8, -0.2, -0.5), 0.45), ((-0.7, -0.4, -0.6), 0.4))
CONDITIONS = [
    Look("green", "wood", (((0.95, 0.1, -0.25), 0.8),), blur_px=0.6),
    Look("blue", "green cloth", TWO_LAMPS, subsampled=False),
    Look("green", "blood", srgb=False),
    Look("white", "white cloth", gloss=0.6),
    Look("orange", "blood", wires=6, stains=2),
    Look("green", "skin", srgb=False, quality=85),
]
# No detection may be anything else; spheres covered by wires may have too little outline left.
LEAST_FOUND = [3, 3, 3, 3, 2, 3]


@pytest.mark.parametrize(
    ("look", "least"), list(zip(CONDITIONS, LEAST_FOUND, strict=True)), ids=lambda value: getattr(value, "colour", "")
)
def test_outlines_are_right_and_know_how_right_under_any_light(look: Look, least: int) -> None:
    cam = camera(800)
    centres = np.array([[-0.11, -0.06, 0.55], [0.08, 0.06, 0.6], [0.1, -0.06, 0.65]])
    options = replace(options_for("orange"), srgb=look.srgb) if look.wires else DetectionOptions(srgb=look.srgb)
    found = detect_spheres(render_look(cam, centres, look, seed=2), cam, options)
    axes, radii, ids = errors_px(found, centres, cam.fx)
    assert len(ids) == len(set(ids)) >= least
    assert max(axes) < 0.35
    assert max(map(abs, radii)) < 0.2
    chi2: list[float] = []
    for o, k in zip(found, ids, strict=True):
        truth = cone_of_sphere(centres[k], RADIUS_M)
        e = np.append(
            o.cone.frame()[:, :2].T @ (truth.axis - o.cone.axis), truth.half_angle_rad - o.cone.half_angle_rad
        )
        chi2.append(float(e @ np.linalg.solve(o.cone_covariance, e)) / 3)
    assert 0.02 < float(np.mean(chi2)) < 6


@pytest.mark.slow
def test_a_colour_given_in_advance_leaves_out_discs_of_another() -> None:
    cam = camera(800)
    centres = np.array([[-0.08, -0.03, 0.55], [0.08, 0.03, 0.6]])
    image = render_look(cam, centres, Look("green", "skin", posts=False), seed=3)
    for colour in ("green", "#bade52"):
        found = detect_spheres(image, cam, options_for(colour))
        assert sorted(errors_px(found, centres, cam.fx)[2]) == [0, 1]
    for colour in ("white", "orange", "grey", "#2030d0"):
        assert detect_spheres(image, cam, options_for(colour)) == ()


@given(st.floats(0.05, 1.0), st.sampled_from(sorted(COLOURS_BGR)))
def test_chromaticity_does_not_change_with_the_lights_strength(strength: float, colour: str) -> None:
    linear = np.array([COLOURS_BGR[colour]])
    bright = 255 * linear
    assert np.allclose(chromaticity(strength * bright, srgb=False), chromaticity(bright, srgb=False), atol=0.02)


def test_no_colour_is_learnt_from_discs_that_do_not_agree() -> None:
    tones = 255 * np.array([COLOURS_BGR[name] for name in ("green", "orange", "blue", "white")])
    weights, clear = np.ones(4), np.ones(4, dtype=np.bool_)
    assert learn_colour(tones, weights, clear, srgb=False) is None
    same = np.vstack([tones[:1], 0.6 * tones[:1], 0.8 * tones[:1], tones[1:2]])
    learnt = learn_colour(same, weights, clear, srgb=False)
    assert learnt is not None
    assert (learnt.distance(same) < 1).tolist() == [True, True, True, False]


def test_an_unknown_colour_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="mauve"):
        options_for("mauve")


def test_a_stain_on_a_sphere_is_no_sphere_and_green_cloth_has_none() -> None:
    cam = camera(800)
    assert detect_spheres(render_look(cam, np.zeros((0, 3)), Look("green", "green cloth"), seed=1), cam) == ()
    centres = np.array([[-0.08, -0.03, 0.55], [0.08, 0.03, 0.6]])
    found = detect_spheres(render_look(cam, centres, Look("white", "wood", stains=3), seed=3), cam)
    assert sorted(errors_px(found, centres, cam.fx)[2]) == [0, 1]


def test_an_arc_that_fills_the_image_is_no_outline_and_no_fault() -> None:
    # Of a sphere larger than the image only arcs are visible: fits gave negative radii, and an IndexError.
    rng = np.random.default_rng(0)
    width = 256
    y, x = np.mgrid[:width, :width].astype(np.float64)
    lens = CameraModel(width, width, 400, 400, 127.5, 127.5)
    for _ in range(12):
        middle, radius = rng.uniform(-0.5, 1.5, 2) * width, rng.uniform(0.2, 1.5) * width
        off = np.hypot(x - middle[0], y - middle[1])
        height = np.sqrt(np.clip(1 - (off / radius) ** 2, 0, 1))[..., None]
        ball = rng.uniform(30, 250, 3) * (0.3 + 0.7 * height)
        shown = np.where((off < radius)[..., None], ball, rng.uniform(0, 255, 3))
        image = np.clip(shown + rng.normal(0, 4, shown.shape), 0, 255).astype(np.uint8)
        for radius_px in (1.5, 3.0, 12.0, radius):
            for at in middle + radius * np.array([[0, 0], [1, 0], [0, -1]]):
                ray = np.append((at - 127.5) / 400, 1.0)
                cone = Cone(ray / float(np.linalg.norm(ray)), float(np.arctan(radius_px / 400)))
                for found in approach_outlines(image, lens, [cone]):
                    assert found is None or 0 < found.cone.half_angle_rad < np.pi / 2


@pytest.mark.slow
def test_a_sphere_of_any_size_is_found_where_its_size_is_told() -> None:
    width, height, radius = 1024, 700, 300.0
    lens = CameraModel(width, height, 1228, 1228, 511.5, 349.5)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    off = np.hypot(x - 522, y - 342)
    shade = 0.35 + 0.65 * np.sqrt(np.clip(1 - (off / radius) ** 2, 0, 1))[..., None]
    shown = cv2.GaussianBlur(np.where((off < radius)[..., None], shade * [40, 120, 230], [60.0, 80, 70]), (0, 0), 1.0)
    noise = np.random.default_rng(0).normal(0, 2, shown.shape)
    image = np.clip(shown + noise, 0, 255).astype(np.uint8)
    assert not detect_spheres(image, lens, options_for(None))
    (found,) = detect_spheres(image, lens, options_for(None, 0.45))
    assert max(found.semi_axes_px) == pytest.approx(radius, abs=1.5)


@pytest.mark.parametrize("side", [(1.0, 0.1), (-0.3, 1.0), (-0.8, -0.6), (0.2, -1.0)])
def test_a_large_ball_half_in_shadow_before_a_dark_ground_is_found(side: tuple[float, float]) -> None:
    # Its dark side merges with the background without an edge, which was mistaken for more of the same colour.
    cam = camera(280)
    centre = np.array([[0.0, -0.001, RADIUS_M * cam.fx / (0.21 * cam.width)]])
    lamp = ((side[0], side[1], -0.6), 0.8)
    image = render_look(cam, centre, Look("grey", "black velvet", (lamp,), ambient=0.01, posts=False), seed=1)
    (found,) = detect_spheres(image, cam, options_for(None, 0.4))
    axes, radii, _ = errors_px((found,), centre, cam.fx)
    assert max(axes + [abs(r) for r in radii]) < 0.5


@pytest.mark.parametrize(("colour", "mirror"), [("white", 0.45), ("orange", 0.45), ("grey", 0.2)])
def test_the_limb_of_a_glossy_ball_is_its_outline_not_the_horizon_that_it_mirrors(colour: str, mirror: float) -> None:
    cam = camera(280)
    centre = np.array([[0.005, 0.0, 0.12]])
    look = Look(colour, "table", mirror=mirror, up=(0, 0, -1), posts=False, gloss=0.3)
    found = detect_spheres(render_look(cam, centre, look, seed=1), cam, options_for(None, 0.4))
    assert len(found) == 1 or mirror < 0.3  # a grey ball hardly differs from a grey table: refused rather than wrong
    assert all(abs(off) < 2.0 for off in errors_px(found, centre, cam.fx)[1])  # the ring is 12 px within


def test_orange_is_orange_in_a_pale_picture_and_no_other_colour_is() -> None:
    cam = camera(500)
    centres = np.array([[-0.08, -0.03, 0.45], [0.08, 0.03, 0.5], [0.0, 0.05, 0.5]])
    pale = Look("orange", "table", pale=0.35, balance_bgr=(1.0, 0.95, 0.9), posts=False)
    found = detect_spheres(render_look(cam, centres, pale, seed=3), cam, options_for("orange"))
    assert sorted(errors_px(found, centres, cam.fx)[2]) == [0, 1, 2]
    for colour in ("blue", "white", "green"):
        other = render_look(cam, centres, Look(colour, "table", pale=0.35, posts=False), seed=3)
        assert detect_spheres(other, cam, options_for("orange")) == ()
