"""Disparities of a pair near those of a guessed surface: steep walls look alike once the guess has levelled them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.pixels.ray_mesh import RayMesh
from service.compute.stereo.matching import DepthMap, Disparity, confirmed, depth_map, matched, matcher_of
from service.compute.stereo.rectify import Rectified
from service.compute.stereo.subpixel import refined
from service.core.geometry import Transform

SPAN_PX = 16  # of disparity, to both sides of the guess
_STEP = 2  # pixels between the rays of the guess
_JUMP_PX = 3.0  # between neighbouring rays: an edge of the guess, across which nothing is interpolated
_BLOCK = 5
_FEWEST = 2000  # pixels that agree; a pair with fewer does not show the same


def guided_depth(pair: Rectified, guess: RayMesh, distance_m: float) -> DepthMap | None:
    """Depth of the left image of a pair, searched around a guessed surface; None if too little agrees.

    One image is drawn as the other camera would see it if the guess were true, and then matched with the other.
    """
    left, right = pair.left_camera, pair.right_camera
    forward = _disparity_of(guess, left, pair.T_world_left, pair)
    backward = _disparity_of(guess, right, pair.T_world_right, pair)
    forth = _searched(pair.left, pair.right, forward)
    mirrored = _searched(_flipped(pair.right), _flipped(pair.left), np.ascontiguousarray(backward[:, ::-1]))
    back = np.ascontiguousarray(mirrored[:, ::-1])
    found = refined(pair.left, pair.right, confirmed(forth, back))
    found[~pair.seen] = np.nan
    if np.count_nonzero(np.isfinite(found)) < _FEWEST:
        return None
    return depth_map(pair, found, distance_m)


def _flipped(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(image[:, ::-1])


def _disparity_of(guess: RayMesh, camera: CameraModel, T_world_camera: Transform, pair: Rectified) -> Disparity:
    """Disparities (H, W) that the guess would have in one of the two cameras; NaN where it is not met."""
    depth = _depth_of(guess, camera, T_world_camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        sparse = (pair.f_px * pair.baseline_m / depth + pair.left_px - pair.right_px).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    filled = np.nan_to_num(sparse, nan=-1e6, posinf=-1e6)
    jump = cv2.dilate(filled, kernel) - cv2.erode(filled, kernel) > _JUMP_PX * _STEP
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32) / np.float32(_STEP)
    smooth = cv2.remap(sparse, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    nearest = cv2.remap(sparse, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    at_edge = cv2.remap(jump.astype(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0
    return np.where(at_edge, nearest, smooth).astype(np.float32)


def _depth_of(guess: RayMesh, camera: CameraModel, T_world_camera: Transform) -> NDArray[np.float64]:
    """Depth along z of every _STEP-th pixel; NaN where no surface is met."""
    v, u = np.mgrid[: camera.height : _STEP, : camera.width : _STEP]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return guess.depths(T_world_camera, rays.reshape(-1, 3)).reshape(u.shape)


def _searched(one: NDArray[np.uint8], two: NDArray[np.uint8], guess: Disparity) -> Disparity:
    """Disparities (H, W) of image `one` within SPAN_PX of the guess in its pixels; NaN elsewhere."""
    height, width = one.shape
    border = 2 * SPAN_PX
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    known = np.isfinite(guess)
    level = cv2.remap(
        two, np.where(known, columns - guess, -1), rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    a, b = (np.pad(image, ((0, 0), (border, border)), mode="edge") for image in (one, np.asarray(level, np.uint8)))
    rest = matched(matcher_of(-SPAN_PX, 2 * SPAN_PX, _BLOCK), a, b, -SPAN_PX)[:, border : border + width]
    # The partner stands at the column less the rest, and was drawn there with the guess of that column.
    there = cv2.remap(
        guess, np.nan_to_num(columns - rest, nan=-10.0), rows, cv2.INTER_LINEAR, borderValue=float("nan")
    )
    found = rest + there
    found[~known] = np.nan
    return np.asarray(found, dtype=np.float32)
