"""Job `register`: the registration of the scan with one source of camera poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.evaluation.accuracy import leave_one_out
from service.compute.evaluation.closure import Alignment
from service.compute.markers.archive import outline_from_record
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import register_images
from service.compute.registration.joint_poses import with_joint_pose_covariance
from service.compute.registration.result import RegistrationResult
from service.compute.registration.settings import RegistrationSettings
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, inverse
from service.core.units import mm
from service.jobs.records import ParameterCovariance, Photograph
from service.jobs.registration import register as job
from service.worker.camera import camera_reduced, camera_used
from service.worker.job import JobAnswer, JobContext
from service.worker.poses.models import joint_pose_covariance
from service.worker.poses.robot_poses import robot_camera_poses

_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")  # of the lens, in the order of the solver


def register(context: JobContext[job.Arguments]) -> JobAnswer:
    """T_world_scan for one source of poses. With robot poses every station has a base frame of its own."""
    arguments = context.arguments
    camera, source = camera_used(arguments), arguments.poses
    full = camera_reduced(arguments)
    poses, groups, images = _poses(context)
    outlines = _outlines(context, images, camera)
    spheres = np.array(arguments.spheres_m)
    names = [image.viewpoint for image in images]
    metric = source in ("robot", "robot_corrected", "spheres", "hybrid")
    posed = PosedImages(poses, camera, groups=groups, metric=metric, names=names)
    known = ScanSpheres(spheres, arguments.radius_m, covariance_m2=np.array(arguments.sphere_covariance_m2))
    solved = register_images(outlines, posed, known)
    answer = solved.registration
    stated = answer
    if arguments.tracks is not None:
        joint = joint_pose_covariance(context.input(arguments.tracks).read_bytes(), names)
        stated = with_joint_pose_covariance(answer, joint)
    components = {name: np.asarray(C, dtype=np.float64)[:6, :6] for name, C in stated.components.items()}
    result: dict[str, Any] = {
        "poses": source,
        "camera": camera.record(),
        "outlines": arguments.outlines,
        "full_camera": None if full is None else full.record(),
        "T_world_scan": answer.T_world_scan.tolist(),
        "scale": answer.scale,
        "rms_px": answer.rms_px,
        "T_world_station": {_station(images, groups, g): T.tolist() for g, T in answer.T_world_group.items()},
        "T_scan_camera": _cameras(names, answer.T_scan_camera),
        "excluded": [f"{names[r.image]}, sphere {r.marker}: {r.reason}" for r in answer.excluded],
    }
    if source == "robot_corrected":
        # The outlines tell the error of an arm's single pose (some 0.3 mm) better than the arm does.
        result["T_scan_camera_given"] = result["T_scan_camera"]
        result["T_scan_camera"] = _cameras(names, answer.T_scan_camera_refined)
        result["covariance_given"] = answer.covariance[:6, :6].tolist()
        components = answer.refined_components()
    if source == "hybrid" and arguments.model is not None:
        # The spheres are in these poses already: only their adjustment knows how well the scan is placed.
        adjusted = context.input_json(arguments.model)
        T_scan_world = inverse(np.array(adjusted["T_world_scan"]))
        result |= {key: adjusted[key] for key in ("T_world_scan", "T_world_station")}
        result["T_scan_camera"] = {name: (T_scan_world @ T).tolist() for name, T in zip(names, poses, strict=True)}
        components = {"adjustment": np.array(adjusted["scan_covariance"])[:6, :6], "spheres": components["spheres"]}
    if (lens := _intrinsics_covariance(arguments)) is not None:
        settings = RegistrationSettings(intrinsics_covariance=lens)
        uncertain = register_images(outlines, posed, known, settings, assignments=solved.assignments)
        components["intrinsics"] = _added(answer, uncertain.registration, refined=source == "robot_corrected")
    covariance = np.sum(list(components.values()), axis=0)
    result["covariance"] = covariance.tolist()
    result["components"] = {name: C.tolist() for name, C in components.items()}
    placed = Alignment(np.array(result["T_world_scan"]), covariance)
    predicted_m = float(np.sqrt(np.trace(placed.covariance_at_m2(spheres.mean(axis=0)[None])[0])))
    measures = {
        "rms_px": answer.rms_px,
        "chi2_reduced": answer.chi2_reduced,
        "markers": float(len(solved.markers)),
        "images": float(answer.n_images),
        "excluded_outlines": float(len(answer.excluded)),
        "predicted_error_mm": mm(predicted_m),
    }
    result["leave_one_out"] = left_out = _leave_one_out(answer, refined=source == "robot_corrected")
    if left_out is not None:
        measures["leave_one_out_mm"] = left_out["mean_radial_error_mm"]
    ref = context.keep_json({**result, **_residuals(answer, names)}, kind="registration", name=f"{source}.json")
    return JobAnswer(measures, (ref,), job.Registration.model_validate(result))


def _cameras(names: Sequence[str], T_scan_camera: Array) -> dict[str, list[list[float]]]:
    return {name: T.tolist() for name, T in zip(names, T_scan_camera, strict=True) if np.isfinite(T).all()}


def _leave_one_out(answer: RegistrationResult, *, refined: bool) -> dict[str, Any] | None:
    """Every sphere as predicted by the others; None where a station sees too few to spare one."""
    try:
        left_out = leave_one_out(answer, refined=refined)
    except ComputeError:
        return None
    return {
        "mean_radial_error_mm": left_out.mean_radial_error_mm,
        "mean_reprojection_error_px": left_out.mean_reprojection_error_px,
        "spheres": {str(m): list(row) for m, row in left_out.per_sphere().items()},
    }


def _added(exact: RegistrationResult, uncertain: RegistrationResult, *, refined: bool) -> Array:
    """(6, 6) what uncertain intrinsics add to the covariance, the poses being held; never negative."""
    both = [r.refined_covariance if refined else r.covariance[:6, :6] for r in (exact, uncertain)]
    unit = np.sqrt(np.diag(both[0]))  # metres and radians do not mix
    more = (both[1] - both[0]) / np.outer(unit, unit)
    values, vectors = np.linalg.eigh((more + more.T) / 2)
    kept = (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(unit, unit)
    return np.asarray(kept, dtype=np.float64)


def _poses(context: JobContext[job.Arguments]) -> tuple[Array, list[int], Sequence[Photograph]]:
    """(N, 4, 4) poses in the frame of each image's group, the groups, and the images that have a pose."""
    arguments = context.arguments
    images = arguments.images
    if arguments.poses in ("robot", "robot_corrected", "spheres"):
        stations = sorted({image.station for image in images})
        return robot_camera_poses(arguments, images), [stations.index(image.station) for image in images], images
    if arguments.model is None:
        raise DataError(f"a registration by {arguments.poses} without the poses that the images told")
    model = context.input_json(arguments.model)["T_world_camera"]
    images = [image for image in images if image.viewpoint in model]
    return np.array([model[image.viewpoint] for image in images]), [0] * len(images), images


