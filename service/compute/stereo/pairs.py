"""Which posed images are matched with which: neighbours at an angle that measures depth and still looks alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform

BEST_DEG, WIDEST_DEG = 13.0, 60.0
_NARROWEST_DEG = 4.0
_FALLBACK_DEG = 25.0  # pairs wider than this are only used by views without closer ones
PARTNERS, FEW_PARTNERS = 3, 2  # of each view, of few and of many
MANY = 60


@dataclass(frozen=True, slots=True)
class StereoView:
    """A grey image (H, W) of a pinhole camera; T_world_camera in metres, x right, y down, z forward."""

    image: NDArray[np.uint8] = field(repr=False)
    camera: CameraModel
    T_world_camera: Transform

    @property
    def eye_m(self) -> Array:
        """(3,) centre of projection in the world."""
        return self.T_world_camera[:3, 3]


def looked_at_m(views: Sequence[StereoView]) -> Array:
    """(3,) the point nearest to all optical axes, in the least-squares sense.

    Raises:
        ComputeError: the axes are parallel, or meet behind a camera.
    """
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        axis = view.T_world_camera[:3, 2]
        across = np.eye(3) - np.outer(axis, axis)
        normal += across
        right += across @ view.eye_m
    if np.linalg.cond(normal) > 1e9:
        raise ComputeError("the cameras look in parallel", remedy="Use images that look at one object from around")
    point: Array = np.linalg.solve(normal, right).astype(np.float64)
    if any(float((point - view.eye_m) @ view.T_world_camera[:3, 2]) <= 0 for view in views):
        raise ComputeError("the cameras look at no common point", remedy="Use images that look at one object")
    return point


def stereo_pairs(views: Sequence[StereoView]) -> tuple[tuple[int, int], ...]:
    """Pairs of views by index, each with those whose angle at the object is nearest to BEST_DEG.

    A view without a partner up to _FALLBACK_DEG gets the nearest up to WIDEST_DEG.

    Raises:
        ComputeError: there is no pair.
    """
    centre = looked_at_m(views)
    rays = np.stack([view.eye_m - centre for view in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)))
    partners = FEW_PARTNERS if len(views) > MANY else PARTNERS
    chosen: set[tuple[int, int]] = set()
    for k, row in enumerate(angles):
        for close, wide in ((_NARROWEST_DEG, _FALLBACK_DEG), (_FALLBACK_DEG, WIDEST_DEG)):
            usable = np.flatnonzero((row >= close) & (row < wide))
            usable = usable[np.argsort(np.abs(row[usable] - BEST_DEG), kind="stable")][:partners]
            chosen |= {(min(k, int(other)), max(k, int(other))) for other in usable}
            if len(usable):
                break
    if not chosen:
        raise ComputeError(
            f"no two images look at the object at an angle between {_NARROWEST_DEG:g} and {WIDEST_DEG:g}°",
            remedy="Use more images",
        )
    return tuple(sorted(chosen))
