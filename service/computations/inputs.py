"""What several jobs begin with: photographs as files, nominal cameras, and camera poses from those of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations.conversion import camera_reduced, camera_used, corrected_mounting
from service.computations.job import JobContext
from service.computations.kind import JobRecord
from service.computations.records import ArmCorrection, ImageFile, ImagesCamera, Mounting, PosedPhotograph
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.images.resample import resample
from service.core.errors import DataError
from service.core.geometry import Array
from service.machine.executors import mapping
from service.machine.resources import IMAGE_MB, processes_for

_A = TypeVar("_A", bound=ImagesCamera)
_J = TypeVar("_J", bound=JobRecord)
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


def photographs(context: JobContext[_A], images: Sequence[ImageFile]) -> list[Path]:
    """Return one file per image: the original, or a reduced copy if the job asks for it."""
    return photographs_at(context, images, camera_used(context.arguments), camera_reduced(context.arguments))


def photographs_at(
    context: JobContext[_J], images: Sequence[ImageFile], camera: CameraModel, full: CameraModel | None
) -> list[Path]:
    """Return one file per image at a camera's size: the original, or a copy reduced from the `full` camera's."""
    originals = [context.input(image.sha256) for image in images]
    if full is None:
        return originals
    folder = context.scratch / f"{camera.width}x{camera.height}"
    folder.mkdir(exist_ok=True)
    copies = [folder / f"{image.viewpoint}.jpg" for image in images]
    reduce = partial(_reduce, full=full, width=camera.width, height=camera.height)
    with mapping(processes_for(len(images), IMAGE_MB), len(images)) as map_over:
        for done, _ in enumerate(map_over(reduce, list(zip(originals, copies, strict=True))), 1):
            context.progress(f"images at {camera.width} × {camera.height}", done, len(images))
    return copies


def _reduce(files: tuple[Path, Path], full: CameraModel, width: int, height: int) -> None:
    original, copy = files
    _, data = cv2.imencode(".jpg", resample(read_image(original), full, width, height), _JPEG)
    copy.write_bytes(data.tobytes())


def nominal_camera(width: int, height: int, focal_mm: float, sensor_width_mm: float) -> CameraModel:
    """Return nominal intrinsics: focal length from the file, principal point in the middle, no distortion.

    Raises:
        DataError: the file does not state its focal length.
    """
    if not focal_mm > 0:
        raise DataError(
            "the photograph does not state its focal length",
            remedy="Use a lens that reports it to the camera, or check the layout with `orthocapture layout --photo`",
        )
    focal_px = focal_mm / sensor_width_mm * width
    return CameraModel(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0)


def robot_camera_poses(mounting: Mounting, images: Sequence[PosedPhotograph]) -> Array:
    """Return (N, 4, 4) T_base_camera of a job's images, each in the base frame of its station.

    Args:
        mounting: the camera's mounting on the arm.
        images: the images, with `T_scene_camera` of a hand-held camera, or with `T_base_flange`; for a correction
            also with `station` and `joints_rad`.

    Raises:
        DataError: the joints are not of the corrected arm.
    """
    if all(image.T_scene_camera is not None for image in images):  # hand-held, located by the spheres
        return np.array([image.T_scene_camera for image in images], dtype=np.float64)
    flange = np.array([image.T_base_flange for image in images], dtype=np.float64)
    poses = flange @ np.array(mounting.T_flange_camera, dtype=np.float64)
    correction = mounting.arm_correction
    if correction is not None:
        stations = mounting.arm_stations if mounting.arm_stations is not None else correction.stations or ()
        _correct(poses, correction, flange, images, _stood_at(images, stations))
    for arm in mounting.further_arms:
        mine = _stood_at(images, arm.stations)
        poses[mine] = flange[mine] @ np.array(arm.T_flange_camera, dtype=np.float64)
        if arm.arm_correction is not None:
            _correct(poses, arm.arm_correction, flange, images, mine)
    return poses


def _stood_at(images: Sequence[PosedPhotograph], stations: Sequence[str]) -> NDArray[np.bool_]:
    return np.array([image.station in stations for image in images], dtype=np.bool_)


def _correct(
    poses: Array, correction: ArmCorrection, flange: Array, images: Sequence[PosedPhotograph], mine: NDArray[np.bool_]
) -> None:
    """Replace the poses of one arm's images by corrected ones."""
    if mine.any():
        joints = np.array([image.joints_rad for image, own in zip(images, mine, strict=True) if own])
        poses[mine] = corrected_mounting(correction).T_base_camera(joints, flange[mine])
