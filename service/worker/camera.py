"""Camera models from the records of jobs."""

from __future__ import annotations

import numpy as np

from service.compute.camera_model import CameraCovariance, CameraModel
from service.compute.pixels.resample import camera_at
from service.core.geometry import Array
from service.jobs.records import Camera, ImagesCamera, Matrix, ParameterCovariance


def camera_of(record: Camera) -> CameraModel:
    """The camera model of a record."""
    return CameraModel.from_record(record.plain())


def camera_record(camera: CameraModel) -> Camera:
    """The record of a camera model."""
    return Camera.model_validate(camera.record())


def lens_covariance(record: Matrix | ParameterCovariance | None) -> Array | None:
    """(8, 8) covariance of the intrinsics in a record; None if it is unknown, or belongs to another lens model."""
    if record is None:
        return None
    if not isinstance(record, ParameterCovariance):
        return np.array(record)
    return CameraCovariance(record.parameters, np.array(record.matrix)).of_lens()


def camera_used(arguments: ImagesCamera) -> CameraModel:
    """The camera at the size of the images that a job uses."""
    camera = camera_of(arguments.camera)
    return camera if arguments.reduced_to is None else camera_at(camera, *arguments.reduced_to)


def camera_reduced(arguments: ImagesCamera) -> CameraModel | None:
    """The camera at the size of the photographs if the job uses reduced copies of them; else None."""
    if arguments.reduced_to is not None:
        return camera_of(arguments.camera)
    return None if arguments.full_camera is None else camera_of(arguments.full_camera)
