"""Jobs on markers: detect their outlines, and register the scan with one source of camera poses."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.evaluation.accuracy import leave_one_out
from service.compute.evaluation.closure import Alignment
from service.compute.markers.archive import outline_from_record, outline_record
from service.compute.markers.detectors import options_for
from service.compute.markers.records import SphereOutline
from service.compute.markers.search.image_files import detect_all, locate_outlines, searched_whole
from service.compute.markers.search.paper_files import detect_file_by_masks
from service.compute.pipeline import register_images
from service.compute.registration.joint_poses import with_joint_pose_covariance
from service.compute.registration.result import RegistrationResult
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse
from service.worker.job import JobAnswer, JobContext
from service.worker.photographs import photographs
from service.worker.poses import joint_pose_covariance
from service.worker.robot_poses import robot_camera_poses


def detect_spheres(context: JobContext) -> JobAnswer:
    """Outlines of every sphere in every image, as one artefact that all registrations share.

    The robot's poses tell where to look, or those of a `model` from structure from motion, which has no scale; where
    they are too far off, the images are searched whole. An image without a pose in the model gets no outlines.
    """
    arguments = context.arguments
    everyone = images = arguments["images"]
    model = context.input_json(arguments["model"])["T_world_camera"] if "model" in arguments else None
    if model is not None:
        images = [image for image in images if image["viewpoint"] in model]
    files = photographs(context, images)
    workers = min(len(files), os.cpu_count() or 1)

    def show(done: int, total: int) -> None:
        context.progress("spheres in images", done, total)

    options = options_for(arguments.get("colour"))
    if arguments.get("detector", "classical") == "paper":
        located = searched_whole(
            detect_all(files, context.camera(), options, workers, show, detect=detect_file_by_masks)
        )
    else:
        located = locate_outlines(
            files,
            context.camera(),
            robot_camera_poses(arguments, images)
            if model is None
            else np.array([model[image["viewpoint"]] for image in images]),
            np.array(arguments["spheres_m"]),
            float(arguments["radius_m"]),
            groups=_numbered(image["station"] for image in images),
            scenes=_numbered(image["step"] for image in images),
            metric=model is None,
            options=options,
            workers=workers,
            progress=show,
        )
    records = [[outline_record(outline) for outline in found] for found in located.outlines]
    found = {image["viewpoint"]: [] for image in everyone}
    found |= dict(zip((image["viewpoint"] for image in images), records, strict=True))
    total = sum(map(len, records))
    ref = context.keep_json(found, kind="outlines", name="outlines.json")
    measures = {
        "outlines": float(total),
        "outlines_an_image": total / len(images),
        "images_searched_whole": float(located.count("searched")),
    }
    return JobAnswer(measures, (ref,))


def register(context: JobContext) -> JobAnswer:
    """T_world_scan for one source of poses. With robot poses every station has a base frame of its own."""
    arguments = context.arguments
    camera, source = context.camera(), arguments["poses"]
    poses, groups, images = _poses(context)
    outlines = _outlines(context, images, camera)
    spheres = np.array(arguments["spheres_m"])
    radius_m = float(arguments["radius_m"])
    names = [image["viewpoint"] for image in images]
    solve = partial(
        register_images,
        outlines,
        poses,
        camera,
        spheres,
        radius_m,
        groups=groups,
        estimate_scale=source not in ("robot", "robot_corrected", "spheres", "hybrid"),
        names=names,
        sphere_covariance_m2=np.array(arguments["sphere_covariance_m2"]),
    )
    solved = solve()
    answer = solved.registration
    stated = answer
    if "tracks" in arguments:
        joint = joint_pose_covariance(context.input(arguments["tracks"]).read_bytes(), names)
        stated = with_joint_pose_covariance(answer, joint)
    components = {name: np.asarray(C, dtype=np.float64)[:6, :6] for name, C in stated.components.items()}
    result: dict[str, Any] = {
        "poses": source,
        "camera": camera.record(),
        "outlines": arguments["outlines"],
        "full_camera": arguments.get("full_camera"),
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
    if source == "hybrid":
        # The spheres are in these poses already: only their adjustment knows how well the scan is placed.
        adjusted = context.input_json(arguments["model"])
        T_scan_world = inverse(np.array(adjusted["T_world_scan"]))
        result |= {key: adjusted[key] for key in ("T_world_scan", "T_world_station")}
        result["T_scan_camera"] = {name: (T_scan_world @ T).tolist() for name, T in zip(names, poses, strict=True)}
        components = {"adjustment": np.array(adjusted["scan_covariance"])[:6, :6], "spheres": components["spheres"]}
    if arguments.get("intrinsics_covariance") is not None:
        uncertain = solve(
            assignments=solved.assignments, intrinsics_covariance=np.array(arguments["intrinsics_covariance"])
        )
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
        "predicted_error_mm": 1e3 * predicted_m,
    }
    result["leave_one_out"] = left_out = _leave_one_out(answer, refined=source == "robot_corrected")
    if left_out is not None:
        measures["leave_one_out_mm"] = left_out["mean_radial_error_mm"]
    ref = context.keep_json({**result, **_residuals(answer, names)}, kind="registration", name=f"{source}.json")
    return JobAnswer(measures, (ref,), result)


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


def _poses(context: JobContext) -> tuple[Array, list[int], list[dict[str, Any]]]:
    """(N, 4, 4) poses in the frame of each image's group, the groups, and the images that have a pose."""
    arguments = context.arguments
    images = arguments["images"]
    if arguments["poses"] in ("robot", "robot_corrected", "spheres"):
        stations = sorted({image["station"] for image in images})
        return robot_camera_poses(arguments, images), [stations.index(image["station"]) for image in images], images
    model = context.input_json(arguments["model"])["T_world_camera"]
    images = [image for image in images if image["viewpoint"] in model]
    return np.array([model[image["viewpoint"]] for image in images]), [0] * len(images), images


def _numbered(names: Iterable[str]) -> list[int]:
    """A number for each name, the same for the same."""
    numbers: dict[str, int] = {}
    return [numbers.setdefault(name, len(numbers)) for name in names]


def _outlines(
    context: JobContext, images: Sequence[dict[str, Any]], camera: CameraModel
) -> list[list[SphereOutline]]:
    found = context.input_json(context.arguments["outlines"])
    return [[outline_from_record(r, camera) for r in found[image["viewpoint"]]] for image in images]


def _station(images: Sequence[dict[str, Any]], groups: Sequence[int], group: int) -> str:
    return next(image["station"] for image, g in zip(images, groups, strict=True) if g == group)


def _residuals(answer: RegistrationResult, names: Sequence[str]) -> dict[str, Any]:
    return {
        "residuals": [
            {"image": names[r.image], "marker": r.marker, "rms_px": r.rms_px, "excluded": r.excluded}
            for r in answer.residuals
        ],
        "chi2_reduced": answer.chi2_reduced,
        "cost": answer.cost,
    }
