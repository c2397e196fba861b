"""Fusion of CT and scan: accuracy against a known surface, the seam, sources, corrections, and the frames' checks."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from service.compute.surfaces.align import close_transforms, distance_changes
from service.compute.surfaces.fuse import (
    Fused,
    FusionSettings,
    Markers,
    Source,
    fuse,
    moved_unfolded,
    without_markers,
)
from service.compute.surfaces.overlap import Box, Prism, RegionCorrection, corrected, outline, overlap, rim_vertices
from service.compute.surfaces.surface import IntArray, Surface
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, transform
from tests.support.ct.fused_scene import BIAS_M, HALF_M, WOUND_M, ct_mesh, height, scan_mesh

UP = np.array([0.0, 0.0, 1.0])
CT_NOISE_M, SCAN_NOISE_M = 4e-5, 5e-5


@cache
def fused(ct_noise_m: float = 0.0, scan_noise_m: float = 0.0) -> Fused:
    return fuse(ct_mesh(ct_noise_m), scan_mesh(scan_noise_m), UP)


def top_error(of: Fused) -> tuple[IntArray, Array]:
    """Indices of the vertices on top, away from the block's edges, and how far each is above the truth."""
    p = of.surface.vertices_m
    top = np.flatnonzero((p[:, 2] > 0.01) & np.all(np.abs(p[:, :2]) < np.array(HALF_M) - 0.006, axis=1))
    x, y, z = p[top].T
    step = 1e-6
    slope = np.hypot(
        (height(x + step, y) - height(x - step, y)) / (2 * step),
        (height(x, y + step) - height(x, y - step)) / (2 * step),
    )
    return top, (z - height(x, y)) / np.sqrt(1 + slope**2)


@pytest.mark.slow
def test_the_fused_mesh_is_within_a_tenth_of_a_millimetre_and_the_scans_part_within_its_noise() -> None:
    result = fused(CT_NOISE_M, SCAN_NOISE_M)
    top, error = top_error(result)
    assert np.sqrt(np.mean(error**2)) <= 1e-4
    of_scan = error[result.source[top] == Source.SCAN]
    assert len(of_scan) > 0.3 * len(top)
    assert np.sqrt(np.mean(of_scan**2)) <= 6e-5
    assert result.ct_offset_m == pytest.approx(BIAS_M, abs=2e-5)
    assert result.ct_spread_m == pytest.approx(np.hypot(CT_NOISE_M, 0.6 * SCAN_NOISE_M), rel=0.35)


def test_there_is_no_step_at_the_seam() -> None:
    result = fused()
    top, error = top_error(result)
    above = np.full(len(result.surface.vertices_m), np.nan)
    above[top] = error
    edges = np.concatenate([result.surface.faces[:, [0, 1]], result.surface.faces[:, [1, 2]]])
    jump = np.abs(above[edges[:, 0]] - above[edges[:, 1]])
    assert np.nanmax(jump) <= 5e-5
    assert np.ptp(error) > 0.5 * BIAS_M  # there is something to blend
    assert result.folded == 0


def test_the_ct_follows_the_scan_beside_the_seam_and_is_itself_further_away() -> None:
    shift_m = 3e-4  # of the CT along z: without the field, the blend would have to climb it within 3 mm
    ct = ct_mesh()
    result = fuse(ct.moved(transform(np.eye(3), shift_m * UP)), scan_mesh(), UP)
    top, error = top_error(result)
    away = np.hypot(*result.surface.vertices_m[top, :2].T)
    of_ct = result.source[top] == Source.CT
    seam = of_ct & (away > WOUND_M - 5e-4) & (away < WOUND_M + 5e-4)
    assert np.mean(error[seam]) == pytest.approx(0.0, abs=0.2 * (shift_m + BIAS_M))
    assert np.mean(error[of_ct & (away < 2e-3)]) > 0.5 * (shift_m + BIAS_M)
    width = np.linspace(0.004, 0.016, 25)
    ring = [np.mean(error[(away >= a) & (away < b)]) for a, b in pairwise(width)]
    assert np.max(np.abs(np.diff(ring))) <= 5e-5


def test_no_face_is_turned_over_even_where_the_ct_has_slivers() -> None:
    ct, scan = ct_mesh(), scan_mesh(2 * SCAN_NOISE_M)
    x, y, z = ct.vertices_m.T
    line = np.round((x + HALF_M[0]) / 5e-4).astype(int)
    x = np.where(line % 8 == 1, x - 4.8e-4, x)  # some lines of vertices nearly meet the one before
    before = Surface(np.stack([x, y, np.where(z > 0.01, height(x, y) + BIAS_M, z)], axis=1), ct.faces)
    result = fuse(before, scan, UP, FusionSettings(least_part_m2=0.0, keep_scan_only=False))
    assert len(result.surface.faces) == len(before.faces)
    turned = np.einsum("fi,fi->f", result.surface.area_vectors_m2, before.area_vectors_m2) < 0
    assert not turned.any()
    assert result.folded == 0
    straight = before.vertices_m + result.weight[:, None] * (overlap(before, scan).nearest_m - before.vertices_m)
    would = Surface(straight, before.faces).area_vectors_m2
    assert np.any(np.einsum("fi,fi->f", would, before.area_vectors_m2) < 0)  # a plain move would turn some over


