"""Runs pycolmap in the child process of structure from motion, with its output in a log file."""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_grey
from service.compute.sfm.colmap import extract_sift, from_colmap_pixels, to_colmap_camera, to_colmap_pixels
from service.compute.sfm.features import match_descriptors
from service.compute.sfm.mapping import map_images
from service.compute.sfm.options import Progress, reduction
from service.core.errors import DataError, OrthocaptureError
from service.core.geometry import Array


def main(log: str, seed: int, pipe: Connection) -> None:
    """Entry point: process (task, job) messages until the other end is closed.

    Sends ("progress", (stage, done, total)) in between, and ("result", value) or ("error", what) at the end of each.
    """
    handle = os.open(Path(log), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    pycolmap.logging.logtostderr = True
    cv2.setNumThreads(1)
    tasks: dict[str, Callable[[dict[str, Any], Progress], Any]] = {
        "extract": _extract,
        "match": _match,
        "map": map_images,
    }

    def progress(stage: str, done: int, total: int) -> None:
        pipe.send(("progress", (stage, done, total)))

    while True:
        try:
            task, job = pipe.recv()
        except (EOFError, OSError):
            return
        pycolmap.set_random_seed(seed)
        try:
            answer = ("result", tasks[task](job, progress))
        except OrthocaptureError as error:
            answer = ("error", error)
        except (RuntimeError, ValueError, OSError) as error:  # raised by pycolmap
            answer = ("error", str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__)
        pipe.send(answer)


def _extract(job: dict[str, Any], _progress: Progress) -> dict[str, Any]:
    options, camera = job["options"], job["camera"]
    image = read_grey(Path(job["file"]))
    size = (image.shape[1], image.shape[0])
    if size != (camera["width"], camera["height"]):
        raise DataError(
            f"the image is {size[0]}×{size[1]}, the camera {camera['width']}×{camera['height']}",
            where=job["file"],
            remedy="Check the file, and that the calibration was made at the images' size",
        )
    scale = np.ones(2)
    factor = reduction(options["max_image_size"], *size)
    if factor > 1:
        small = (round(size[0] / factor), round(size[1] / factor))
        image = np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        scale = np.array(size) / np.array(small)
    found = extract_sift(image, options["max_features"], options["first_octave"])
    return {
        "width": size[0],
        "height": size[1],
        "pixels": from_colmap_pixels(found.points * scale).astype(np.float32),
        "scales_px": (found.scales_px * float(scale.mean())).astype(np.float32),
        "descriptors": found.descriptors,
    }


def _match(job: dict[str, Any], _progress: Progress) -> dict[str, Any]:
    """Matches by descriptor, then those consistent with one epipolar geometry."""
    options = job["options"]
    matches = match_descriptors(*job["descriptors"])
    verification = pycolmap.TwoViewGeometryOptions()
    camera = CameraModel(**job["camera"])
    verification.ransac.max_error = options["verification_error_px"] * reduction(
        options["max_image_size"], camera.width, camera.height
    )
    verification.ransac.random_seed = options["seed"]
    colmap = to_colmap_camera(camera)
    colmap.has_prior_focal_length = True
    first, second = (to_colmap_pixels(pixels.astype(np.float64)) for pixels in job["pixels"])
    geometry = pycolmap.estimate_two_view_geometry(colmap, first, colmap, second, matches, verification)
    features: NDArray[np.uint32] = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    matrices: list[Array] = [
        np.zeros((3, 3)) if M is None else np.asarray(M, dtype=np.float64)
        for M in (geometry.E, geometry.F, geometry.H)
    ]
    return {"features": features, "configuration": int(geometry.config), "matrices": np.array(matrices)}
