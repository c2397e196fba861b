"""Disparities of a rectified pair by semi-global matching, in both directions, and the depth where they agree."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.stereo.rectify import Rectified
from service.compute.stereo.subpixel import refined
from service.core.geometry import Array, Transform

Image = NDArray[np.uint8]
Disparity = NDArray[np.float32]

_BLOCK = 5
_NEAR, _FAR = 0.6, 1.5  # of the distance of the object: depths that are tried at first
_COARSE = 4  # times smaller images, in which the range of depths is found
_SPAN = (0.5, 99.5)  # percentiles of the coarse disparities
_AGREE_PX = 1.0  # of both directions
_JUMP_PX = 2.0  # between neighbours: an edge, where the block lies on two surfaces
_SPECKLE_PX, _SPECKLE_STEP_PX = 150, 1.5
_FEWEST = 200  # coarse pixels that agree; a pair with fewer does not show the same


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Depth (H, W) along z of a pinhole camera, NaN where unknown, with the weight of what it says."""

    depth_m: Disparity = field(repr=False)
    camera: CameraModel
    T_world_camera: Transform
    weight: float

    def points_m(self, step: int) -> Array:
        """(N, 3) every `step`-th known pixel's point in the world."""
        v, u = (k.ravel() for k in np.mgrid[: self.depth_m.shape[0] : step, : self.depth_m.shape[1] : step])
        z = self.depth_m[v, u].astype(np.float64)
        known = np.isfinite(z)
        u, v, z = u[known], v[known], z[known]
        of = self.camera
        camera = np.stack([(u - of.cx) / of.fx * z, (v - of.cy) / of.fy * z, z], axis=1)
        return camera @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def depth_of_pair(pair: Rectified, distance_m: float) -> DepthMap | None:
    """Depth of the left image of a pair that looks at an object at this distance; None if too little agrees.

    The range of disparities is found in small images first. The weight of a depth is the square of the change of
    disparity (px) per metre of depth at the object: the inverse variance, up to the variance of the matching.
    """
    first = pair.disparity(_FAR * distance_m) / _COARSE
    last = pair.disparity(_NEAR * distance_m) / _COARSE
    coarse = _agreed(_reduced(pair.left), _reduced(pair.right), first, last, 3)
    known = coarse[np.isfinite(coarse)]
    if len(known) < _FEWEST:
        return None
    low, high = (float(x) for x in np.percentile(known, _SPAN))
    margin = 1.5 + 0.08 * (high - low)
    low, high = max(first, low - margin), min(last, high + margin)
    found = refined(pair.left, pair.right, _agreed(pair.left, pair.right, _COARSE * low, _COARSE * high, _BLOCK))
    found[~pair.seen] = np.nan
    return depth_map(pair, found, distance_m)


def depth_map(pair: Rectified, disparity_px: Disparity, distance_m: float) -> DepthMap:
    """The depth map of a pair's left image from its disparities (H, W); `distance_m` is that of the object."""
    depth = pair.depth_m(_without_edges(disparity_px))
    slope = pair.f_px * pair.baseline_m / distance_m**2
    return DepthMap(depth, pair.left_camera, pair.T_world_left, slope**2)


def _reduced(image: Image) -> Image:
    small = cv2.resize(image, None, fx=1 / _COARSE, fy=1 / _COARSE, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _agreed(left: Image, right: Image, first_px: float, last_px: float, block: int) -> Disparity:
    """Disparities (H, W) of the left image that the right one confirms; NaN elsewhere."""
    lowest = int(np.floor(first_px))
    count = 16 * max(1, int(np.ceil((last_px - lowest + 1) / 16)))
    matcher = matcher_of(lowest, count, block)
    # Columns without a partner within the range are not matched: a border on both sides keeps them.
    border = max(0, lowest + count, -lowest)
    a, b = (np.pad(image, ((0, 0), (border, border)), mode="edge") for image in (left, right))
    forth = matched(matcher, a, b, lowest)
    back = matched(matcher, np.ascontiguousarray(b[:, ::-1]), np.ascontiguousarray(a[:, ::-1]), lowest)[:, ::-1]
    found = confirmed(forth, back)
    return np.ascontiguousarray(found[:, border : border + left.shape[1]])


def matcher_of(lowest_px: int, count: int, block: int) -> cv2.StereoSGBM:
    """The search over so many disparities from the lowest one."""
    return cv2.StereoSGBM.create(
        minDisparity=lowest_px,
        numDisparities=count,
        blockSize=block,
        P1=8 * block**2,
        P2=40 * block**2,
        uniquenessRatio=3,
        preFilterCap=31,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


def confirmed(forth: Disparity, back: Disparity) -> Disparity:
    """The disparities (H, W) of the left image with which those of the right one agree; NaN elsewhere."""
    columns = np.arange(forth.shape[1], dtype=np.float32)[None, :] - forth
    rows = np.broadcast_to(np.arange(forth.shape[0], dtype=np.float32)[:, None], forth.shape)
    there = cv2.remap(
        np.ascontiguousarray(back),
        np.nan_to_num(columns, nan=-1.0),
        np.ascontiguousarray(rows),
        cv2.INTER_NEAREST,
        borderValue=float("nan"),
    )
    return np.where(np.abs(forth - there) <= _AGREE_PX, forth, np.float32(np.nan)).astype(np.float32)


def matched(matcher: cv2.StereoSGBM, left: Image, right: Image, lowest: int) -> Disparity:
    """Disparities (H, W) of the left image, NaN where none was found or only a speckle."""
    sixteenths = matcher.compute(left, right)
    none = 16 * (lowest - 1)
    cv2.filterSpeckles(sixteenths, none, _SPECKLE_PX, int(16 * _SPECKLE_STEP_PX))
    out = sixteenths.astype(np.float32) / np.float32(16)
    out[sixteenths <= none] = np.nan
    return out


def _without_edges(disparity: Disparity) -> Disparity:
    """Without pixels at jumps of disparity, where a block covers two surfaces."""
    filled = np.nan_to_num(disparity, nan=-1e6)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(filled, kernel), cv2.dilate(filled, kernel)
    # A pixel beside one without disparity is an edge too: both have a large difference.
    out = disparity.copy()
    out[high - low > _JUMP_PX] = np.nan
    return out
