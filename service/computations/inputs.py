"""What several jobs begin with: photographs as files, nominal cameras, camera poses, and the scene of a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations.conversion import camera_of, camera_reduced, camera_used, corrected_mounting
from service.computations.hand_held import HeldArguments
from service.computations.job import JobContext
from service.computations.kind import JobRecord
from service.computations.live import LiveArguments
from service.computations.records import (
    ArmCorrection,
    Hash,
    ImageFile,
    ImagesCamera,
    Limits,
    Mounting,
    PosedPhotograph,
)
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.images.resample import resample
from service.compute.markers.records import SphereOutline, outline_from_record
from service.compute.planning.coverage import CoverageLimits, CoverageSurface, seen
from service.core.errors import DataError
from service.core.geometry import Array, Transform
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


def read_outlines(
    read: Callable[[Hash], Any], outlines: Hash, images: Sequence[PosedPhotograph], camera: CameraModel
) -> list[list[SphereOutline]]:
    """Return the outlines in each image, from the file of `detect_spheres`; `read` gives the content of a file."""
    found = read(outlines)
    return [[outline_from_record(record, camera) for record in found[image.viewpoint]] for image in images]


_L = TypeVar("_L", bound=LiveArguments)
_Capture = TypeVar("_Capture", bound=LiveArguments | HeldArguments)


@dataclass(frozen=True, slots=True)
class CaptureScene:
    """The camera, spheres and surface by which the images of a capture are judged.

    Attributes:
        camera: the calibrated camera or, for images of the board, the nominal one.
        spheres_m: (S, 3) centres, frame of the scene.
        radius_m: the spheres' radius.
        limits: the conditions on which a view counts for a point of the surface.
        surface: the specimen's surface; None without a CT, and until it is computed.
    """

    camera: CameraModel
    spheres_m: Array
    radius_m: float
    limits: CoverageLimits
    surface: CoverageSurface | None

    @property
    def n_points(self) -> int:
        """Number of points of the surface."""
        return 0 if self.surface is None else len(self.surface.points_m)

    def seen_from(self, T_scene_camera: Transform | None) -> NDArray[np.bool_]:
        """Return the mask (P,) of the surface's points that a view shows; none where its pose is not known."""
        if self.surface is None or T_scene_camera is None:
            return np.zeros(self.n_points, dtype=bool)
        return seen(self.surface, T_scene_camera[:3, 3], self.limits, T_scene_camera, self.camera)

    def targets_m(self) -> Array:
        """Return the points (T, 3) at which the registration's error is predicted: some 200, or the spheres."""
        if self.surface is None:
            return self.spheres_m
        return self.surface.points_m[:: max(1, self.n_points // 200)]


def live_scene(context: JobContext[_L]) -> CaptureScene:
    """Return the scene of a job on the images of a capture by the robot."""
    arguments = context.arguments
    return CaptureScene(
        camera_of(arguments.camera),
        np.array(arguments.spheres_m),
        arguments.radius_m,
        limits_of(arguments.limits),
        kept_surface(context),
    )


def kept_surface(context: JobContext[_Capture]) -> CoverageSurface | None:
    """Return the specimen's surface from the file of the job `coverage_points`; None without such a file."""
    sha256 = context.arguments.surface
    return None if sha256 is None else _surface_in(context.input(sha256))


@lru_cache(maxsize=1)
def _surface_in(artefact: Path) -> CoverageSurface:
    """Return the surface in an artefact, whose file never changes, with its tree of rays, slow to build."""
    with np.load(artefact, allow_pickle=False) as arrays:
        return CoverageSurface(**{name: arrays[name] for name in arrays.files})


def limits_of(record: Limits) -> CoverageLimits:
    """Return the limits of a job's record."""
    return CoverageLimits(record.max_angle_deg, record.max_distance_m, record.min_views)
