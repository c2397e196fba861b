"""Job `hybrid`: camera poses from images, combined with those of the robot and the spheres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.computations import hybrid as hybrid_job
from service.computations.conversion import camera_used
from service.computations.detect_spheres.compute import read_outlines
from service.computations.inputs import robot_camera_poses
from service.computations.job import JobAnswer, JobContext
from service.computations.records import PosedPhotograph, has_poses, matrices, matrix
from service.computations.structure_from_motion import ModelFile
from service.computations.structure_from_motion.compute import unpacked_tracks
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.sfm.hybrid import HybridPoses, hybrid_poses
from service.core.units import mm


def hybrid(context: JobContext[hybrid_job.Arguments]) -> JobAnswer:
    """Adjust the tracks of a model, the robot's poses and the registration spheres together."""
    arguments = context.arguments
    camera = camera_used(arguments)
    model = ModelFile.model_validate(context.input_json(arguments.model)).T_world_camera
    images = [image for image in arguments.images if image.viewpoint in model]
    names = [image.viewpoint for image in images]
    stations = sorted({image.station for image in images})
    context.progress("hybrid poses", 0, 1)
    by_arm = has_poses(arguments, images) and not _held(images)
    # Intrinsics stay fixed: overlays and control spheres use the calibrated ones, which must fit the poses.
    answer = hybrid_poses(
        PosedImages(
            np.array([model[name] for name in names]),
            camera,
            groups=[stations.index(image.station) for image in images],
            metric=False,
            names=names,
        ),
        unpacked_tracks(context.input(arguments.tracks).read_bytes(), names),
        read_outlines(context.input_json, arguments.outlines, images, camera),
        ScanSpheres(
            np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=np.array(arguments.sphere_covariance_m2)
        ),
        T_base_camera=robot_camera_poses(arguments, images) if by_arm else None,
    )
    measures = {
        "track_sigma_px": answer.sigma_track_px,
        "robot_sigma_mm": mm(answer.sigma_robot_m or 0.0),
        "robot_sigma_deg": float(np.degrees(answer.sigma_robot_rad or 0.0)),
    }
    ref = context.keep_json(_record(answer, names, stations).plain(), kind="hybrid_poses", name="hybrid_poses.json")
    return JobAnswer(measures, (ref,))


def _held(images: Sequence[PosedPhotograph]) -> bool:
    return any(image.T_scene_camera is not None for image in images)


def _record(answer: HybridPoses, names: list[str], stations: list[str]) -> hybrid_job.HybridModel:
    return hybrid_job.HybridModel(
        T_world_camera=matrices(dict(zip(names, answer.T_world_camera, strict=True))),
        pose_covariance=matrices(dict(zip(names, answer.scan_pose_covariance, strict=True))),
        pose_covariance_frame="scan",
        T_world_scan=matrix(answer.T_world_scan),
        T_world_station={stations[g]: matrix(T) for g, T in answer.T_world_group.items()},
        scan_covariance=matrix(answer.scan_covariance),
        predicted_error_mm=mm(answer.sigma_at_m(answer.centre_scan_m)),
        sigma_track_px=answer.sigma_track_px,
        sphere_factor=answer.sphere_factor,
        sigma_robot_m=answer.sigma_robot_m,
        sigma_robot_rad=answer.sigma_robot_rad,
        chi2=answer.chi2,
    )
