"""Feature matching: undistorted images, their depth, and the list of pairs with relative poses and difficulties."""

from __future__ import annotations

import csv
import importlib.resources
import io
import json
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.matching.loader import View as GroundTruth
from service.compute.matching.pairs import (
    LEAST_OVERLAP,
    Covisibility,
    ListedPair,
    covisibility,
    listed_pairs,
    points_seen,
)
from service.compute.surfaces.chamfer import random_points
from service.compute.surfaces.surface import Surface
from service.core.units import mm, mrad
from service.dataset.export_folder import ExportFolder, Part
from service.dataset.exporter import Exporter
from service.dataset.records import DataSet, PosedView

_POINTS = 20_000  # of the surface, by which overlap is measured: to within half a per cent
_SEED = 14
_DEPTH = "z along the camera's axis, m, at pixel centres; 0: no surface, no photograph, or a marker"
_POSES = "T_world_camera: x right, y down, z forward; pixel centres at integers; K without distortion"
_COVARIANCE = (
    "of T_second_first, (d, w): exp([w]x) R, t + d, in the axes of the second camera, m and rad; errors common to "
    "all poses cancel; null: the poses' own errors are not stated in the record"
)
_COLUMNS = (
    "first", "second", "difficulty", "overlap_first", "overlap_second", "common_points", "angle_deg", "scale",
    "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "sigma_mm", "sigma_mrad", "simulated",
)  # fmt: skip


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`images/`, `depth/NAME.npz`, `views.json`, `pairs.json`, `pairs.csv`, `covisibility.json` and `loader.py`.

    Metres, pixels with their centres at integers, z-depth, T_world_camera and T_second_first. Correspondences are not
    stored: `loader.py`, which needs only numpy, computes them for any pair from depth and poses. Overlap is the share
    of the surface's points that both images show. Markers have no depth.
    """
    truth = _DepthOfViews(dataset, folder)
    for view in dataset.views:
        folder.file(f"images/{view.file}", lambda view=view: dataset.pixels.picture(view), Part("image", view.name))
        folder.written_by(
            _depth_file(view),
            lambda path, view=view: _depth(path, dataset, truth.depth_m(view)),
            Part("depth", view.name),
        )
    folder.file("views.json", lambda: _json(_views(dataset)))
    folder.file("pairs.json", lambda: _json(_pairs(dataset, truth.pairs)))
    folder.file("pairs.csv", lambda: _table(dataset, truth.pairs))
    folder.file("covisibility.json", lambda: _json(_graph(dataset, truth.covisible)))
    loader = importlib.resources.files("service.compute.matching").joinpath("loader.py")
    folder.file("loader.py", loader.read_bytes)


class _DepthOfViews:
    """The data computed from the views' depth, once and only when a file needs it."""

    def __init__(self, dataset: DataSet, folder: ExportFolder) -> None:
        self._dataset, self._folder = dataset, folder
        self._seen: dict[str, NDArray[np.bool_]] = {}
        mesh = dataset.mesh
        self._surface = Surface(mesh.vertices_m, mesh.faces)

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        """Return the depth (H, W) of the surface where the image shows it, and note which of its points it shows."""
        pixels = self._dataset.pixels
        shown = pixels.valid(view) & ~pixels.markers(view)
        depth = np.where(shown, pixels.depth_m(view), np.float32(0.0))
        self._note(view, depth)
        return depth

    def _note(self, view: PosedView, depth_m: NDArray[np.float32]) -> None:
        self._seen[view.name] = points_seen(self._points_m, _ground_truth(view, depth_m))

    @cached_property
    def covisible(self) -> Covisibility:
        """The covisibility of all views."""
        for view in self._dataset.views:
            if view.name not in self._seen:  # another process wrote its depth, or an interrupted export
                with (self._folder.root / _depth_file(view)).open("rb") as file, np.load(file) as archive:
                    self._note(view, archive["depth_m"])
        return covisibility(np.array([self._seen[view.name] for view in self._dataset.views]))

    @cached_property
    def pairs(self) -> list[ListedPair]:
        """All pairs that overlap."""
        nothing = np.empty((0, 0), dtype=np.float32)
        views = {view.name: _ground_truth(view, nothing) for view in self._dataset.views}
        return listed_pairs(views, self._points_m, self.covisible, self._dataset.pose_errors)

    @cached_property
    def _points_m(self) -> NDArray[np.float64]:
        return random_points(self._surface, _POINTS, np.random.default_rng(_SEED))


def _ground_truth(view: PosedView, depth_m: NDArray[np.float32]) -> GroundTruth:
    return GroundTruth(Path("images") / view.file, view.camera.matrix, view.T_world_camera, depth_m)


def _depth_file(view: PosedView) -> str:
    return f"depth/{view.name}.npz"


def _depth(path: Path, dataset: DataSet, depth_m: NDArray[np.float32]) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, depth_m=depth_m, simulated=np.array(dataset.simulated))


def _views(dataset: DataSet) -> dict[str, object]:
    views = {
        view.name: {
            "image": f"images/{view.file}",
            "depth": f"depth/{view.name}.npz",
            "width": view.camera.width,
            "height": view.camera.height,
            "K": view.camera.matrix.tolist(),
            "T_world_camera": view.T_world_camera.tolist(),
            "covariance": view.covariance.tolist(),
        }
        for view in dataset.views
    }
    return {"simulated": dataset.simulated, "unit": "m", "poses": _POSES, "depth": _DEPTH, "views": views}


def _pairs(dataset: DataSet, pairs: list[ListedPair]) -> dict[str, object]:
    return {
        "simulated": dataset.simulated,
        "unit": "m",
        "T_second_first": "maps points of the first camera's frame to the second's",
        "covariance": _COVARIANCE,
        "overlap": f"share of the surface's points in one image that the other shows too; at least {LEAST_OVERLAP}",
        "pairs": [pair.record() for pair in pairs],
    }


def _table(dataset: DataSet, pairs: list[ListedPair]) -> bytes:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_COLUMNS)
    for pair in pairs:
        T, C, hard = pair.T_second_first, pair.covariance, pair.difficulty
        sigmas = ("", "") if C is None else (mm(_sigma(C[:3, :3])), mrad(_sigma(C[3:, 3:])))
        numbers = (*pair.overlap, pair.common_points, hard.angle_deg, hard.scale)
        place = (*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
        rows.writerow((pair.first, pair.second, hard.name, *numbers, *place, *sigmas, str(dataset.simulated).lower()))
    return text.getvalue().encode()


def _sigma(covariance: NDArray[np.float64]) -> float:
    """Return the expected length of an error in space with this covariance (3, 3)."""
    return float(np.sqrt(np.trace(covariance)))


def _graph(dataset: DataSet, covisible: Covisibility) -> dict[str, object]:
    """Return the graph: views as nodes with their points, pairs as edges with common points, and connected parts."""
    names = [view.name for view in dataset.views]
    edges = covisible.pairs()
    return {
        "simulated": dataset.simulated,
        "points": _POINTS,
        "views": {name: int(np.count_nonzero(seen)) for name, seen in zip(names, covisible.seen, strict=True)},
        "edges": [[names[i], names[j], int(covisible.common[i, j])] for i, j in edges],
        "part": dict(zip(names, covisible.components().tolist(), strict=True)),
    }


def _json(document: object) -> bytes:
    return (json.dumps(document, allow_nan=False, ensure_ascii=False) + "\n").encode()


KIND = Exporter(
    "matching",
    "feature matching: image pairs with depth, relative poses and difficulties",
    write,
    pinhole=True,
    one_camera=True,
)
