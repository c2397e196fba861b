"""How steeply a depth map's surface stands to the rays, which turns a difference of depth into a distance across."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.stereo.matching import DepthMap
from service.core.geometry import Array

_REACH_PX = 3  # between the two pixels of a difference
STEEPEST = 0.17  # the least `across`, 80° from the normal: beyond that a slope is noise

Grid = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Slopes:
    """The planes that a depth map's surface has at its pixels.

    Attributes:
        normal: (H, W, 3) unit normals in the camera's frame, toward the camera; against the ray where the slope is
            unknown.
        across: (H, W) distance from the plane for a metre of depth, at least STEEPEST; NaN where depth is unknown.
    """

    normal: Grid = field(repr=False)
    across: Grid = field(repr=False)

    def normals(self, one: DepthMap) -> Array:
        """(N, 3) normals in the world, of the points that `one.points_m(1)` gives."""
        return self.normal[np.isfinite(one.depth_m)].astype(np.float64) @ one.T_world_camera[:3, :3].T


def slopes_of(one: DepthMap) -> Slopes:
    """The slopes of a depth map.

    The inverse depth of a plane is linear in the pixels; its differences are taken within runs of known pixels, which
    end at every jump. Of the differences to both sides the smaller counts.
    """
    known = np.isfinite(one.depth_m)
    inverse = _smoothed(np.where(known, 1 / one.depth_m, 0).astype(np.float32), known)
    du, dv = _slope(inverse), _slope(np.ascontiguousarray(inverse.T)).T
    sloping = np.isfinite(du) & np.isfinite(dv)
    of = one.camera
    u = (np.arange(of.width, dtype=np.float32) - np.float32(of.cx))[None, :]
    v = (np.arange(of.height, dtype=np.float32) - np.float32(of.cy))[:, None]
    ray = np.stack(np.broadcast_arrays(u / np.float32(of.fx), v / np.float32(of.fy), np.float32(1)), axis=-1)
    # n · ray is proportional to the inverse depth, so n is its gradient; the sign turns it to the camera.
    normal = -np.stack([du * np.float32(of.fx), dv * np.float32(of.fy), inverse - u * du - v * dv], axis=-1)
    normal = np.where(sloping[..., None], normal, -ray)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.float32(1e-12))
    across = np.maximum(-np.einsum("ijk,ijk->ij", normal, ray), np.float32(STEEPEST))
    return Slopes(normal, np.where(known, across, np.float32(np.nan)))


def _smoothed(values: Grid, known: NDArray[np.bool_]) -> Grid:
    """Means over the known ones of 3 × 3 pixels; NaN where the middle is unknown."""
    mean, share = (
        np.asarray(cv2.blur(one, (3, 3), borderType=cv2.BORDER_REFLECT), np.float32)
        for one in (values, known.astype(np.float32))
    )
    return np.where(known, mean / np.maximum(share, np.float32(1e-6)), np.float32(np.nan))


def _slope(values: Grid) -> Grid:
    """Change along a row for a pixel (H, W); NaN where no run of known pixels begins or ends."""
    n = values.shape[1] - _REACH_PX
    unbroken = sum(0 * values[:, k : k + n] for k in range(1, _REACH_PX))  # NaN if one is
    change = (values[:, _REACH_PX:] - values[:, :n]) / np.float32(_REACH_PX) + unbroken
    ahead, behind = (np.full_like(values, np.nan) for _ in range(2))
    ahead[:, :n], behind[:, _REACH_PX:] = change, change
    return np.where(~(np.abs(behind) < np.abs(ahead)) & np.isfinite(ahead), ahead, behind)
