"""Coarse search for circles by votes of edge pixels along their gradient, at several scales."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_LEAST_RADIUS = 11  # pixels at the scale of a search: small enough to be fast, large enough to be distinct
_OCTAVE = 2.0


@dataclass(frozen=True, slots=True)
class CircleCandidate:
    """A circle in pixels of the reduced image, which serves as bounding box and as initial outline."""

    x: float
    y: float
    radius: float
    vote: float  # share of the circumference that votes for it


def colour_gradient(image: NDArray[np.uint8]) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Sobel derivatives (H, W) in x and y of each pixel's channel with the largest change; `image` is BGR."""
    smooth = cv2.GaussianBlur(image, (5, 5), 1.1)
    dx = cv2.Sobel(smooth, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(smooth, cv2.CV_16S, 0, 1)
    best = np.abs(dx[..., 0]) + np.abs(dy[..., 0])
    gx, gy = dx[..., 0].copy(), dy[..., 0].copy()
    for channel in (1, 2):
        size = np.abs(dx[..., channel]) + np.abs(dy[..., channel])
        more = size > best
        np.copyto(best, size, where=more)
        np.copyto(gx, dx[..., channel], where=more)
        np.copyto(gy, dy[..., channel], where=more)
    return gx.astype(np.int16), gy.astype(np.int16)


def edges(gx: NDArray[np.int16], gy: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Thin edge pixels (H, W), with thresholds from the image's median gradient, not from its maximum."""
    size = np.abs(gx[::3, ::3].astype(np.int32)) + np.abs(gy[::3, ::3])
    low = float(np.clip(2.5 * np.median(size), 24, 80))
    return np.asarray(cv2.Canny(gx, gy, low, 2.2 * low) > 0)


def find_candidates(
    image: NDArray[np.uint8], least_radius: float, greatest_radius: float, min_vote: float, limit: int
) -> list[CircleCandidate]:
    """Circles with radii in a range (pixels of this image), the most votes first, one for each place and size.

    Each octave of radii is searched in a copy where its smallest radius is about eleven pixels.
    """
    found: list[CircleCandidate] = []
    radius = least_radius
    while radius < greatest_radius:
        scale = min(1.0, _LEAST_RADIUS / radius)
        top = min(radius * _OCTAVE, greatest_radius)
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        level = image if scale == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        found += _search(np.asarray(level, dtype=np.uint8), radius * scale, top * scale, min_vote, 1 / scale)
        radius = top
    found.sort(key=lambda c: -c.vote)
    kept: list[CircleCandidate] = []
    for c in found:
        if all(_apart(c, k) for k in kept):
            kept.append(c)
            if len(kept) == limit:
                break
    return kept


def _apart(a: CircleCandidate, b: CircleCandidate) -> bool:
    near = 0.35 * min(a.radius, b.radius)
    return abs(a.x - b.x) > near or abs(a.y - b.y) > near or not 0.72 < a.radius / b.radius < 1.39


@dataclass(frozen=True, slots=True)
class _EdgePixels:
    """Edge pixels and their unit gradients; `margin` pixels are added around the image for centres outside it."""

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    dx: NDArray[np.floating]
    dy: NDArray[np.floating]
    margin: int
    shape: tuple[int, int]  # with the margins

    def votes(self, radius: np.int64) -> NDArray[np.float32]:
        """For each pixel, the share of a circle of this radius around it that votes for it."""
        rows, columns = self.shape
        flat = np.concatenate(
            [
                np.rint(self.y + sign * radius * self.dy + self.margin).astype(np.int32) * columns
                + np.rint(self.x + sign * radius * self.dx + self.margin).astype(np.int32)
                for sign in (1, -1)
            ]
        )
        plane = np.bincount(flat, minlength=rows * columns).reshape(rows, columns).astype(np.float32)
        plane *= np.float32(1 / (2 * np.pi * float(radius)))
        return np.asarray(cv2.boxFilter(plane, -1, (5, 5), normalize=False), dtype=np.float32)


def _best_radii(pixels: _EdgePixels, radii: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """The most votes for any radius at each pixel, and that radius's index.

    A circle's votes spread over neighbouring radii, so each radius has the sum of its own and those beside it.
    """
    best = np.zeros(pixels.shape, dtype=np.float32)
    best_index = np.zeros(pixels.shape, dtype=np.uint8)
    planes: list[NDArray[np.float32]] = []
    for i, radius in enumerate(radii):
        planes = [*planes[-2:], pixels.votes(radius)]
        if i > 0:
            _keep_best(best, best_index, i - 1, planes)
    _keep_best(best, best_index, len(radii) - 1, planes[-2:])
    return best, best_index


def _keep_best(
    best: NDArray[np.float32], best_index: NDArray[np.uint8], index: int, planes: list[NDArray[np.float32]]
) -> None:
    """Raise `best` to the sum of the planes where that is larger, and store the radius index there."""
    total = planes[0]
    for plane in planes[1:]:
        total = cv2.add(total, plane)
    more = total > best
    np.copyto(best, total, where=more)
    best_index[more] = index


def _search(
    image: NDArray[np.uint8], least: float, greatest: float, min_vote: float, to_input: float
) -> list[CircleCandidate]:
    gx, gy = colour_gradient(image)
    ys, xs = np.nonzero(edges(gx, gy))
    if len(xs) == 0:
        return []
    dx, dy = gx[ys, xs].astype(np.float32), gy[ys, xs].astype(np.float32)
    norm = np.hypot(dx, dy)
    radii = np.arange(max(3, int(least) - 1), int(np.ceil(greatest)) + 2)
    margin = int(radii[-1])  # a centre may lie outside the image
    shape = image.shape[0] + 2 * margin, image.shape[1] + 2 * margin
    best, best_index = _best_radii(_EdgePixels(xs, ys, dx / norm, dy / norm, margin, shape), radii)
    peak = (best >= cv2.dilate(best, np.ones((7, 7), np.uint8))) & (best > min_vote)
    py, px = np.nonzero(peak)
    strongest = np.argsort(-best[py, px])[:150]
    return [
        CircleCandidate(
            (float(px[k]) - margin + 0.5) * to_input - 0.5,
            (float(py[k]) - margin + 0.5) * to_input - 0.5,
            float(radii[best_index[py[k], px[k]]]) * to_input,
            float(best[py[k], px[k]]),
        )
        for k in strongest
    ]
