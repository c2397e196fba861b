"""Loads the pairs of an exported data set and computes their dense correspondences; needs numpy alone.

Pixel centres lie at integer coordinates, depth is z along the camera's axis in metres, poses are T_world_camera with
x right, y down, z forward. The images are undistorted.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

VISIBLE = 0  # the second image shows this point of the surface
OCCLUDED = 1  # another part of the surface is in front of it
OUTSIDE = 2  # it is behind the second camera or beyond the edges of its image
UNKNOWN = 3  # there is no ground truth at the point, or an edge of the surface passes between the pixels around it

_TOLERANCE = 1.0  # of depth, in widths of a pixel on the surface
_EDGE = 8.0  # difference of depth between neighbouring pixels that is an edge, in the same unit


@dataclass(frozen=True)
class View:
    """An undistorted image with its ground truth.

    Attributes:
        picture: file of the image.
        K: (3, 3) intrinsics, px.
        T_world_camera: (4, 4), m.
        depth_m: (H, W); 0 where there is no ground truth: no surface, no photograph, or a marker.
    """

    picture: Path
    K: Array = field(repr=False)
    T_world_camera: Array = field(repr=False)
    depth_m: NDArray[np.float32] = field(repr=False)


@dataclass(frozen=True)
class Correspondences:
    """Points of the surface in two images: pixels (N, 2) of each, and VISIBLE, OCCLUDED, OUTSIDE or UNKNOWN (N,).

    Pixels of the second image are given wherever the point is in front of its camera, else they are NaN.
    """

    first_px: Array = field(repr=False)
    second_px: Array = field(repr=False)
    status: NDArray[np.uint8] = field(repr=False)


class Pair(TypedDict):
    """A pair of images as in pairs.json; T_second_first maps points of the first camera's frame to the second's."""

    first: str
    second: str
    difficulty: str
    overlap_first: float
    overlap_second: float
    common_points: int
    angle_deg: float
    scale: float
    T_second_first: list[list[float]]
    covariance: list[list[float]] | None


class _ViewRecord(TypedDict):
    image: str
    depth: str
    K: list[list[float]]
    T_world_camera: list[list[float]]


class _Views(TypedDict):
    simulated: bool
    views: dict[str, _ViewRecord]


class _Pairs(TypedDict):
    pairs: list[Pair]


class MatchingData:
    """The pairs of an exported folder.

    Attributes:
        simulated: no camera was in front of a specimen.
        pairs: all of them, or those of one difficulty.
    """

    def __init__(self, folder: str | Path, difficulty: str = "") -> None:
        """Open the folder that holds views.json and pairs.json."""
        self._folder = Path(folder)
        views: _Views = json.loads((self._folder / "views.json").read_text(encoding="utf-8"))
        pairs: _Pairs = json.loads((self._folder / "pairs.json").read_text(encoding="utf-8"))
        self._views = views["views"]
        self.simulated = views["simulated"]
        self.pairs = [pair for pair in pairs["pairs"] if difficulty in ("", pair["difficulty"])]

    @property
    def names(self) -> set[str]:
        """The names of the views."""
        return set(self._views)

    def view(self, name: str) -> View:
        """Return a view with its depth, read from its file at each call."""
        record = self._views[name]
        # Opened here: of a damaged archive, NumPy leaves the file open.
        with (self._folder / record["depth"]).open("rb") as file, np.load(file) as archive:
            depth_m: NDArray[np.float32] = archive["depth_m"]
        K, T_world_camera = np.array(record["K"]), np.array(record["T_world_camera"])
        return View(self._folder / record["image"], K, T_world_camera, depth_m)

    def correspondences(self, pair: Pair, step: int = 1) -> Correspondences:
        """Return those of every `step`-th pixel and row of the first image that has ground truth."""
        return correspondences(self.view(pair["first"]), self.view(pair["second"]), step=step)


def correspondences(first: View, second: View, pixels: Array | None = None, *, step: int = 1) -> Correspondences:
    """Find where points of the surface that the first image shows are in the second.

    Args:
        first: image in which the points are given.
        second: image in which they are looked for.
        pixels: (N, 2) anywhere in the first image; None: every `step`-th pixel and row that has ground truth.
        step: distance of the pixels, if they are not given.
    """
    first_px = _with_ground_truth(first.depth_m, step) if pixels is None else pixels
    depth = surface_depth(first.depth_m, first.K, first_px)
    K, R = first.K, first.T_world_camera[:3, :3]
    rays = np.stack([(first_px[:, k] - K[k, 2]) / K[k, k] for k in (0, 1)] + [np.ones(len(first_px))], axis=1)
    world = (rays * depth[:, None]) @ R.T + first.T_world_camera[:3, 3]
    second_px, status = look_up(world, second)
    return Correspondences(first_px, second_px, status)


def _with_ground_truth(depth_m: NDArray[np.float32], step: int) -> Array:
    """Return (N, 2) every `step`-th pixel and row that has a depth."""
    v, u = np.nonzero(depth_m[::step, ::step] > 0)
    return np.stack([u, v], axis=1).astype(np.float64) * step


def look_up(world_m: Array, view: View) -> tuple[Array, NDArray[np.uint8]]:
    """Return pixels (N, 2) of surface points (N, 3) in a view, and their status (N,); NaN points are UNKNOWN.

    At the outline of what hides a point, the status is exact to a pixel.
    """
    camera = (world_m - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
    K, z = view.K, camera[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        pixels = np.stack([K[k, k] * camera[:, k] / z + K[k, 2] for k in (0, 1)], axis=1)
    pixels[~(z > 0)] = np.nan
    height, width = view.depth_m.shape
    status = np.full(len(world_m), UNKNOWN, dtype=np.uint8)
    known = np.isfinite(camera).all(axis=1)
    inside = known & (pixels >= 0).all(axis=1) & (pixels[:, 0] <= width - 1) & (pixels[:, 1] <= height - 1)
    status[known & ~inside] = OUTSIDE
    at = np.flatnonzero(inside)
    corners, _ = _around(view.depth_m, pixels[at])
    seen = surface_depth(view.depth_m, view.K, pixels[at])
    tolerance = _TOLERANCE * z[at] / K[0, 0]
    hidden = ((corners > 0) & (corners < (z[at] - tolerance)[:, None])).all(axis=1)
    with np.errstate(invalid="ignore"):
        visible = np.abs(z[at] - seen) <= tolerance
    status[at[visible]] = VISIBLE
    status[at[hidden]] = OCCLUDED
    return pixels, status


def surface_depth(depth_m: NDArray[np.float32], K: Array, pixels: Array) -> Array:
    """Return (N,) depth between pixel centres; NaN outside the image, without ground truth, and at surface edges.

    The inverse depth of a plane is linear in the pixel, so it is what is interpolated: exact on the faces of a mesh.
    """
    corners, weights = _around(depth_m, pixels)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = 1.0 / np.where(weights > 0, weights / corners, 0.0).sum(axis=1)
    used = np.where(weights > 0, corners, np.nan)
    least, most = np.fmin.reduce(used, axis=1), np.fmax.reduce(used, axis=1)
    height, width = depth_m.shape
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels <= np.array([width - 1, height - 1]))).all(axis=1)
        depth[~(inside & (least > 0) & (most - least <= _EDGE * least / K[0, 0]))] = np.nan
    return depth


def _around(depth_m: NDArray[np.float32], pixels: Array) -> tuple[Array, Array]:
    """Return the depth (N, 4) at the four pixels around each place, and their bilinear weights (N, 4)."""
    height, width = depth_m.shape
    placed = np.nan_to_num(pixels, nan=0.0)
    u = np.clip(np.floor(placed[:, 0]).astype(np.int64), 0, max(width - 2, 0))
    v = np.clip(np.floor(placed[:, 1]).astype(np.int64), 0, max(height - 2, 0))
    right, below = np.minimum(u + 1, width - 1), np.minimum(v + 1, height - 1)
    corners = np.stack([depth_m[v, u], depth_m[v, right], depth_m[below, u], depth_m[below, right]], axis=1)
    a, b = placed[:, 0] - u, placed[:, 1] - v
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)
    return corners.astype(np.float64), weights
