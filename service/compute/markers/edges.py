"""Edge points of an outline: first every edge in an envelope, then the sub-pixel place of the right one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.core.geometry import Array

SRGB_TO_LINEAR = np.array(
    [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in np.arange(256) / 255.0], dtype=np.float32
)

LUMA = np.array([0.114, 0.587, 0.299])  # B, G, R: ITU-R BT.601, which JPEG uses


@dataclass(frozen=True, slots=True)
class Profiles:
    """Where the rays of a cone's neighbourhood fall in the image.

    `pixels` (K, J, 2) of K azimuths and J offsets; `inside` (K, J) whether in the image; `per_pixel_rad` (K,) the
    angle that one pixel subtends across the outline there.
    """

    azimuth_rad: Array
    offsets_px: Array
    pixels: Array
    inside: NDArray[np.bool_]
    per_pixel_rad: Array


def profiles(cone: Cone, camera: CameraModel, n_azimuths: int, offsets_px: Array) -> Profiles:
    """Sample positions across the outline, through the lens's distortion, so that edges need no undistortion."""
    azimuth = np.linspace(0.0, 2 * np.pi, n_azimuths, endpoint=False).astype(np.float64)
    delta = 0.5 / camera.fx
    ends = [
        camera.project(cone.rays(azimuth, np.full(n_azimuths, cone.half_angle_rad + sign * delta)))
        for sign in (-1.0, 1.0)
    ]
    per_pixel = 2 * delta / np.linalg.norm(ends[1] - ends[0], axis=1)
    angles = cone.half_angle_rad + per_pixel[:, None] * offsets_px
    rays = cone.rays(azimuth[:, None], angles)
    pixels = camera.project(rays.reshape(-1, 3)).reshape(n_azimuths, len(offsets_px), 2)
    inside = np.all((pixels >= 1) & (pixels <= [camera.width - 2, camera.height - 2]), axis=2)
    return Profiles(azimuth, offsets_px, pixels, inside, per_pixel)


def sample(image: NDArray[np.float32] | NDArray[np.uint8], pixels: Array) -> NDArray[np.float32]:
    """Bilinear values (K, J[, C]) at pixels (K, J, 2); exact coordinates, where cv2.remap rounds to 1/32 px."""
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


