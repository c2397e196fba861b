"""The simulated camera's image agrees with its geometry to hundredths of a pixel, and with its settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.compute.markers.detect import detect_spheres
from simulators.geometry import apply, inverse, look_at
from simulators.rendering.overlays import Frame, draw_sphere, half_plane_coverage
from simulators.rendering.render import PREVIEW_WIDTH, REFERENCE, Renderer
from simulators.scene.intrinsics import Intrinsics
from simulators.scene.world import (
    BOARD_SQUARE_M,
    BOARD_SQUARES,
    NOMINAL_LUX,
    RADIUS_M,
    SCENE_CENTRE_M,
    Scene,
    board_sag_m,
)

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

WIDTH = 600
SEED = 7
OBLIQUE = look_at(np.array([0.12, -0.30, 0.58]), SCENE_CENTRE_M, np.array([0.0, 1.0, 0.0]))
ABOVE = look_at(np.array([0.02, -0.05, 0.70]), SCENE_CENTRE_M, np.array([0.0, 1.0, 0.0]))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.generate(SEED)


@pytest.fixture(scope="module")
def renderer(scene: Scene) -> Renderer:
    renderer = Renderer(WIDTH)
    renderer.surfaces(scene.seed)
    return renderer


@pytest.fixture(scope="module")
def plain(renderer: Renderer, scene: Scene) -> Picture:
    return renderer.render(view(scene, OBLIQUE), REFERENCE, 1)


def view(scene: Scene, T_world_camera: Array, **changes: Any) -> dict[str, Any]:
    """The world's answer, with the scene's true lens unless another one is given."""
    lens: Intrinsics = changes.pop("lens", None) or scene.camera_intrinsics(WIDTH)
    lux = changes.pop("light_lux", NOMINAL_LUX)
    return {
        "T_world_camera": T_world_camera.tolist(),
        "intrinsics": lens.to_json(),
        "scene": {"seed": scene.seed, "spray": False, "control_spheres": False, "board": None, **changes},
        "light_lux": lux,
    }


def linear(picture: Picture) -> Array:
    """Linear light 0…1 of sRGB bytes."""
    v = picture.astype(np.float64) / 255.0
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


# --- geometry ---------------------------------------------------------------------------------------------


def outline(lens: Intrinsics, centre_camera: Array) -> Array:
    """Pixels (2000, 2) of the rays tangent to a sphere."""
    distance = float(np.linalg.norm(centre_camera))
    axis = centre_camera / distance
    e1 = np.cross(axis, [0.0, 1.0, 0.0])
    e1 /= np.linalg.norm(e1)
    azimuth = np.linspace(0.0, 2 * np.pi, 2000, endpoint=False)[:, None]
    angle = np.arcsin(RADIUS_M / distance)
    return lens.project(
        np.cos(angle) * axis + np.sin(angle) * (np.cos(azimuth) * e1 + np.sin(azimuth) * np.cross(axis, e1))
    )


def test_a_sphere_covers_exactly_what_its_outline_encloses(scene: Scene) -> None:
    lens = scene.camera_intrinsics(WIDTH)
    u, v = np.meshgrid(np.arange(lens.width, dtype=np.float64), np.arange(lens.height, dtype=np.float64))
    rays = lens.rays(np.stack([u, v], axis=-1))
    far = np.full(rays.shape[:2], 9.0, np.float32)
    for centre in (np.array([0.01, -0.02, 0.6]), np.array([0.16, 0.09, 0.55]), np.array([-0.15, 0.1, 0.7])):
        black, white = (
            Frame(np.full(rays.shape, tone, np.float32), far.copy(), rays, np.eye(4), lens, 0) for tone in (0.0, 1.0)
        )
        for frame in (black, white):
            draw_sphere(frame, centre, centre, RADIUS_M, scene.lamp_m)
        # The fraction of background that shines through, independent of the sphere's colour.
        cover = (1.0 - (white.colour - black.colour)).mean(axis=2).astype(np.float64)
        edge = outline(lens, centre)
        x, y = edge.T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        area = cross.sum() / 2
        middle = ((edge + np.roll(edge, -1, axis=0)) * cross[:, None]).sum(axis=0) / (6 * area)
        radius = np.sqrt(abs(area) / np.pi)
        assert np.sqrt(cover.sum() / np.pi) == pytest.approx(radius, abs=0.005)
        assert [(cover * u).sum() / cover.sum(), (cover * v).sum() / cover.sum()] == pytest.approx(middle, abs=0.005)


@pytest.mark.slow
def test_sphere_outlines_in_the_picture_lie_on_the_analytic_cone(plain: Picture, scene: Scene) -> None:
    camera = CameraModel(**dataclasses.asdict(scene.camera_intrinsics(WIDTH)))
    found = detect_spheres(np.ascontiguousarray(plain[..., ::-1]), camera)
    centres = apply(inverse(OBLIQUE), scene.registration_m)
    cones = [cone_of_sphere(centre, RADIUS_M) for centre in centres]
    shifts: list[Array] = []
    for outline_found in found:
        cone = outline_found.cone
        nearest = min(cones, key=lambda c: float(np.linalg.norm(c.axis - cone.axis)))
        # Offset from the axis (2) and excess size (1), in pixels.
        axis = camera.fx * (cone.frame()[:, :2].T @ nearest.axis)
        shifts.append(np.append(axis, camera.fx * (cone.half_angle_rad - nearest.half_angle_rad)))
    assert len(shifts) >= 7
    # Shadow and gamma bias the detector on spheres of 20 pixels; the exact coverage is tested above.
    centre_and_size_px = np.median(shifts, axis=0)
    assert np.abs(centre_and_size_px[:2]).max() < 0.15
    assert abs(centre_and_size_px[2]) < 0.03


def _inner_corners() -> Array:
    """(N, 3) of the simulated board, if it were flat."""
    columns, rows = BOARD_SQUARES[0] - 1, BOARD_SQUARES[1] - 1
    x, y = np.meshgrid(np.arange(columns) * BOARD_SQUARE_M, np.arange(rows) * BOARD_SQUARE_M)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64)


def test_checkerboard_corners_lie_where_the_lens_projects_them(renderer: Renderer, scene: Scene) -> None:
    T_world_board = scene.board_placement(1)
    lens = scene.camera_intrinsics(WIDTH)
    picture = renderer.render(view(scene, ABOVE, board=T_world_board.tolist()), REFERENCE, 1)
    board = _inner_corners()
    board[:, 2] = board_sag_m(board[:, 0], board[:, 1])
    true = lens.project(apply(inverse(ABOVE) @ T_world_board, board))
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    start = (true + 0.7).astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    found = cv2.cornerSubPix(grey, start, (4, 4), (-1, -1), stop).reshape(-1, 2)
    error = found - true
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.02
    # The image contains the distortion: without it the corners would not fit.
    pinhole = dataclasses.replace(lens, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    straight = pinhole.project(apply(inverse(ABOVE) @ T_world_board, board))
    assert np.linalg.norm(found - straight, axis=1).max() > 0.5


def test_the_simulated_board_is_bent_as_its_ground_truth_says(renderer: Renderer, scene: Scene) -> None:
    T_world_board = scene.board_placement(1)
    lens = scene.camera_intrinsics(WIDTH)
    # Seen from the side, where a displacement along the board's normal shows.
    aside = look_at(np.array([0.2, -0.45, 0.55]), np.array([0.0, 0.0, 0.14]), np.array([0.0, 1.0, 0.0]))
    picture = renderer.render(view(scene, aside, board=T_world_board.tolist()), REFERENCE, 1)
    T_camera_board, corners = inverse(aside) @ T_world_board, _inner_corners()
    flat = lens.project(apply(T_camera_board, corners))
    corners[:, 2] = board_sag_m(corners[:, 0], corners[:, 1])
    bent = lens.project(apply(T_camera_board, corners))
    inside = ((bent > 8) & (bent < np.array([lens.width, lens.height]) - 9)).all(axis=1)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    start = bent[inside].astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(grey, start, (3, 3), (-1, -1), stop).reshape(-1, 2)
    moved, shift = (found - flat[inside]).ravel(), (bent - flat)[inside].ravel()
    assert np.abs(shift).max() > 0.03
    assert inside.sum() > 100
    assert moved @ shift / (shift @ shift) == pytest.approx(1.0, abs=0.25)


def test_a_half_plane_covers_what_fine_sampling_says() -> None:
    side = (np.arange(400) + 0.5) / 400 - 0.5
    u, v = np.meshgrid(side, side)
    for angle in (0.0, 0.3, np.pi / 4, 2.0):
        normal = np.cos(angle), np.sin(angle)
        for distance in (-0.6, -0.3, 0.0, 0.11, 0.45, 0.8):
            exact = half_plane_coverage(*(np.array([value]) for value in (distance, *normal)))[0]
            assert exact == pytest.approx(np.mean(distance + u * normal[0] + v * normal[1] > 0), abs=3e-3)


def test_rays_and_projection_are_inverse_over_the_whole_image(scene: Scene) -> None:
    lens = scene.lens
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, 30), np.linspace(0, lens.height - 1, 20))
    pixels = np.stack([u, v], axis=-1)
    assert np.abs(lens.project(lens.rays(pixels)) - pixels).max() < 1e-6


def test_a_scaled_lens_sees_the_same_directions(scene: Scene) -> None:
    small = scene.camera_intrinsics(WIDTH)
    # The corners of the image lie half a pixel outside the outermost pixel centres.
    corners = [np.array([[-0.5, -0.5], [lens.width - 0.5, lens.height - 0.5]]) for lens in (scene.lens, small)]
    assert np.allclose(scene.lens.rays(corners[0]), small.rays(corners[1]), atol=1e-9)


# --- exposure and noise -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_exposure_follows_the_settings_and_the_light(renderer: Renderer, scene: Scene, plain: Picture) -> None:
    changes: list[tuple[Mapping[str, float], float, float]] = [
        ({"exposure_s": 1 / 30}, NOMINAL_LUX, 0.5),
        ({"aperture_f": 22.0 * np.sqrt(2), "iso": 200.0}, NOMINAL_LUX, 1.0),
        ({}, NOMINAL_LUX / 2, 0.5),
    ]
    reference = linear(plain)
    unsaturated = (plain.max(axis=2) < 240) & (plain.min(axis=2) > 20)
    for settings, lux, gain in changes:
        picture = renderer.render(view(scene, OBLIQUE, light_lux=lux), {**REFERENCE, **settings}, 1)
        ratio = linear(picture)[unsaturated].mean() / reference[unsaturated].mean()
        assert ratio == pytest.approx(gain, rel=0.02)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_picture_and_another_only_other_noise(
    renderer: Renderer, scene: Scene, plain: Picture
) -> None:
    again = renderer.render(view(scene, OBLIQUE), REFERENCE, 1)
    assert np.array_equal(again, plain)
    other = renderer.render(view(scene, OBLIQUE), REFERENCE, 2)
    difference = other.astype(np.float64) - plain
    assert 0.2 < difference.std() < 4.0
    assert abs(difference.mean()) < 0.02


# --- what lies there --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_control_spheres_and_spray_change_only_what_they_touch(
    renderer: Renderer, scene: Scene, plain: Picture
) -> None:
    lens = scene.camera_intrinsics(WIDTH)
    with_spheres = renderer.render(view(scene, OBLIQUE, control_spheres=True), REFERENCE, 1)
    sprayed = renderer.render(view(scene, OBLIQUE, spray=True), REFERENCE, 1)
    control = np.round(lens.project(apply(inverse(OBLIQUE), scene.control_m))).astype(np.int64)
    registration = np.round(lens.project(apply(inverse(OBLIQUE), scene.registration_m))).astype(np.int64)
    for column, row in control:
        patch = np.s_[row - 3 : row + 4, column - 3 : column + 4]
        there, away = with_spheres[patch].mean(axis=(0, 1)), plain[patch].mean(axis=(0, 1))
        assert np.abs(there - away).max() > 25
    # A coat of chalk is paler than wet tissue.
    coated = np.abs(sprayed.astype(float) - plain).max(axis=2) > 25
    assert 0.02 < coated.mean() < 0.6
    assert np.ptp(sprayed[coated], axis=1).mean() < 0.7 * np.ptp(plain[coated], axis=1).mean()
    for column, row in registration:
        patch = np.s_[row - 3 : row + 4, column - 3 : column + 4]
        assert np.abs(with_spheres[patch].astype(float) - plain[patch]).mean() < 3
        assert np.abs(sprayed[patch].astype(float) - plain[patch]).mean() < 3


@pytest.mark.slow
def test_the_preview_is_small_and_shows_the_same(scene: Scene, plain: Picture) -> None:
    wide = Renderer(780)
    assert WIDTH < PREVIEW_WIDTH < wide.image_width
    small = wide.preview(view(scene, OBLIQUE, lens=scene.camera_intrinsics(780)))
    assert small.shape == (427, PREVIEW_WIDTH, 3)
    shrunk = cv2.resize(plain, (60, 40), interpolation=cv2.INTER_AREA).astype(np.float64)
    alike = cv2.resize(small, (60, 40), interpolation=cv2.INTER_AREA).astype(np.float64)
    assert np.corrcoef(shrunk.ravel(), alike.ravel())[0, 1] > 0.98
