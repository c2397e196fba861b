"""Pictures for the report: the detected outlines in an image, and those that the registration predicts."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.compute.pipeline import Detection
from service.core.geometry import Array, Transform, apply, inverse

_REGISTRATION, _CONTROL, _UNUSED, _EXCLUDED, _PREDICTED = (
    (60, 220, 60), (255, 160, 0), (160, 160, 160), (40, 40, 255), (0, 220, 255),
)  # fmt: skip


def draw_overlay(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    detections: Sequence[Detection],
    *,
    T_scan_camera: Transform | None = None,
    registration_centres_m: Array | None = None,
    control_centres_m: Array | None = None,
    radius_m: float = 0.015,
) -> NDArray[np.uint8]:
    """A copy (H, W, 3) with detected outlines (green: registration, blue: control, grey: unused, red: excluded),
    their sphere numbers, and the outlines that the registration predicts, dashed in yellow.
    """
    picture = image_bgr.copy()
    width = max(1, round(camera.width / 900))
    if T_scan_camera is not None and np.all(np.isfinite(T_scan_camera)):
        for centres in (registration_centres_m, control_centres_m):
            if centres is not None:
                for c in apply(inverse(T_scan_camera), centres):
                    _dashed(picture, c, radius_m, camera, width)
    for d in detections:
        colour, label = _UNUSED, ""
        if d.marker is not None:
            colour, label = (_EXCLUDED if d.excluded else _REGISTRATION), str(d.marker)
        elif d.control is not None:
            colour, label = _CONTROL, f"C{d.control}"
        curve = np.rint(d.outline.captured_px(camera) * 16).astype(np.int32)
        cv2.polylines(picture, [curve], True, colour, width, cv2.LINE_AA, shift=4)
        if label:
            x, y = (round(v) for v in d.outline.centre_px)
            size = camera.width / 1900
            for tone, thickness in (((0, 0, 0), 4 * width), (colour, 2 * width)):
                place = (x - round(10 * size * len(label)), y + round(10 * size))
                cv2.putText(picture, label, place, cv2.FONT_HERSHEY_SIMPLEX, size, tone, thickness, cv2.LINE_AA)
    return picture


def _dashed(picture: NDArray[np.uint8], centre: Array, radius_m: float, camera: CameraModel, width: int) -> None:
    if centre[2] < 3 * radius_m:
        return
    cone = cone_of_sphere(centre, radius_m)
    middle = camera.project(centre[None])[0]
    if not (-0.2 < middle[0] / camera.width < 1.2 and -0.2 < middle[1] / camera.height < 1.2):
        return
    curve = camera.project(cone.rays(np.linspace(0, 2 * np.pi, 97), np.full(97, cone.half_angle_rad * 1.04)))
    points = np.rint(curve * 16).astype(np.int32)
    for k in range(0, 96, 4):
        cv2.polylines(picture, [points[k : k + 3]], False, _PREDICTED, width, cv2.LINE_AA, shift=4)
