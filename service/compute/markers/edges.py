"""Samples profiles across an outline through the lens distortion, and finds the edges on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.core.geometry import Array

Pixels = NDArray[np.uint8] | NDArray[np.uint16]  # 16 bits of a developed raw file: sRGB coded, 257 times as fine
FINER = 257  # values of 16 bits for each of 8 bits


@dataclass(frozen=True, slots=True)
class Profiles:
    """Sample positions across a cone's outline in the image.

    `pixels` (K, J, 2) for K azimuths and J offsets; `inside` (K, J) whether in the image; `per_pixel_rad` (K,) the
    angle that one pixel subtends across the outline. For G cones, these have a leading axis (G, ...).
    """

    azimuth_rad: Array
    offsets_px: Array
    pixels: Array
    inside: NDArray[np.bool_]
    per_pixel_rad: Array


def profiles(cone: Cone, camera: CameraModel, n_azimuths: int, offsets_px: Array) -> Profiles:
    """Sample positions across the outline, with the lens distortion applied, so that edges need no undistortion."""
    where = profiles_of([cone], camera, n_azimuths, offsets_px)
    return Profiles(where.azimuth_rad, offsets_px, where.pixels[0], where.inside[0], where.per_pixel_rad[0])


def profiles_of(cones: Sequence[Cone], camera: CameraModel, n_azimuths: int, offsets_px: Array) -> Profiles:
    """Sample positions across the outlines of G cones, as `profiles` does for one."""
    azimuth = np.linspace(0.0, 2 * np.pi, n_azimuths, endpoint=False).astype(np.float64)
    half = np.array([c.half_angle_rad for c in cones])[:, None]
    frames = np.array([c.frame() for c in cones])
    around = np.cos(azimuth)[:, None] * frames[:, None, :, 0] + np.sin(azimuth)[:, None] * frames[:, None, :, 1]
    axis = frames[:, None, None, :, 2]

    def projected(angles: Array) -> Array:
        rays = np.sin(angles)[..., None] * around[:, :, None] + np.cos(angles)[..., None] * axis
        return camera.project(rays.reshape(-1, 3)).reshape(*angles.shape, 2)

    delta = 0.5 / camera.fx
    ends = projected(np.broadcast_to(half[..., None] + [-delta, delta], (len(cones), n_azimuths, 2)))
    per_pixel = 2 * delta / np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=2)
    pixels = projected(half[..., None] + per_pixel[..., None] * offsets_px)
    inside = np.all((pixels >= 1) & (pixels <= [camera.width - 2, camera.height - 2]), axis=3)
    return Profiles(azimuth, offsets_px, pixels, inside, per_pixel)


def sample(image: NDArray[np.float32] | NDArray[np.uint8], pixels: Array) -> NDArray[np.float32]:
    """Return bilinear values (K, J[, C]) at exact pixels (K, J, 2); cv2.remap would round them to 1/32 px."""
    h, w = image.shape[:2]
    x = np.clip(pixels[..., 0], 0, w - 1.001)
    y = np.clip(pixels[..., 1], 0, h - 1.001)
    x0, y0 = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    if image.ndim == 3:
        fx, fy = fx[..., None], fy[..., None]
    top = image[y0, x0] * (1 - fx) + image[y0, x0 + 1] * fx
    bottom = image[y0 + 1, x0] * (1 - fx) + image[y0 + 1, x0 + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy, dtype=np.float32)


def sample_sharp(image: Pixels, pixels: Array) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Return the values (..., J, 3) at pixels (..., J, 2) by Lanczos interpolation, which does not blur.

    Bilinear interpolation averages coded values, which blurs after the transfer curve and moves high-contrast edges
    by a tenth of a pixel. Positions are rounded to 1/32 px, without bias. Values of 16 bits are given in units of
    those of 8 bits, not rounded.
    """
    values = _remapped(image, pixels, cv2.INTER_LANCZOS4)
    if values.dtype == np.uint8:
        return values.astype(np.uint8, copy=False)
    return (values / np.float32(FINER)).astype(np.float32)


def sample_averaged(image: Pixels, pixels: Array, count: int) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Return the means (..., J, 3) of every `count` neighbouring values along profiles (..., J * count, 2)."""
    values = _remapped(image, pixels, cv2.INTER_LINEAR)
    means = values.reshape(*values.shape[:-2], -1, count, 3).mean(axis=-2, dtype=np.float32)
    if values.dtype != np.uint8:
        return (means / np.float32(FINER)).astype(np.float32)
    return np.rint(means).astype(np.uint8)


def _remapped(image: Pixels, pixels: Array, how: int) -> Pixels:
    at = pixels.reshape(-1, *pixels.shape[-2:]).astype(np.float32)
    values = cv2.remap(image, at[..., 0], at[..., 1], how, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(*pixels.shape[:-1], 3)  # pyright: ignore[reportReturnType] - cv2 keeps the image's type


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """Edge points across an outline: azimuth index `slot` (N,), `offset_px` (N,) and `strength` (N,) 0..1."""

    slot: NDArray[np.int64]
    offset_px: Array
    strength: Array


def envelope_edges(values: NDArray[np.float32], where: Profiles, peaks_per_ray: int = 3) -> EdgePoints:
    """Return the strongest edges of each profile: maxima of any channel's derivative along it.

    `values` (K, J, C) are of an 8-bit image. Strength is relative to the strongest edge of the profile, so a faint
    outline counts fully unless something stronger is beside it.
    """
    step = where.offsets_px[1] - where.offsets_px[0]
    smooth = cv2.GaussianBlur(values, (5, 1), 0.9 / max(step, 0.3), borderType=cv2.BORDER_REPLICATE)
    smooth = smooth.reshape(values.shape)
    change = np.abs(smooth[:, 2:] - smooth[:, :-2]).max(axis=2) / (2 * step)  # grey levels per pixel
    change[~(where.inside[:, 2:] & where.inside[:, :-2])] = 0
    middle = change[:, 1:-1]
    peak = (middle >= change[:, :-2]) & (middle > change[:, 2:]) & (middle > 2.0)
    height = np.where(peak, middle, 0)
    order = np.argsort(-height, axis=1)[:, :peaks_per_ray]
    rows = np.repeat(np.arange(len(height)), peaks_per_ray)
    columns = order.reshape(-1)
    top = height[rows, columns]
    ok = top > 0
    rows, columns, top = rows[ok], columns[ok], top[ok]
    a, b, c = change[rows, columns], change[rows, columns + 1], change[rows, columns + 2]
    bend = a - 2 * b + c
    shift = np.where(bend < 0, 0.5 * (a - c) / np.where(bend < 0, bend, 1), 0)
    offset = where.offsets_px[columns + 2] + np.clip(shift, -0.5, 0.5) * step
    strongest = height.max(axis=1)
    # From 12 grey levels per pixel an edge is certain; below, its strength is reduced.
    belief = np.minimum(1.0, 0.4 + top / 20.0)
    return EdgePoints(rows.astype(np.int64), offset, top / strongest[rows] * belief)
