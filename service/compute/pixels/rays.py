"""The rays of a camera's pixels, row by row: exact for a pinhole, by Chebyshev polynomials for a distorted camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError
from service.core.geometry import Array

_DEGREES = (8, 16, 32, 64)
_LARGEST_ERROR_PX = 1e-4
_CHECKED = 41  # places across the image, and down it, where the polynomials are compared with the camera


@dataclass(frozen=True, slots=True)
class PixelRays:
    """Normalised coordinates x/z, y/z of every pixel centre: rows[v] @ columns, both as polynomials.

    Attributes:
        width, height: of the image in pixels.
        rows: (height, K) basis of the row.
        columns: (K, width, 2) basis of the column, for x and y.
    """

    width: int
    height: int
    rows: Array
    columns: Array

    def xy(self, begin: int, end: int) -> Array:
        """(end - begin, width, 2) undistorted x/z, y/z of the pixel centres of rows [begin, end)."""
        flat = self.columns.reshape(len(self.columns), -1)
        return (self.rows[begin:end] @ flat).reshape(end - begin, self.width, 2)

    def turned(self, rotation: Array) -> NDArray[np.float32]:
        """(K, width, 3) columns of the directions rotation (3, 3) @ (x, y, 1): multiply by `rows` as float32."""
        turned = self.columns @ rotation[:, :2].T
        turned[0] += rotation[:, 2]  # the first basis function of the rows is 1
        return turned.astype(np.float32)


def pixel_rays(camera: CameraModel) -> PixelRays:
    """The rays of a camera, distorted or not; pixel centres lie at integer coordinates.

    The inverse of the distortion has no closed form. It is interpolated at Chebyshev nodes of the whole image, which
    converges geometrically for a smooth function (Trefethen, "Approximation Theory and Approximation Practice",
    2013, chapter 8), and projected again to check it: the largest error is 1e-4 px.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    if not camera.distortion.any():
        return _pinhole(camera)
    for degree in _DEGREES:
        rays = _interpolated(camera, degree)
        if _error_px(rays, camera) <= _LARGEST_ERROR_PX:
            return rays
    raise ComputeError(
        "the camera's distortion cannot be inverted for every pixel of its image",
        where=f"k1 {camera.k1:.4g}, k2 {camera.k2:.4g}, k3 {camera.k3:.4g}",
        remedy="Calibrate with board corners in all corners of the image, or with fewer distortion terms",
    )


def _pinhole(camera: CameraModel) -> PixelRays:
    rows = np.ones((camera.height, 2))
    rows[:, 1] = (np.arange(camera.height) - camera.cy) / camera.fy
    columns = np.zeros((2, camera.width, 2))
    columns[0, :, 0] = (np.arange(camera.width) - camera.cx) / camera.fx
    columns[1, :, 1] = 1.0
    return PixelRays(camera.width, camera.height, rows, columns)


def _interpolated(camera: CameraModel, degree: int) -> PixelRays:
    nodes = np.asarray(chebyshev.chebpts1(degree + 1), dtype=np.float64)
    u, v = (0.5 * (nodes + 1) * (size - 1) for size in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    values = camera.normalise(grid).reshape(degree + 1, degree + 1, 2)
    # Values at the nodes to coefficients: the discrete orthogonality of the Chebyshev polynomials.
    to_coefficients = np.asarray(chebyshev.chebvander(nodes, degree), dtype=np.float64).T * (2.0 / (degree + 1))
    to_coefficients[0] /= 2.0
    coefficients = np.einsum("iv,jw,vwc->ijc", to_coefficients, to_coefficients, values)
    columns = np.einsum("uj,ijc->iuc", _basis(camera.width, degree), coefficients)
    return PixelRays(camera.width, camera.height, _basis(camera.height, degree), np.ascontiguousarray(columns))


def _basis(size: int, degree: int) -> Array:
    """(size, degree + 1) Chebyshev polynomials at the pixel centres."""
    return np.asarray(chebyshev.chebvander(np.linspace(-1.0, 1.0, size), degree), dtype=np.float64)


def _error_px(rays: PixelRays, camera: CameraModel) -> float:
    """Largest distance between a pixel and the projection of its ray, over a grid that reaches the image's edges."""
    u, v = (np.unique(np.linspace(0, size - 1, _CHECKED).astype(int)) for size in (rays.width, rays.height))
    xy = np.einsum("vk,kuc->vuc", rays.rows[v], rays.columns[:, u])
    points = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2).reshape(-1, 3)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return float(np.abs(camera.project(points) - pixels).max())
