"""The search for what a fused surface lacks where it is steep: likeness of patches, choice of moves, the whole."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
from service.compute.stereo.matching import StereoView
from service.compute.stereo.steep import (
    averaged,
    beliefs,
    best_views,
    completed,
    edges_of,
    evidence,
    photograph,
    relaxed,
    seen_through,
)
from service.compute.surfaces.surface import Surface
from service.core.geometry import Array, Transform, look_at

CAMERA = CameraModel(400, 300, 600.0, 600.0, 199.5, 149.5)
DISTANCE_M = 0.3
FOOTPRINT_M = DISTANCE_M / CAMERA.fx
# A ramp of 68° between two floors: from (x, z) = (0, 30 mm) down to (12 mm, 0). The floors end at ± 40 mm.
LOW_X, HIGH_Z, EDGE = 0.012, 0.03, 0.04
SLOPE = np.hypot(LOW_X, HIGH_Z)
NORMAL = np.array([HIGH_Z, 0.0, LOW_X]) / SLOPE


def grid(x: Array, z: Array, step_m: float = 1e-3) -> Surface:
    """A mesh over the polyline (x, z), drawn out along y, faces upward."""
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    at = np.linspace(0, length[-1], round(length[-1] / step_m) + 1)
    y = np.arange(-EDGE, EDGE + step_m / 2, step_m)
    px, pz = np.interp(at, length, x), np.interp(at, length, z)
    vertices = np.stack([np.repeat(px, len(y)), np.tile(y, len(px)), np.repeat(pz, len(y))], axis=1)
    i, j = (k.ravel() for k in np.mgrid[: len(px) - 1, : len(y) - 1])
    a = i * len(y) + j
    faces = np.concatenate([np.stack([a, a + len(y), a + 1], 1), np.stack([a + 1, a + len(y), a + len(y) + 1], 1)])
    return Surface(vertices, faces.astype(np.int64))


FLOORS = (grid(np.array([-EDGE, 0.0]), np.full(2, HIGH_Z)), grid(np.array([LOW_X, EDGE]), np.zeros(2)))
RAMP = grid(np.array([0.0, LOW_X]), np.array([HIGH_Z, 0.0]))


def together(*surfaces: Surface) -> Surface:
    first = np.cumsum([0, *(len(s.vertices_m) for s in surfaces)])
    faces = [s.faces + k for s, k in zip(surfaces, first, strict=False)]
    return Surface(np.concatenate([s.vertices_m for s in surfaces]), np.concatenate(faces))


WHOLE = RayMesh(together(*FLOORS, RAMP).vertices_m, together(*FLOORS, RAMP).faces)


def texture() -> NDArray[np.float32]:
    """Noise of several sizes, a texel for 0.25 mm."""
    rng = np.random.default_rng(5)
    out = np.zeros((800, 800), dtype=np.float32)
    for texels, gain in ((3, 0.6), (8, 1.0), (24, 0.8)):
        coarse = rng.normal(0, 1, (800 // texels + 3, 800 // texels + 3)).astype(np.float32)
        out += gain * cv2.resize(coarse, (800, 800), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 36 * out, 0, 255)


TEXTURE = texture()


def seen_from(T_world_camera: Transform, *, plain: bool = False) -> StereoView:
    """What a camera sees: the texture lies in y and in the length of the polyline."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    depth = WHOLE.depths(T_world_camera, rays.reshape(-1, 3)).reshape(u.shape)
    points = (rays * depth[..., None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    x, y, z = np.moveaxis(np.nan_to_num(points, nan=9.0), -1, 0)
    along = np.clip(x, None, 0) + (HIGH_Z - z.clip(0, HIGH_Z)) / HIGH_Z * SLOPE + np.clip(x - LOW_X, 0, None)
    places = [(k / 0.25e-3 + 400).astype(np.float32) for k in (y, along)]
    image = cv2.remap(TEXTURE, places[0], places[1], cv2.INTER_CUBIC, borderValue=0)
    noise = np.random.default_rng(int(1e4 * abs(T_world_camera[1, 3]))).normal(0, 1, image.shape)
    grey = np.full(image.shape, 90.0) if plain else np.asarray(image, np.float64)
    return StereoView(np.clip(grey + noise, 0, 255).astype(np.uint8), CAMERA, T_world_camera)


def poses() -> list[Transform]:
    """From nearly above, where the ramp is seen at 52° to 72° from its normal."""
    out: list[Transform] = []
    for tilt in np.radians([-4.0, 14.0]):
        for side in np.radians([-24.0, -8.0, 8.0, 24.0]):
            toward = np.array([np.tan(tilt), np.tan(side), 1.0])
            eye = DISTANCE_M * toward / np.linalg.norm(toward) + [0.006, 0, 0.015]
            out.append(look_at(eye, np.array([0.006, 0.0, 0.015]), np.array([0.0, 1.0, 0.0])))
    return out


@pytest.fixture(scope="module")
def views() -> list[StereoView]:
    return [seen_from(T) for T in poses()]


def on_the_ramp(count: int) -> Array:
    """Places away from its edges."""
    rng = np.random.default_rng(1)
    down, y = rng.uniform(0.25, 0.75, count), rng.uniform(-0.03, 0.03, count)
    return np.stack([down * LOW_X, y, HIGH_Z * (1 - down)], axis=1)


MOVES: Array = np.arange(-8.0, 9.0) * FOOTPRINT_M


def test_a_steep_place_is_most_alike_where_it_is(views: list[StereoView]) -> None:
    known = RayMesh(together(*FLOORS).vertices_m, together(*FLOORS).faces)
    photographs = [photograph(view, known) for view in views]
    places = on_the_ramp(300)
    normals = np.broadcast_to(NORMAL, places.shape)
    lifted = places + 3 * FOOTPRINT_M * NORMAL  # the guess is wrong
    alike, cosines = evidence(photographs, lifted, normals, MOVES, 1.5 * FOOTPRINT_M)
    assert ((cosines[:, 0] > 0.3) & (cosines[:, 0] < 0.65)).all(), "it is steep for all views"
    found = MOVES[alike.argmax(axis=1)] / FOOTPRINT_M + 3
    assert np.mean(np.abs(found) <= 1) > 0.9
    assert np.median(alike.max(axis=1)) > 0.7


def test_what_is_plain_is_no_evidence() -> None:
    known = RayMesh(together(*FLOORS).vertices_m, together(*FLOORS).faces)
    photographs = [photograph(seen_from(T, plain=True), known) for T in poses()]
    places = on_the_ramp(100)
    alike, _ = evidence(photographs, places, np.broadcast_to(NORMAL, places.shape), MOVES, 1.5 * FOOTPRINT_M)
    assert alike.max() < 0.2, "noise alone"


def test_a_place_behind_the_known_surface_is_seen_by_no_view_and_one_before_it_is_seen_through(
    views: list[StereoView],
) -> None:
    known = RayMesh(FLOORS[0].vertices_m, FLOORS[0].faces)
    photographs = [photograph(view, known) for view in views]
    up = np.array([[0.0, 0.0, 1.0]])
    on, below, above = (np.array([[-0.02, 0.0, HIGH_Z + dz]]) for dz in (0.0, -0.01, 0.01))
    assert (best_views(photographs, on, up)[0] >= 0).all()
    assert (best_views(photographs, below, up)[0] == -1).all()
    assert seen_through(photographs, np.concatenate([on, below, above])).tolist() == [0, 0, len(views)]


@pytest.mark.slow
def test_the_views_of_many_places_take_no_more_memory_than_those_of_a_few(views: list[StereoView]) -> None:
    known = RayMesh(together(*FLOORS).vertices_m, together(*FLOORS).faces)
    photographs = [photograph(view, known) for view in views] * 3
    places = on_the_ramp(40_000)
    normals = np.broadcast_to(NORMAL, places.shape)
    lifted = places[:, None] + np.linspace(-1e-3, 1e-3, 5)[:, None] * NORMAL
    peaks: list[int] = []
    chosen: list[NDArray[np.int64]] = []
    through: list[NDArray[np.int64]] = []
    for part in (slice(0, 10_000), slice(10_000, None), slice(None)):
        tracemalloc.start()
        chosen.append(best_views(photographs, places[part], normals[part])[0])
        through.append(seen_through(photographs, lifted[part]))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert np.array_equal(np.concatenate(chosen[:2]), chosen[2])
    assert np.array_equal(np.concatenate(through[:2]), through[2])
    assert peaks[2] < 2 * peaks[0]


def test_neighbours_decide_where_a_vertex_has_no_evidence_and_outvote_one_that_errs() -> None:
    surface = grid(np.array([0.0, 0.03]), np.zeros(2))
    edges = edges_of(surface.faces)
    assert len(np.unique(edges, axis=0)) == len(edges)
    truth = np.round(4 + 3 * np.sin(surface.vertices_m[:, 1] / 0.02)).astype(int)
    rng = np.random.default_rng(0)
    costs = np.abs(np.arange(9)[None] - truth[:, None]).clip(0, 2) * 0.25
    silent, errs = rng.random(len(truth)) < 0.3, rng.random(len(truth)) < 0.05
    costs[silent] = 0
    costs[errs] = np.abs(np.arange(9)[None] - rng.integers(0, 9, (errs.sum(), 1))).clip(0, 2) * 0.25
    chosen = beliefs(costs.astype(np.float32), edges, 0.06, 0.48).argmin(axis=1)
    assert np.mean(chosen == truth) > 0.9
    assert np.mean(np.abs(chosen - truth)[silent] <= 1) > 0.97


def test_means_with_neighbours_keep_a_constant_and_make_noise_smaller() -> None:
    surface = grid(np.array([0.0, 0.03]), np.zeros(2))
    edges = edges_of(surface.faces)
    noise = np.random.default_rng(0).normal(0, 1, len(surface.vertices_m))
    assert np.abs(averaged(np.full(len(noise), 3.0), edges, 4) - 3).max() < 1e-6
    assert averaged(noise, edges, 4).std() < 0.35


def bumpy_wall() -> tuple[Surface, NDArray[np.bool_], NDArray[np.bool_]]:
    """A plane with a bump of 3 mm, its vertices on that, and those of its border, 3 edges wide."""
    plane = grid(np.array([-EDGE, EDGE]), np.zeros(2), 2e-3)
    x, y = plane.vertices_m[:, 0], plane.vertices_m[:, 1]
    bump = np.hypot(x, y) < 0.02
    border = np.maximum(np.abs(x), np.abs(y)) > EDGE - 5e-3
    return Surface(plane.vertices_m + 3e-3 * bump[:, None] * [0, 0, 1], plane.faces), bump, border


def test_what_has_no_hold_is_bent_to_what_has_and_what_is_fixed_does_not_move() -> None:
    surface, bump, border = bumpy_wall()
    edges = edges_of(surface.faces)
    found = relaxed(surface.vertices_m, np.where(bump, 0.0, 1.0), border, edges, 3e-3, 2e-3)
    assert np.array_equal(found[border], surface.vertices_m[border])
    assert np.abs(found[:, 2]).max() < 0.1e-3
    held = relaxed(surface.vertices_m, np.ones(len(bump)), border, edges, 3e-3, 2e-3)
    middle = np.hypot(*surface.vertices_m[:, :2].T) < 0.01
    assert np.abs(held[middle, 2] - 3e-3).max() < 0.3e-3, "a bump with evidence stays"


def test_noise_of_what_is_held_becomes_smaller_and_a_curved_surface_keeps_its_shape() -> None:
    plane, _, border = bumpy_wall()
    dome = plane.vertices_m.copy()
    dome[:, 2] = np.sqrt(0.1**2 - (dome[:, :2] ** 2).sum(axis=1))
    noise = np.random.default_rng(0).normal(0, 1e-3, len(dome)) * ~border
    rough = dome + noise[:, None] * [0, 0, 1]
    found = relaxed(rough, np.ones(len(dome)), border, edges_of(plane.faces), 3e-3, 2e-3)
    off = found[~border, 2] - np.sqrt(0.1**2 - (found[~border, :2] ** 2).sum(axis=1))
    assert off.std() < 0.5 * noise[~border].std()
    assert abs(off.mean()) < 0.1e-3


@pytest.mark.slow
def test_a_ramp_that_the_surface_lacks_is_added_where_it_is(views: list[StereoView]) -> None:
    known = together(*FLOORS)
    found = completed(known, views, FOOTPRINT_M)
    assert np.array_equal(found.vertices_m[: len(known.vertices_m)], known.vertices_m)
    added = found.vertices_m[found.faces[len(known.faces) :]].mean(axis=1)
    assert len(added) > 50
    inner = added[(np.abs(added[:, 1]) < 0.03) & (added[:, 2] > 0.003) & (added[:, 2] < HIGH_Z - 0.003)]
    off_m = np.abs((inner - [LOW_X, 0, 0]) @ NORMAL)
    assert np.median(off_m) < 0.6 * FOOTPRINT_M
    assert np.mean(off_m < 2 * FOOTPRINT_M) > 0.9
    cells = {(int(y), int(z)) for y, z in inner[:, 1:] // 3e-3}
    assert len(cells) > 0.8 * 20 * 8, "most of the ramp is covered"


@pytest.mark.slow
def test_nothing_is_added_where_the_photographs_are_plain() -> None:
    known = together(*FLOORS)
    found = completed(known, [seen_from(T, plain=True) for T in poses()], FOOTPRINT_M)
    assert len(found.faces) == len(known.faces)
