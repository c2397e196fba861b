"""Images of boards with exactly known corners: supersampled through homography and lens distortion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform

_NODES = 5  # per side, where a tile's rays are exact; a polynomial interpolates between them
_TILE = 256


@dataclass(frozen=True)
class Photography:
    """Everything between the scene and the image file."""

    blur_px: float = 0.7  # sigma of the lens blur
    gamma: float = 2.2
    noise: float = 2.0  # grey levels
    light: float = 0.0  # relative decrease of brightness from one side to the other
    dark: float = 0.04  # reflectance of the ink
    bright: float = 0.75


Shade = Callable[
    [NDArray[np.floating], float], NDArray[np.floating]
]  # reflectance at board points (N, 2), averaged over a footprint (m)


def checkerboard(columns: int, rows: int, square_m: float, border: float = 1.0) -> Shade:
    """Ink 0, paper 1; the first square between the first corners of the first two rows is dark."""

    def shade(xy: NDArray[np.floating], footprint_m: float) -> NDArray[np.floating]:
        cell = xy.T / square_m
        # A square wave whose steps are as wide as a sample: point samples would round every edge to their grid.
        whole = np.round(cell)
        wave = (cell - whole) * (2 * square_m / footprint_m)
        np.clip(wave, -1, 1, out=wave)
        odd = (whole[0] + whole[1]) % 2
        light = 0.5 - 0.5 * wave[0] * wave[1] * (1 - 2 * odd)
        x, y = cell
        margin = 1 + border
        inside = (x >= -1) & (y >= -1) & (x <= columns) & (y <= rows)
        paper = (x >= -margin) & (y >= -margin) & (x <= columns + border) & (y <= rows + border)
        return np.where(inside, light, np.where(paper, np.float32(1.0), np.float32(0.45)))

    return shade


def printed(image: NDArray[np.uint8], pixel_m: float, origin_m: Array) -> Shade:
    """Reflectance of a drawn board whose image's corner lies at `origin_m` in the board frame."""

    def shade(xy: NDArray[np.floating], footprint_m: float) -> NDArray[np.floating]:
        column, row = (
            np.floor((at - origin) / pixel_m).astype(np.int64) for at, origin in zip(xy.T, origin_m, strict=True)
        )
        height, width = image.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
        return np.where(inside, image[row, column] / np.float32(255), np.float32(0.45))

    return shade


def photograph(
    shade: Shade,
    camera: CameraModel,
    T_camera_board: Transform,
    rng: np.random.Generator,
    *,
    corners: Array | None = None,
    samples: int = 4,
    how: Photography = Photography(),
) -> NDArray[np.uint8]:
    """A grey photograph of a board.

    Args:
        shade: reflectance of the board.
        camera: intrinsics.
        T_camera_board: pose.
        rng: for the noise.
        corners: (N, 2) pixels around which to supersample; None: everywhere.
        samples: per side of a pixel.
        how: blur, tone curve, noise.
    """
    linear = np.empty((camera.height, camera.width), dtype=np.float32)
    coarse = 1 if corners is not None else samples
    for top in range(0, camera.height, _TILE):
        for left in range(0, camera.width, _TILE):
            h, w = min(_TILE, camera.height - top), min(_TILE, camera.width - left)
            linear[top : top + h, left : left + w] = _tile(shade, camera, T_camera_board, left, top, w, h, coarse)
    half = 40
    for x, y in [] if corners is None else corners.round().astype(int):
        left, top = max(x - half, 0), max(y - half, 0)
        right, bottom = min(x + half + 1, camera.width), min(y + half + 1, camera.height)
        if right > left and bottom > top:
            linear[top:bottom, left:right] = _tile(
                shade, camera, T_camera_board, left, top, right - left, bottom - top, samples
            )
    linear = how.dark + (how.bright - how.dark) * linear
    linear *= (1 - how.light * np.linspace(0, 1, camera.width, dtype=np.float32))[None]
    if how.blur_px:
        linear = np.asarray(cv2.GaussianBlur(linear, (0, 0), how.blur_px))
    grey = 255 * np.maximum(linear, 0) ** (1 / how.gamma)
    grey += rng.standard_normal(grey.shape, dtype=np.float32) * how.noise
    return np.clip(grey + 0.5, 0, 255).astype(np.uint8)


def _tile(
    shade: Shade,
    camera: CameraModel,
    T: Transform,
    left: int,
    top: int,
    width: int,
    height: int,
    samples: int,
) -> NDArray[np.float32]:
    """Mean reflectance of each pixel of a tile."""
    sub = (np.arange(samples) + 0.5) / samples - 0.5
    x = (np.arange(width)[:, None] + sub).ravel()
    y = (np.arange(height)[:, None] + sub).ravel()
    nodes = [np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES) * 0.5 + 0.5 for _ in range(2)]
    nx, ny = nodes[0] * (width - 1), nodes[1] * (height - 1)
    grid = np.stack(np.meshgrid(nx + left, ny + top), axis=-1).reshape(-1, 2)
    rays = camera.normalise(grid)
    # The board's plane in the camera: H maps (x, y, 1) on the board to rays.
    H = np.linalg.inv(T[:3, [0, 1, 3]])
    board = np.column_stack([rays, np.ones(len(rays))]) @ H.T
    values = (board[:, :2] / board[:, 2:]).reshape(_NODES, _NODES, 2)
    wx, wy = _lagrange(nx, x), _lagrange(ny, y)
    # x and y are each contiguous and of single precision (a ten-thousandth of a pixel), which takes half the time.
    xy = np.moveaxis(np.stack([wy @ values[:, :, k] @ wx.T for k in range(2)]).astype(np.float32), 0, -1)
    footprint_m = float(np.sqrt(np.abs(np.linalg.det([xy[1, 0] - xy[0, 0], xy[0, 1] - xy[0, 0]]))))
    grey = shade(np.moveaxis(xy, -1, 0).reshape(2, -1).T, footprint_m).reshape(height * samples, width * samples)
    # The mean of whole areas, in a third of the time that `mean` over two axes takes.
    return np.asarray(
        cv2.resize(grey.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32
    )


def _lagrange(nodes: Array, at: Array) -> Array:
    """Weights (len(at), nodes) of the interpolating polynomial through the nodes."""
    weights = np.ones((len(at), len(nodes)))
    for k, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if j != k:
                weights[:, k] *= (at - other) / (node - other)
    return weights