def luma_values(
    image: NDArray[np.uint8], where: Profiles, *, srgb: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Luma in linear light (K, J) along the profiles, and linear B, G, R (K, J, 3).

    Luma is what JPEG stores at full resolution; the colour differences are subsampled (and not always sited where the
    decoder puts them): their edges are off by a tenth of a pixel and more.
    """
    h, w = image.shape[:2]
    flat = where.pixels.reshape(-1, 2)
    low = np.clip(np.floor(flat.min(axis=0)).astype(int) - 2, 0, [w - 2, h - 2])
    high = np.clip(np.ceil(flat.max(axis=0)).astype(int) + 3, low + 2, [w, h])
    patch = np.asarray(image[low[1] : high[1], low[0] : high[0]])
    grey = np.asarray(cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    at = where.pixels - low
    if not srgb:
        scale = np.float32(1 / 255)
        return sample(grey, at) * scale, sample(patch, at) * scale
    return sample(SRGB_TO_LINEAR[grey], at), sample(SRGB_TO_LINEAR[patch], at)


def coloured_edge_profiles(colours: NDArray[np.float32], where: Profiles, blur_px: float) -> NDArray[np.float32]:
    """(K, J) what `luma_values` gives for an edge at offset zero between the colours found on its two sides.

    Luma is a sum of coded, not of linear, values: where the colours differ, the profile of a blurred edge is
    distorted and its apparent place shifted. The shift is found by measuring these profiles and is then taken off.
    """
    away = np.abs(where.offsets_px) > max(2.0, 1.5 * blur_px)
    near = np.abs(where.offsets_px) < 5.0
    sides: list[Array] = []
    for sign in (-1, 1):
        pick = away & near & (np.sign(where.offsets_px) == sign)
        mean = colours[:, pick].mean(axis=1).astype(np.float64)
        # Texture: a few neighbours together; the outline's surroundings change slowly along it.
        sides.append(np.mean([np.roll(mean, k, axis=0) for k in (-2, -1, 0, 1, 2)], axis=0))
    inside = 0.5 * (1 + erf(-where.offsets_px / (np.sqrt(2) * blur_px)))
    light = inside[:, None] * sides[0][:, None] + (1 - inside[:, None]) * sides[1][:, None]
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    luma = coded @ LUMA
    linear = np.where(luma <= 0.04045, luma / 12.92, ((luma + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def colour_values(colours: NDArray[np.float32], where: Profiles) -> NDArray[np.float32]:
    """(K, J) linear light along the direction in colour space in which the two sides of the outline differ most.

    For outlines that luma hardly shows. Fisher's discriminant, well shrunk towards the plain difference of the
    colours, so that the subsampled colour differences are not amplified more than they must.
    """
    rows = np.all(where.inside, axis=1)
    if rows.sum() < 8:
        return (colours @ LUMA).astype(np.float32)
    y = colours[rows].astype(np.float64)
    inner, outer = y[:, where.offsets_px < -1.0], y[:, where.offsets_px > 1.0]
    step = np.median(inner.mean(axis=1) - outer.mean(axis=1), axis=0)
    scatter = np.zeros((3, 3))
    for side in (inner, outer):
        # Shading changes slowly: differences of neighbours tell noise and texture without it.
        d = (side[:, 2:] - side[:, :-2]).reshape(-1, 3) / np.sqrt(2)
        scatter += d.T @ d / len(d)
    scatter += np.eye(3) * max(float(np.trace(scatter)), 1e-9)
    w = np.linalg.solve(scatter, step).astype(np.float64)
    return (colours @ (w / max(float(np.linalg.norm(w)), 1e-12))).astype(np.float32)


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """Edge points across an outline: slot (N,) is the azimuth's index, offset (N,) in pixels, strength (N,) 0..1."""

    slot: NDArray[np.int64]
    offset_px: Array
    strength: Array


def envelope_edges(values: NDArray[np.float32], where: Profiles, peaks_per_ray: int = 3) -> EdgePoints:
    """The strongest edges of each profile: maxima of the derivative along it of any channel.

    `values` (K, J, C) of an 8-bit image. Strength is relative to the strongest edge of the same profile, so that a
    faint outline counts, but less where something stronger is beside it.
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
    # 12 grey levels per pixel is an edge nobody doubts; below, belief falls.
    belief = np.minimum(1.0, 0.4 + top / 20.0)
    return EdgePoints(rows.astype(np.int64), offset, top / strongest[rows] * belief)


@dataclass(frozen=True, slots=True)
class SubPixelEdges:
    """Model edges of all K azimuths: offset and its sigma in pixels, step over full scale, and whether usable."""

    offset_px: Array
    sigma_px: Array
    step: Array
    ok: NDArray[np.bool_]
    blur_px: float


BLURS_PX = (0.45, 0.6, 0.8, 1.05, 1.4, 1.9, 2.6)


@lru_cache(maxsize=256)
def _edge_basis(blur_px: float, radius_px: float, shifts: tuple[float, ...], offsets: tuple[float, ...]) -> Array:
    """(E, J, 4) orthonormal bases of the edge model for each shift of the edge.

    Outside: constant and slope. Inside, a matte sphere under any distant light shades along a radius like
    a + b sqrt(1 - rho^2) (+ c rho, which a short profile cannot tell from a); its infinite slope at the limb is what
    pulls a plain gradient maximum inwards. All of it is blurred by a Gaussian.
    """
    fine = np.arange(-4 * blur_px, 4 * blur_px + 1e-9, blur_px / 12)
    kernel = np.exp(-0.5 * (fine / blur_px) ** 2)
    kernel /= kernel.sum()
    t = np.array(offsets) - np.array(shifts)[:, None]  # (E, J)
    step = 0.5 * (1 + erf(-t / (np.sqrt(2) * blur_px)))
    u = t[..., None] - fine  # the blurred limb term by quadrature
    depth = np.clip(-u / radius_px, 0, 1)
    limb = np.sqrt(depth * (2 - depth)) @ kernel
    slope = np.maximum(u, 0) @ kernel
    return np.asarray(np.linalg.qr(np.stack([step, 1 - step, limb, slope], axis=2))[0], dtype=np.float64)


def sub_pixel_edges(
    linear: NDArray[np.float32],
    where: Profiles,
    radius_px: float,
    reach_px: float,
    blurs_px: Sequence[float] = BLURS_PX,
) -> SubPixelEdges:
    """Places of the edge on each profile by the least squares of a blurred matte-limb model.

    Args:
        linear: (K, J) linear-light luma, 0..1, along the profiles.
        where: the profiles; their offsets must reach a few pixels beyond the search.
        radius_px: of the outline.
        reach_px: greatest shift of the edge from the profile's middle.
        blurs_px: standard deviations of the blur to choose from, ascending.
    """
    y = linear.astype(np.float64)
    usable = np.all(where.inside, axis=1)
    shifts = tuple(np.arange(-reach_px, reach_px + 1e-9, 0.2).round(3).tolist())
    offsets = tuple(where.offsets_px.tolist())
    radius = float(max(2.0, round(radius_px)))
    power = np.sum(y**2, axis=1)
    best: tuple[float, float, Array] | None = None
    for blur in blurs_px:
        Q = _edge_basis(blur, radius, shifts, offsets)
        along = y @ Q.transpose(1, 0, 2).reshape(y.shape[1], -1)  # (K, E B): one product, much faster than einsum
        cost = power[:, None] - np.sum((along**2).reshape(len(y), len(Q), -1), axis=2)  # (K, E)
        least = cost.min(axis=1)
        score = float(np.median(least[usable])) if np.any(usable) else float(np.median(least))
        if best is None or score < best[0]:
            best = (score, blur, cost)
        elif score > 1.5 * best[0]:
            break
    assert best is not None
    _, blur, cost = best
    grid = np.array(shifts)
    at = np.argmin(cost, axis=1)
    inner = np.clip(at, 1, len(grid) - 2)
    rows = np.arange(len(y))
    a, b, c = cost[rows, inner - 1], cost[rows, inner], cost[rows, inner + 1]
    bend = np.maximum(a - 2 * b + c, 1e-15)
    offset = grid[inner] + np.clip(0.5 * (a - c) / bend, -1, 1) * 0.2
    n_free = max(1, y.shape[1] - 5)
    noise = np.maximum(b, 0) / n_free
    typical = float(np.median(noise[usable])) if np.any(usable) else 1.0
    sigma = np.sqrt(np.maximum(noise, 0.3 * typical) * 2 * 0.04 / bend)
    near = np.abs(where.offsets_px[None, :] - offset[:, None])
    outer = np.where((near < 3.5) & (where.offsets_px > offset[:, None] + blur), y, np.nan)
    inner_values = np.where((near < 3.5) & (where.offsets_px < offset[:, None] - blur), y, np.nan)
    count = np.isfinite(outer).any(axis=1) & np.isfinite(inner_values).any(axis=1)
    step = np.zeros(len(y))
    step[count] = np.nanmean(inner_values[count], axis=1) - np.nanmean(outer[count], axis=1)
    ok = usable & count & (at > 0) & (at < len(grid) - 1) & (sigma < 0.5) & (noise < 25 * typical)
    return SubPixelEdges(offset, sigma, step, ok, blur)
