"""Depth of field: the range of distances that a lens renders sharp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.core.geometry import Array, Transform, apply, inverse


@dataclass(frozen=True, slots=True)
class DepthOfField:
    """Distances along the optical axis within which a point is blurred no wider than the circle of confusion."""

    near_m: float
    far_m: float  # infinite if focused at the hyperfocal distance or beyond


def depth_of_field(
    focal_length_m: float, aperture_f: float, focus_distance_m: float, circle_of_confusion_m: float
) -> DepthOfField:
    """Near and far limit for a thin lens focused at a distance from its entrance pupil.

    With H = f² / (N c) + f: near = s (H − f) / (H + s − 2 f), far = s (H − f) / (H − s).
    Source: S. F. Ray, Applied Photographic Optics, 3rd ed. 2002, chapter 22.
    """
    f, s = focal_length_m, focus_distance_m
    hyperfocal = f**2 / (aperture_f * circle_of_confusion_m) + f
    far = s * (hyperfocal - f) / (hyperfocal - s) if hyperfocal > s else float("inf")
    return DepthOfField(s * (hyperfocal - f) / (hyperfocal + s - 2 * f), far)


def depths_m(T_base_camera: Transform, points_base_m: Array) -> tuple[float, float]:
    """Least and greatest depth along the optical axis of points (N, 3) in base coordinates, metres."""
    depth = apply(inverse(T_base_camera), points_base_m)[:, 2]
    return float(np.min(depth)), float(np.max(depth))