def _outlines(
    context: JobContext[job.Arguments], images: Sequence[Photograph], camera: CameraModel
) -> list[list[SphereOutline]]:
    found = context.input_json(context.arguments.outlines)
    return [[outline_from_record(r, camera) for r in found[image.viewpoint]] for image in images]


def _intrinsics_covariance(arguments: job.Arguments) -> Array | None:
    """(8, 8) of the lens; None where nobody knows it, or where it is of another lens model or image size."""
    record = arguments.intrinsics_covariance
    if record is None or arguments.reduced:
        return None
    if not isinstance(record, ParameterCovariance):
        return np.array(record)
    known = record.parameters
    if not set(known) <= set(_PARAMETERS):
        return None
    # What the model holds fixed is known exactly; the solver needs a number that is not zero.
    out = 1e-18 * np.eye(len(_PARAMETERS))
    places = [_PARAMETERS.index(name) for name in known]
    out[np.ix_(places, places)] = np.array(record.matrix)
    return out


def _station(images: Sequence[Photograph], groups: Sequence[int], group: int) -> str:
    return next(image.station for image, g in zip(images, groups, strict=True) if g == group)


def _residuals(answer: RegistrationResult, names: Sequence[str]) -> dict[str, Any]:
    return {
        "residuals": [
            {"image": names[r.image], "marker": r.marker, "rms_px": r.rms_px, "excluded": r.excluded}
            for r in answer.residuals
        ],
        "chi2_reduced": answer.chi2_reduced,
        "cost": answer.cost,
    }
