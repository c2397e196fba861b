"""Searches the surroundings of a sphere's expected place, centimetres wide, for where it really is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.compute.markers.detect import confirmed_outlines, find_rough
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline

_SIZES = (0.75, 1.3)  # of the expected radius, which is wrong by the displacement along the view
_SAME = 0.6  # of an outline's half angle: one whose axis is nearer is of the same sphere
_CANDIDATES = 24  # circles examined around one place


def find_nearby(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    expected: Sequence[tuple[Cone, float]],
    options: DetectionOptions = DEFAULTS,
) -> tuple[SphereOutline, ...]:
    """Outlines of spheres around expected ones in an image (H, W, 3), which may be others than those expected.

    Args:
        image_bgr: of the camera's size.
        camera: intrinsics.
        expected: cones of the expected spheres, and the angle (rad) by which each may be elsewhere.
        options: of the detector.
    """
    found: list[SphereOutline] = []
    for cone, window_rad in expected:
        for outline in _around(image_bgr, camera, cone, window_rad, options):
            if is_another(outline, found):
                found.append(outline)
    return tuple(found)


def is_another(outline: SphereOutline, known: Sequence[SphereOutline]) -> bool:
    """Whether an outline is of another sphere than each of those that are known in the same image."""
    apart = (float(np.linalg.norm(outline.cone.axis - other.cone.axis)) for other in known)
    return all(gap > _SAME * outline.cone.half_angle_rad for gap in apart)


def _around(
    image: NDArray[np.uint8], camera: CameraModel, cone: Cone, window_rad: float, options: DetectionOptions
) -> tuple[SphereOutline, ...]:
    azimuth = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = camera.project(cone.rays(azimuth, np.full(24, 1.3 * cone.half_angle_rad + window_rad)))
    x0, y0 = (int(v) for v in np.clip(np.floor(rim.min(axis=0)), 0, [camera.width - 8, camera.height - 8]))
    x1, y1 = (int(v) for v in np.clip(np.ceil(rim.max(axis=0)), [x0 + 8, y0 + 8], [camera.width, camera.height]))
    region = np.ascontiguousarray(image[y0:y1, x0:x1])
    there = dataclasses.replace(camera, width=x1 - x0, height=y1 - y0, cx=camera.cx - x0, cy=camera.cy - y0)
    radius = cone.half_angle_rad * camera.fx / there.width
    near = dataclasses.replace(
        options,
        min_radius=_SIZES[0] * radius,
        max_radius=_SIZES[1] * radius,
        max_candidates=min(_CANDIDATES, options.max_candidates),
    )
    return confirmed_outlines(image, camera, find_rough(region, there, near), options)
