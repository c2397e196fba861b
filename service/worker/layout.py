"""Job `layout`: photographs of the placed spheres → their places → near-symmetries."""

from __future__ import annotations

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.images import read_image
from service.compute.markers.detect import detect_spheres
from service.compute.registration.layout import check_layout, layout_record
from service.compute.registration.photo_layout import merge_places, places_from_outlines
from service.core.errors import DataError
from service.worker.job import JobAnswer, JobContext


def layout(context: JobContext) -> JobAnswer:
    """Spheres of all photographs in one frame, judged by `check_layout`."""
    arguments = context.arguments
    radius_m = float(arguments["radius_m"])
    places = []
    for number, image in enumerate(arguments["images"]):
        context.progress("spheres in photographs", number, len(arguments["images"]))
        pixels = read_image(context.input(image["sha256"]))
        camera = nominal_camera(pixels.shape[1], pixels.shape[0], image["focal_mm"], arguments["sensor_width_mm"])
        places.append(places_from_outlines(detect_spheres(pixels, camera), radius_m))
    centres, covariances, used = merge_places(places)
    report = check_layout(centres, covariances, radius_m=radius_m)
    measures = {
        "spheres_seen": float(len(centres)),
        "photographs_used": float(used),
        "layout_margin_mm": 1e3 * report.margin_m,
        "layout_margin_sigma_mm": 1e3 * report.margin_sigma_m,
        "layout_depth_mm": 1e3 * report.depth_m,
        "layout_gap_deg": float(np.rad2deg(report.largest_gap_rad)),
        "layout_problems": float(len(report.problems)),
    }
    return JobAnswer(measures, (), {"spheres_m": centres.tolist(), "details": layout_record(report)})


def nominal_camera(width: int, height: int, focal_mm: float, sensor_width_mm: float) -> CameraModel:
    """A camera that was not calibrated: focal length by the file, principal point in the middle, no distortion.

    Raises:
        DataError: the file does not tell its focal length.
    """
    if not focal_mm > 0:
        raise DataError(
            "the photograph does not tell its focal length",
            remedy="use a lens that tells the camera, or check the layout with `orthocapture layout --photo`",
        )
    focal_px = focal_mm / sensor_width_mm * width
    return CameraModel(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0)
