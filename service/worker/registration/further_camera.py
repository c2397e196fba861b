"""Job `further_camera`: the pose of a further camera from the spheres in its images."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from service.compute.camera_covariance import read_camera_covariance
from service.compute.camera_model import CameraModel
from service.compute.markers.detectors import options_for
from service.compute.markers.search.image_files import detect_all
from service.compute.poses.files.camera_files import read_camera_json
from service.compute.registration.further_camera import (
    FurtherPose,
    OuterFrame,
    SightedPose,
    fixed_pose,
    rigid_pose,
    sighted_pose,
)
from service.compute.registration.pose_covariances import of_inverse, of_product
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse
from service.core.units import mm, mrad
from service.jobs.records import matrix
from service.jobs.registration import further_camera as job
from service.worker.camera import camera_record
from service.worker.job import JobAnswer, JobContext


def further_camera(context: JobContext[job.Arguments]) -> JobAnswer:
    """Find the spheres in every image, locate the camera by them, and join what the images agree on.

    An image that does not show enough spheres is left out, as is one that contradicts the others. If no pose results,
    the answer says why, and the registration of the first camera stands all the same.
    """
    arguments = context.arguments
    calibration = context.input(arguments.calibration)
    camera = read_camera_json(calibration)
    known = read_camera_covariance(calibration)
    views, left_out = _views(context, camera, None if known is None else known.of_lens())
    answer = job.Answer(device=arguments.device, mounted=arguments.mounted, camera=camera_record(camera))
    try:
        pose = fixed_pose(views) if arguments.first is None else rigid_pose(views, _frames(arguments.first))
    except ComputeError as error:
        return JobAnswer(
            {"views": 0.0, "excluded": float(len(arguments.images))},
            answer=answer.model_copy(update={"why": str(error), "excluded": left_out}),
        )
    answer = answer.model_copy(update=_stated(pose, left_out))
    measures = {"views": float(len(answer.views)), "excluded": float(len(answer.excluded))}
    measures |= {"consistency_mm": mm(pose.mean.rms_m), "consistency_mrad": mrad(pose.mean.rms_rad)}
    single = {name: {"T_scan_camera": v.T_scan_camera.tolist(), "rms_px": v.rms_px} for name, v in views.items()}
    kept = context.keep_json(
        {**answer.plain(), "single_views": single}, kind="further_camera", name=f"{arguments.device}.json"
    )
    return JobAnswer(measures, (kept,), answer)


def _views(
    context: JobContext[job.Arguments], camera: CameraModel, lens: Array | None
) -> tuple[dict[str, SightedPose], dict[str, str]]:
    """The pose from each image, and the images without one with the reason."""
    arguments = context.arguments
    spheres = ScanSpheres(
        np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=np.array(arguments.sphere_covariance_m2)
    )
    files = [context.input(image.sha256) for image in arguments.images]
    found = detect_all(
        files,
        camera,
        options_for(arguments.colour),
        min(len(files), os.cpu_count() or 1),
        lambda done, total: context.progress(f"spheres in images of {arguments.device}", done, total),
    )
    views: dict[str, SightedPose] = {}
    left_out: dict[str, str] = {}
    for image, outlines in zip(arguments.images, found, strict=True):
        try:
            views[image.viewpoint] = sighted_pose(outlines, camera, spheres, lens)
        except ComputeError as error:
            left_out[image.viewpoint] = error.what
    return views, left_out


def _frames(first: job.FirstCamera) -> Mapping[str, OuterFrame]:
    """The first camera's poses, with the covariance that the registration gives to all of them."""
    T_world_scan, covariance = np.array(first.T_world_scan), np.array(first.covariance)[:6, :6]
    of_world = of_inverse(T_world_scan, covariance)
    nothing = np.zeros((6, 6))
    frames: dict[str, OuterFrame] = {}
    for name, rows in first.T_scan_camera.items():
        T_scan_first = np.array(rows)
        T_world_first = T_world_scan @ T_scan_first
        shared = of_product(inverse(T_world_scan), T_world_first, of_world, nothing)
        frames[name] = OuterFrame(T_scan_first, shared)
    return frames


def _stated(pose: FurtherPose, left_out: Mapping[str, str]) -> dict[str, object]:
    mean = pose.mean
    contrary = {
        name: f"{mm(float(np.linalg.norm(d[:3]))):.2f} mm and {mrad(float(np.linalg.norm(d[3:]))):.2f} mrad off"
        for name, d, kept in zip(pose.names, mean.deviations, mean.kept, strict=True)
        if not kept
    }
    return {
        "T_outer_camera": matrix(mean.T),
        "covariance": matrix(pose.covariance),
        "views": tuple(name for name, kept in zip(pose.names, mean.kept, strict=True) if kept),
        "excluded": {**left_out, **contrary},
        "consistency_mm": mm(mean.rms_m),
        "consistency_mrad": mrad(mean.rms_rad),
        "chi2_reduced": mean.chi2_reduced,
    }