@pytest.mark.parametrize("seed", range(4))
def test_no_face_is_turned_over_by_however_rough_a_move(seed: int) -> None:
    rng = np.random.default_rng(seed)
    voxels = gaussian_filter(rng.standard_normal((32, 32, 32)), 2.0)
    corners, faces, normals, _ = marching_cubes(voxels, 0.0)
    surface = Surface(0.4e-3 * corners, faces.astype(np.int64))
    rough = gaussian_filter(rng.standard_normal(voxels.shape), 0.7)
    place = np.rint(corners).astype(int).T
    move = 1e-3 * (rough / rough.std())[tuple(place)][:, None] * normals
    moved, folded = moved_unfolded(surface, move)
    turned = np.einsum("fi,fi->f", moved.area_vectors_m2, surface.area_vectors_m2) < 0
    assert (folded, np.count_nonzero(turned)) == (0, 0)
    straight = Surface(surface.vertices_m + move, surface.faces).area_vectors_m2
    assert np.count_nonzero(np.einsum("fi,fi->f", straight, surface.area_vectors_m2) < 0) > 1000
    away_m = np.linalg.norm(moved.vertices_m - surface.vertices_m - move, axis=1)
    assert np.median(away_m) < 1e-3, "the surface still follows the move"


def test_the_ct_is_in_the_wound_the_scan_outside_and_the_mesh_closed() -> None:
    result = fused(CT_NOISE_M, SCAN_NOISE_M)
    p = result.surface.vertices_m
    away = np.hypot(p[:, 0], p[:, 1])
    top, _ = top_error(result)
    assert np.all(result.source[top][away[top] < WOUND_M - 5e-4] == Source.CT)
    assert np.all(result.source[top][away[top] > WOUND_M + 0.0065] == Source.SCAN)
    assert np.any(result.source[top] == Source.BLEND)
    assert np.all(result.wound[top][away[top] < WOUND_M - 1e-3])
    assert not np.any(result.wound[p[:, 2] < 0.001])  # the underside lacks the scan, too, but is no wound
    assert trimesh.Trimesh(p, result.surface.faces, process=False).is_watertight
    assert len(rim_vertices(result.surface)) == 0


@pytest.mark.slow
def test_sigma_is_each_sources_and_includes_the_alignment() -> None:
    result = fused()
    assert np.all(result.sigma_m[result.source == Source.SCAN] == pytest.approx(5e-5))
    assert np.all(result.sigma_m[result.source == Source.CT] == pytest.approx(1e-4))
    covariance = np.diag([0, 0, 4e-8, 0, 0, 0])  # 0.2 mm along z
    aligned = fuse(ct_mesh(), scan_mesh(), UP, FusionSettings(alignment_covariance=covariance))
    bottom = aligned.surface.vertices_m[:, 2] < 1e-6
    inner = bottom & np.all(np.abs(aligned.surface.vertices_m[:, :2]) < 0.02, axis=1)
    assert aligned.sigma_m[inner] == pytest.approx(np.hypot(1e-4, 2e-4))


def test_a_person_overrules_the_proposal() -> None:
    elsewhere = Box(transform(np.eye(3), np.array([0.018, 0.015, 0.03])), np.array([0.006, 0.006, 0.02]))
    drawn = (RegionCorrection(elsewhere, from_ct=True, by="A. Surgeon"),)
    result = fuse(ct_mesh(), scan_mesh(), UP, corrections=drawn)
    within = Box(elsewhere.T_world_box, elsewhere.size_m - 4e-4)  # at the box's faces the blend begins
    inside = within.contains(result.surface.vertices_m)
    assert np.all(result.source[inside] == Source.CT)
    assert np.all(result.wound[inside])
    assert result.corrections == drawn
    mask = corrected(np.ones(1, dtype=bool), np.zeros((1, 3)), [RegionCorrection(elsewhere, False, "A. Surgeon")])
    assert mask.all()  # outside the box nothing changes


def test_what_only_the_scan_shows_is_kept_as_a_part_of_its_own() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.004)
    scan = scan_mesh()
    more = Surface(
        np.concatenate([scan.vertices_m, np.add(ball.vertices, [0.0, 0.0, 0.06])]),
        np.concatenate([scan.faces, np.array(ball.faces) + len(scan.vertices_m)]),
    )
    result = fuse(ct_mesh(), more, UP)
    added = result.surface.vertices_m[:, 2] > 0.05
    assert added.sum() == len(ball.vertices)
    assert np.all(result.source[added] == Source.SCAN)
    markers = Markers(np.array([[0.0, 0.0, 0.06]]), 0.004, UP, post_radius_m=0.003, post_length_m=0.04)
    cut = without_markers(result, markers)
    assert not np.any(markers.near(cut.surface.vertices_m))
    assert np.min(np.hypot(*cut.surface.vertices_m[cut.surface.vertices_m[:, 2] > 0.025, :2].T)) > 0.005
    assert len(cut.sigma_m) == len(cut.source) == len(cut.surface.vertices_m) < len(result.sigma_m)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (3.0, 0.0, 0.0), (0.0, -0.2, 0.0)])
