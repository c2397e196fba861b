"""Chamfer distance and the scores beside it: properties, a case computed by brute force, and the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.surfaces import chamfer as compared
from service.compute.surfaces.chamfer import ChamferSettings, chamfer, sample
from service.compute.surfaces.surface import PointIndex, Surface, TriangleTree
from service.core.errors import ComputeError
from service.core.geometry import Array, transform

COARSE = ChamferSettings(spacing_m=5e-4)  # fast enough for many examples
FLOOR_M = 2.5e-4  # half of that spacing: what random sampling leaves


def surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64))


def plane(width_m: float = 0.012, height_m: float = 0.008, cells: int = 6) -> Surface:
    x, y = np.meshgrid(np.linspace(0, width_m, cells + 1), np.linspace(0, height_m, cells + 1), indexing="ij")
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), faces)


def shifted(of: Surface, by: tuple[float, float, float]) -> Surface:
    return Surface(of.vertices_m + np.array(by), of.faces, of.normals)


BALL = surface(trimesh.creation.icosphere(subdivisions=2, radius=0.008))
BUMPY = Surface(BALL.vertices_m * (1 + 0.02 * np.sin(800 * BALL.vertices_m[:, :1])), BALL.faces)


@pytest.mark.slow
@given(seed=st.integers(0, 1000), spacing=st.floats(2.5e-4, 5e-4))
@settings(max_examples=3, deadline=None)
def test_equal_surfaces_have_the_floor_and_no_distance_to_the_faces(seed: int, spacing: float) -> None:
    score = chamfer(BUMPY, BUMPY, ChamferSettings(spacing_m=spacing, seed=seed))
    assert score.chamfer_m == pytest.approx(score.floor_m, rel=0.03)
    assert score.floor_m == pytest.approx(0.5 * spacing, rel=0.05)
    assert score.pred_to_gt.surface_mean_m == pytest.approx(0.0, abs=1e-12)
    assert score.f_scores[1] == pytest.approx(1.0, abs=1e-3)


@given(offset=st.floats(2e-3, 15e-3), seed=st.integers(0, 100))
@settings(max_examples=3, deadline=None)
def test_a_plane_shifted_along_its_normal_is_off_by_the_shift(offset: float, seed: int) -> None:
    score = chamfer(shifted(plane(), (0, 0, offset)), plane(), ChamferSettings(spacing_m=5e-4, seed=seed))
    assert score.chamfer_m == pytest.approx(offset, rel=0.03)
    assert score.chamfer_m >= offset
    assert score.pred_to_gt.surface_mean_m == pytest.approx(offset, abs=1e-9)
    assert score.pred_to_gt.normal_consistency == pytest.approx(1.0)
    assert score.f_scores == (0.0, 0.0)


@pytest.mark.slow
@given(seed=st.integers(0, 100), scale=st.floats(0.8, 1.3))
@settings(max_examples=2, deadline=None)
def test_exchanging_the_surfaces_exchanges_the_directions(seed: int, scale: float) -> None:
    other = Surface(BALL.vertices_m * scale, BALL.faces)
    chosen = ChamferSettings(spacing_m=5e-4, seed=seed)
    forth, back = chamfer(BUMPY, other, chosen), chamfer(other, BUMPY, chosen)
    assert forth.chamfer_m == pytest.approx(back.chamfer_m, abs=0.05 * FLOOR_M)
    assert forth.pred_to_gt.mean_m == pytest.approx(back.gt_to_pred.mean_m, abs=0.06 * FLOOR_M)
    assert forth.f_scores == pytest.approx(back.f_scores, abs=0.02)


@pytest.mark.slow
@given(vector=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-1, 1)] * 3))
@settings(max_examples=2, deadline=None)
def test_a_rigid_motion_of_both_changes_nothing(
    vector: tuple[float, float, float], shift: tuple[float, float, float]
) -> None:
    T = transform(Rotation.from_rotvec(vector), np.array(shift))
    before = chamfer(BUMPY, BALL, COARSE)
    after = chamfer(BUMPY.moved(T), BALL.moved(T), COARSE)
    assert after.chamfer_m == pytest.approx(before.chamfer_m, abs=1e-9)
    assert after.floor_m == pytest.approx(before.floor_m, abs=0.05 * FLOOR_M)


def test_points_beyond_the_limit_are_in_no_mean_but_count_as_wrong() -> None:
    far = shifted(plane(), (0, 0, 0.05))
    both = Surface(
        np.concatenate([plane().vertices_m, far.vertices_m]),
        np.concatenate([plane().faces, far.faces + len(plane().vertices_m)]),
    )
    score = chamfer(both, plane(), COARSE)
    assert score.pred_to_gt.excluded == pytest.approx(score.pred_to_gt.n / 2, abs=1)
    assert score.gt_to_pred.excluded == 0
    assert score.chamfer_m == pytest.approx(score.floor_m, rel=0.05)
    assert score.pred_to_gt.within[1] == pytest.approx(0.5, abs=0.01)
    assert chamfer(both, plane(), ChamferSettings(5e-4, outlier_m=0.06)).pred_to_gt.excluded == 0
    with pytest.raises(ComputeError, match="no point lies within 20 mm"):
        chamfer(far, plane(), COARSE)


def test_the_score_is_that_of_brute_force_over_the_same_samples() -> None:
    rng = np.random.default_rng(COARSE.seed)
    pred, gt = shifted(BUMPY, (0.0121, 0.002, -0.003)), BALL
    a, b = sample(pred, COARSE.spacing_m, rng).points_m, sample(gt, COARSE.spacing_m, rng).points_m
    chosen = ChamferSettings(COARSE.spacing_m, outlier_m=0.006)
    table = cdist(a, b)
    forth, back = table.min(axis=1), table.min(axis=0)
    score = chamfer(pred, gt, chosen)
    means = [float(d[d <= 0.006].mean()) for d in (forth, back)]
    assert score.chamfer_m == pytest.approx(0.5 * sum(means), rel=1e-12)
    assert (score.pred_to_gt.mean_m, score.gt_to_pred.mean_m) == pytest.approx(tuple(means), rel=1e-12)
    assert score.pred_to_gt.excluded == int(np.sum(forth > 0.006)) > 0
    p, r = float(np.mean(forth <= 1e-3)), float(np.mean(back <= 1e-3))
    assert score.f_scores[1] == pytest.approx(2 * p * r / (p + r))


def shuffled(of: Surface) -> Surface:
    return Surface(of.vertices_m, np.random.default_rng(7).permutation(of.faces))


@pytest.mark.parametrize("ordered", [True, False])
def test_of_many_samples_some_are_compared_with_all_in_whatever_order_the_faces_are(
    monkeypatch: pytest.MonkeyPatch, ordered: bool
) -> None:
    monkeypatch.setattr(compared, "_BLOCK", 300)
    monkeypatch.setattr(compared, "MOST_COMPARED", 1000)
    pred, gt = shifted(plane(cells=60), (0.002, 0.0005, -0.0003)), plane(cells=50)
    if not ordered:
        pred, gt = shuffled(pred), shuffled(gt)
    chosen, rng = ChamferSettings(spacing_m=1.8e-4), np.random.default_rng(0)
    a, b = sample(pred, chosen.spacing_m, rng), sample(gt, chosen.spacing_m, rng)
    score = chamfer(pred, gt, chosen)
    for way, of, all_of_other in ((score.pred, a, b), (score.gt, b, a)):
        assert 900 < len(way.samples.points_m) <= 1000 < len(of.points_m) / 2
        number = cdist(way.samples.points_m, of.points_m).argmin(axis=1)
        assert np.array_equal(of.points_m[number], way.samples.points_m)
        assert np.array_equal(of.origin[number], way.samples.origin)
        assert len(np.unique(number)) == len(number)
        nearest = cdist(way.samples.points_m, all_of_other.points_m).min(axis=1)
        assert way.distance_m == pytest.approx(nearest, rel=1e-12)


@pytest.mark.parametrize("ordered", [True, False])
def test_regions_hold_each_sample_once_and_those_together_that_lie_together(
    monkeypatch: pytest.MonkeyPatch, ordered: bool
) -> None:
    monkeypatch.setattr(compared, "_BLOCK", 100)
    of = plane(cells=60) if ordered else shuffled(plane(cells=60))
    whole = sample(of, 2e-4, np.random.default_rng(3))
    regions = list(compared.BlockedSamples(of, 2e-4, np.random.default_rng(3)).regions())
    assert [len(region.origin) for region in regions] == 6 * [400]
    points, origin = (
        np.concatenate([getattr(region, name) for region in regions]) for name in ("points_m", "origin")
    )
    assert np.array_equal(np.sort(origin), whole.origin)
    assert np.array_equal(points[np.lexsort(points.T)], whole.points_m[np.lexsort(whole.points_m.T)])
    assert np.mean([np.prod(np.ptp(region.points_m[:, :2], axis=0)) for region in regions]) < 0.5 * 0.012 * 0.008


@pytest.mark.slow
@given(seed=st.integers(0, 1000), n=st.integers(1, 60), spread=st.floats(0.001, 0.1))
@settings(max_examples=25, deadline=None)
def test_the_distance_to_the_faces_is_exact(seed: int, n: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    soup = Surface(rng.normal(0, 0.02, (3 * n, 3)), np.arange(3 * n).reshape(n, 3))
    places = rng.normal(0, spread, (40, 3))
    found = TriangleTree(soup).nearest(places)
    exact = np.array([[_to_triangle(q, soup.vertices_m[face]) for face in soup.faces] for q in places])
    assert found.distance_m == pytest.approx(exact.min(axis=1), abs=1e-9)
    assert np.linalg.norm(found.points_m - places, axis=1) == pytest.approx(found.distance_m, abs=1e-12)
    assert exact[np.arange(40), found.faces] == pytest.approx(exact.min(axis=1), abs=1e-9)


def _to_triangle(q: Array, corners: Array) -> float:
    """Distance from a point to a triangle: over its plane if that foot is inside, else to the nearest edge."""
    a, ab, ac = corners[0], corners[1] - corners[0], corners[2] - corners[0]
    v, w = np.linalg.lstsq(np.stack([ab, ac], axis=1), q - a, rcond=None)[0]
    if v >= 0 and w >= 0 and v + w <= 1:
        return float(np.linalg.norm(a + v * ab + w * ac - q))
    edges = [(corners[k], corners[(k + 1) % 3]) for k in range(3)]
    feet = [s + np.clip((q - s) @ (e - s) / ((e - s) @ (e - s)), 0, 1) * (e - s) for s, e in edges]
    return min(float(np.linalg.norm(foot - q)) for foot in feet)


@pytest.mark.parametrize("shuffled", [False, True])
def test_the_nearest_point_does_not_depend_on_the_order_of_the_points(shuffled: bool) -> None:
    rng = np.random.default_rng(5)
    points, places = rng.random((6000, 3)), rng.random((5000, 3))
    if not shuffled:
        points, places = points[np.argsort(points[:, 0])], places[np.argsort(places[:, 0])]
    distance, index = PointIndex(points).nearest(places)
    assert distance == pytest.approx(cdist(places, points).min(axis=1))
    assert np.linalg.norm(points[index] - places, axis=1) == pytest.approx(distance)
    bound_m = float(np.median(distance))
    bounded, found = PointIndex(points).nearest(places, bound_m)
    near = distance < bound_m
    assert np.array_equal(bounded[near], distance[near])
    assert np.array_equal(found[near], index[near])
    assert np.all(np.isinf(bounded[~near]))
    assert np.all(found[~near] == -1)


def test_samples_lie_on_the_faces_at_the_spacing_whatever_the_size_of_the_faces() -> None:
    for cells in (1, 20, 120):
        samples = sample(plane(cells=cells), 1e-4, np.random.default_rng(0))
        assert len(samples.points_m) == pytest.approx(0.012 * 0.008 / 1e-8, rel=1e-3)
        assert np.all(samples.points_m[:, 2] == 0)
        counts = np.histogram2d(samples.points_m[:, 0], samples.points_m[:, 1], bins=(6, 4))[0]
        assert counts.ravel() == pytest.approx(np.full(24, counts.mean()), rel=0.2)


def test_a_dense_cloud_is_thinned_and_a_sparse_one_has_a_larger_floor() -> None:
    rng = np.random.default_rng(1)
    dense = Surface(rng.random((40_000, 3)) * [0.02, 0.02, 0.0], np.empty((0, 3), dtype=np.int64))
    score = chamfer(dense, dense, ChamferSettings(spacing_m=5e-4))
    assert score.pred_to_gt.n <= 41 * 41
    assert score.chamfer_m == 0
    assert score.pred_to_gt.surface_mean_m is None
    assert score.pred_to_gt.normal_consistency is None
    sparse = Surface(dense.vertices_m[:400], dense.faces)
    score = chamfer(dense, sparse, ChamferSettings(spacing_m=1e-4))
    assert score.gt_to_pred.n == pytest.approx(400, abs=8)
    assert score.pred_to_gt.floor_m == pytest.approx(0.5 * 0.02 / 20, rel=0.2)
    assert score.pred_to_gt.mean_m == pytest.approx(score.pred_to_gt.floor_m, rel=0.2)


def test_too_many_samples_are_refused_before_they_are_made() -> None:
    with pytest.raises(ComputeError, match="more than"):
        chamfer(BALL.moved(np.diag([3e3, 3e3, 3e3, 1.0])), BALL)


# --- the command -------------------------------------------------------------------------------------------


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["evaluate", "chamfer", *map(str, words)], catch_exceptions=False)


def written(path: Path, of: Surface, scale: float = 1e3) -> Path:
    trimesh.Trimesh(of.vertices_m * scale, of.faces, process=False).export(path)
    return path


@pytest.mark.parametrize(("suffix", "scale"), [("ply", 1e3), ("stl", 1e3), ("obj", 1e3), ("off", 1e3), ("glb", 1.0)])
def test_the_command_prints_the_scores_of_meshes_of_any_format(tmp_path: Path, suffix: str, scale: float) -> None:
    pred = written(tmp_path / f"pred.{suffix}", shifted(plane(), (0, 0, 7e-4)), scale)
    gt = written(tmp_path / "gt.ply", plane(), 1.0)  # metres, beside millimetres
    done = run(pred, gt, "--json")
    assert done.exit_code == 0, done.output
    record: dict[str, Any] = json.loads(done.stdout)
    assert set(record) >= {"chamfer_mm", "pred_to_gt_mm", "gt_to_pred_mm", "f_score", "excluded", "floor_mm"}
    assert record["chamfer_mm"] == pytest.approx(0.7, abs=0.01)
    assert record["chamfer_mm"] == pytest.approx((record["pred_to_gt_mm"] + record["gt_to_pred_mm"]) / 2)
    assert record["f_score"] == {"0.5": 0.0, "1.0": 1.0}
    assert record["floor_mm"] == pytest.approx(0.05, rel=0.05)
    assert (record["excluded"], record["n_pred"], record["n_gt"]) == (0, 9_600, 9_600)


@pytest.mark.slow
def test_the_command_writes_heat_maps_in_the_unit_of_the_surface(tmp_path: Path) -> None:
    tilted = plane().moved(transform(Rotation.from_rotvec([0, 0.12, 0]), np.zeros(3)))
    pred, gt = written(tmp_path / "pred.ply", tilted), written(tmp_path / "gt.ply", plane())
    done = run(pred, gt, "--heat-map", tmp_path / "heat.ply", "--picture", tmp_path / "heat.png")
    assert done.exit_code == 0, done.output
    assert "Chamfer distance" in done.output
    heat = trimesh.load_mesh(tmp_path / "heat.ply", process=False)
    assert np.asarray(heat.vertices) == pytest.approx(1e3 * tilted.vertices_m, abs=1e-4)
    told = heat.metadata["_ply_raw"]["vertex"]["data"]
    assert np.asarray(told["distance_mm"]) == pytest.approx(np.abs(1e3 * tilted.vertices_m[:, 2]), abs=0.25)
    colours = np.stack([told[name] for name in ("red", "green", "blue")], axis=1)
    assert len(np.unique(colours, axis=0)) > 3
    picture = cv2.imread(str(tmp_path / "heat.png"))
    assert picture is not None
    assert picture.shape[1] > 1200
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize("spacing_mm", [0.4, pytest.param(0.1, marks=pytest.mark.sweep)])
def test_the_picture_of_a_small_surface_has_no_paper_between_its_samples(tmp_path: Path, spacing_mm: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    ball.export(tmp_path / "gt.ply")
    ball.apply_translation([0, 0, 0.3]).export(tmp_path / "pred.ply")
    picture_file = tmp_path / "heat.png"
    done = run(tmp_path / "pred.ply", tmp_path / "gt.ply", "--picture", picture_file, "--spacing-mm", spacing_mm)
    assert done.exit_code == 0, done.output
    picture = cv2.imread(str(picture_file))
    assert picture is not None
    shown = picture.min(axis=2) < 250
    shown[:60] = shown[-100:] = False  # titles and scale
    rows, columns = np.nonzero(shown[:, : shown.shape[1] // 2])
    radius = 0.5 * np.ptp(rows)
    v, u = np.mgrid[: shown.shape[0], : shown.shape[1] // 2]
    disc = np.hypot(v - rows.min() - radius, u - columns.min() - 0.5 * np.ptp(columns)) < 0.97 * radius
    disc[:60] = False
    assert np.count_nonzero(disc) > 400_000
    assert shown[:, : shown.shape[1] // 2][disc].mean() > 0.995


def test_point_clouds_are_compared_with_meshes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    points = rng.random((5000, 3)) * [12, 8, 0] + [0, 0, 0.4]
    np.savetxt(tmp_path / "pred.xyz", points)
    done = run(tmp_path / "pred.xyz", written(tmp_path / "gt.stl", plane()), "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["pred_to_gt"]["to_surface_mean_mm"] == pytest.approx(0.4, abs=1e-3)
    assert record["gt_to_pred"]["to_surface_mean_mm"] is None


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "a.ply"),
        ("a.stl", b"", "empty"),
        ("a.docx", b"PK", "not supported"),
        ("a.off", b"OFF\n3 1 0\nnot numbers\n", "cannot be parsed"),
        ("a.xyz", b"1 2\n3 4\n", "cannot be parsed"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not numbers"),
    ],
)
def test_bad_files_are_named_with_what_to_do(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    done = run(tmp_path / name, written(tmp_path / "gt.ply", plane()), "--json")
    assert done.exit_code == 1, done.output
    error = json.loads(done.stdout)["error"]
    assert name in error["where"]
    assert words in error["what"] or words in error["where"]
    assert error["remedy"]


def test_wrong_arguments_are_refused_before_the_files_are_read(tmp_path: Path) -> None:
    gt = written(tmp_path / "gt.ply", plane())
    assert run(gt, gt, "--spacing-mm", "0").exit_code == 2
    assert run(gt, gt, "--outlier-mm", "nan").exit_code == 2
    assert run(gt, gt, "--picture", tmp_path / "a.jpg").exit_code == 1
    missing = run(tmp_path / "none.ply", gt)
    assert missing.exit_code == 1
    assert "there is no such file" in missing.output
