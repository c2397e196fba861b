"""The format `matching`: read back with numpy alone, and its correspondences against the photographs."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.matching.loader import VISIBLE, MatchingData
from service.compute.matching.pairs import CLASSES, relative_covariance
from service.core.geometry import Array, apply, inverse
from service.dataset.exporter import exporter, write_data_set
from service.dataset.pixels import undistorted_data_set
from service.dataset.records import DataSet
from tests.support.scenes.posed import posed_data_set, reach, scene

CAMERA = CameraModel(320, 240, 380.0, 382.0, 156.0, 123.0, -0.12, 0.04, 8e-4, -5e-4)
STEEPEST = 0.15  # cosine of the angle at which a face is still seen


def with_pose_errors(dataset: DataSet) -> DataSet:
    half = np.random.default_rng(2).normal(size=(6 * len(dataset.views),) * 2) * 1e-5
    return dataclasses.replace(dataset, pose_errors=half @ half.T)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return with_pose_errors(posed_data_set(tmp_path_factory.mktemp("photographs"), 6, camera=CAMERA))


@pytest.fixture(scope="module")
def folder(dataset: DataSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("exported") / "matching"
    write_data_set(dataset, exporter("matching"), target)
    return target


def grey(path: Path) -> Array:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., 0].astype(np.float64)


def test_corresponding_pixels_show_the_same_place(dataset: DataSet, folder: Path) -> None:
    """The brightness of the painted solid names the place, so that it must be the same in both photographs."""
    data = MatchingData(folder)
    assert len(data.pairs) >= 6
    for pair in data.pairs:
        found = data.correspondences(pair, step=3)
        visible = found.status == VISIBLE
        assert visible.sum() > 100
        first, second = (grey(data.view(pair[name]).picture) for name in ("first", "second"))
        u, v = found.first_px[visible].astype(int).T
        there = cv2.remap(second, *np.float32(found.second_px[visible].T), cv2.INTER_LINEAR).ravel()  # type: ignore[misc]
        assert np.median(np.abs(first[v, u] - there)) < 2.5


def test_relative_poses_agree_with_those_of_the_views(dataset: DataSet, folder: Path) -> None:
    views = {view.name: view for view in dataset.views}
    number = {view.name: k for k, view in enumerate(dataset.views)}
    assert dataset.pose_errors is not None
    with (folder / "pairs.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    pairs = MatchingData(folder).pairs
    assert len(rows) == len(pairs)
    for pair, row in zip(pairs, rows, strict=True):
        T = [views[pair[name]].T_world_camera for name in ("first", "second")]
        assert np.abs(np.array(pair["T_second_first"]) - inverse(T[1]) @ T[0]).max() < 1e-12
        quaternion = [float(row[key]) for key in ("qx", "qy", "qz", "qw")]
        assert (
            np.abs(Rotation.from_quat(quaternion).as_matrix() - np.array(pair["T_second_first"])[:3, :3]).max() < 1e-9
        )
        rows_of = np.concatenate([6 * number[pair[name]] + np.arange(6) for name in ("first", "second")])
        C = relative_covariance(T[0], T[1], dataset.pose_errors[np.ix_(rows_of, rows_of)])
        assert pair["covariance"] is not None
        assert np.abs(np.array(pair["covariance"]) - C).max() < 1e-18
        assert float(row["sigma_mm"]) == pytest.approx(1e3 * np.sqrt(np.trace(C[:3, :3])))
        assert pair["difficulty"] in CLASSES


def test_overlap_is_that_of_the_surface(dataset: DataSet, folder: Path) -> None:
    """Against points that rays at the solid find, not depth images; faces seen at more than 81° do not count."""
    sampled = trimesh.sample.sample_surface(scene().mesh, 3000, seed=1)
    points, faces = sampled[0], sampled[1]
    normals = np.asarray(scene().mesh.face_normals)[faces]
    seen: dict[str, NDArray[np.bool_]] = {}
    for view in undistorted_data_set(dataset).views:
        eye, camera = view.T_world_camera[:3, 3], view.camera
        pixels = camera.project(apply(inverse(view.T_world_camera), points))
        u, v = np.clip(np.rint(pixels).astype(int).T, 0, [[camera.width - 1], [camera.height - 1]])
        inside = ((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1)
        free = inside & ~dataset.pixels.markers(view)[v, u]
        cosine = np.abs(np.sum((points - eye) * normals, axis=1)) / np.linalg.norm(points - eye, axis=1)
        seen[view.name] = free & (np.abs(reach(eye, points - eye) - 1) < 1e-6) & (cosine > STEEPEST)
    graph = json.loads((folder / "covisibility.json").read_text(encoding="utf-8"))
    assert set(graph["views"]) == set(seen)
    pairs = MatchingData(folder).pairs
    assert [(a, b) for a, b, _ in graph["edges"]] == [(pair["first"], pair["second"]) for pair in pairs]
    difference: list[float] = []
    for pair in pairs:
        first, second = seen[pair["first"]], seen[pair["second"]]
        common = np.count_nonzero(first & second)
        difference.append(pair["overlap_first"] - common / np.count_nonzero(first))
        difference.append(pair["overlap_second"] - common / np.count_nonzero(second))
        assert pair["common_points"] == pytest.approx(pair["overlap_first"] * graph["views"][pair["first"]])
    # The faces are some twenty pixels wide, of which one at each edge is not known.
    assert np.abs(difference).max() < 0.15
    assert np.abs(np.mean(difference)) < 0.05


def test_markers_have_no_depth(dataset: DataSet, folder: Path) -> None:
    data = MatchingData(folder)
    for view in undistorted_data_set(dataset).views:
        markers = dataset.pixels.markers(view)
        assert markers.any()
        assert not data.view(view.name).depth_m[markers].any()


def test_the_loader_needs_only_numpy(folder: Path) -> None:
    script = (
        "import sys; sys.path.insert(0, '.'); import loader; data = loader.MatchingData('.'); "
        "found = data.correspondences(data.pairs[0], step=4); "
        "print(int((found.status == loader.VISIBLE).sum()), sorted({'cv2', 'scipy', 'service'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, env={}, capture_output=True, text=True, check=True
    )
    number, modules = done.stdout.split(maxsplit=1)
    assert int(number) > 50
    assert modules.strip() == "[]"


def test_the_snippet_of_the_documents_lists_correspondences(folder: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "howto" / "matching.md").read_text(encoding="utf-8")
    difficulty = MatchingData(folder).pairs[0]["difficulty"]
    (snippet,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", snippet.replace("hard", difficulty)],
        cwd=folder, env={}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    same = MatchingData(folder, difficulty).pairs
    assert len(done.stdout.splitlines()) == len(same) > 0


def test_an_interrupted_export_goes_on_with_the_same_pairs(dataset: DataSet, folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "matching"

    def interrupted(_sums: Path) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_data_set(dataset, exporter("matching"), target, leaving=interrupted)
    (tmp_path / ".matching.part" / "pairs.json").unlink()
    write_data_set(dataset, exporter("matching"), target)
    assert (target / "pairs.json").read_bytes() == (folder / "pairs.json").read_bytes()