@pytest.mark.parametrize("post_radius_m", [0.002, 0.0])
def test_what_is_near_a_marker_is_its_sphere_and_its_post_below_with_the_margin(
    up: tuple[float, float, float], post_radius_m: float
) -> None:
    """Spheres of 4 mm on posts of 2 mm and 20 mm, and 1 mm around both, wherever they stand and lean."""
    has_post = post_radius_m > 0
    points = [  # mm aside and along the post from the centre, and whether it is cut
        (0.0, 4.9, True),
        (0.0, 5.1, False),
        (4.9, 0.0, True),
        (5.1, 0.0, False),
        (0.0, 8.0, False),  # above is no post
        (0.0, -8.0, has_post),
        (2.9, -8.0, has_post),
        (3.1, -8.0, False),
        (2.0, -19.9, has_post),
        (2.0, -20.1, False),
    ]
    axis = np.array(up) / np.linalg.norm(up)
    aside = np.roll(axis, 1)
    centres = np.array([[0.1, -0.2, 0.3], [-0.4, 0.5, 0.2]])
    markers = Markers(centres, 0.004, np.array(up), post_radius_m, post_length_m=0.02, margin_m=0.001)
    for centre in centres:
        near = markers.near(centre + 1e-3 * np.array([a * aside + b * axis for a, b, _ in points]))
        assert near.tolist() == [cut for _, _, cut in points]


def test_surfaces_in_different_frames_are_refused() -> None:
    with pytest.raises(ComputeError, match="agree nowhere"):
        fuse(ct_mesh(), scan_mesh().moved(transform(np.eye(3), np.array([0.0, 0.0, 0.5]))), UP)


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_a_prism_holds_what_lies_in_its_outline(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 0.02, (50, 3))
    prism = outline(points, rng.normal(size=3))
    middle, (low, high) = prism.polygon_m.mean(axis=0), prism.depth_m
    larger = Prism(prism.T_world_plane, middle + 1.001 * (prism.polygon_m - middle), (low - 1e-6, high + 1e-6))
    assert larger.contains(points).all()
    assert not larger.contains(points + 1.0).any()
    with pytest.raises(DataError):
        Prism(np.eye(4), np.zeros((2, 2)), (0.0, 1.0))


@given(vector=st.tuples(*[st.floats(-2, 2)] * 3), shift_mm=st.floats(0.0, 3.0))
@settings(max_examples=20, deadline=None)
def test_the_loop_closes_by_what_one_way_is_off(vector: tuple[float, float, float], shift_mm: float) -> None:
    T_world_scan = transform(Rotation.from_rotvec(vector), np.array([0.1, 0.2, 0.3]))
    T_scan_ct = transform(Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([-0.2, 0.0, 0.1]))
    off = transform(np.eye(3), np.array([1e-3 * shift_mm, 0.0, 0.0]))
    points = np.random.default_rng(0).normal(0, 0.1, (8, 3))
    loop = close_transforms(T_scan_ct, T_world_scan, T_world_scan @ off @ T_scan_ct, points)
    assert loop.rms_m == pytest.approx(1e-3 * shift_mm, abs=1e-12)
    assert loop.worst_m == pytest.approx(1e-3 * shift_mm, abs=1e-12)
    assert loop.rotation_rad == pytest.approx(0.0, abs=1e-7)


def test_a_sphere_that_moved_in_transport_changes_its_distances_only() -> None:
    before = np.random.default_rng(4).normal(0, 0.1, (6, 3))
    after = before[::-1].copy() @ Rotation.from_rotvec([0.1, 0.5, -0.3]).as_matrix().T + 0.3
    pairs = [(i, 5 - i) for i in range(6)]
    assert distance_changes(before, after, pairs).worst_m == pytest.approx(0.0, abs=1e-12)
    moved = before.copy()
    moved[2] += 4e-4 * (before[2] - before[0]) / np.linalg.norm(before[2] - before[0])
    change = distance_changes(moved, after, pairs)
    assert change.worst_m == pytest.approx(4e-4, abs=1e-9)
    assert 2 in change.worst
    assert change.rms_m < change.worst_m
    assert distance_changes(moved, after, [pair for pair in pairs if pair[0] != 2]).worst_m < 1e-12
    with pytest.raises(ComputeError, match="no distance"):
        distance_changes(before, after, pairs[:1])
