"""Jobs on markers: detect their outlines, register the scan with one source of poses, evaluate on control spheres."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.constellations import match_constellations
from service.compute.markers.archive import outline_from_record, outline_record
from service.compute.markers.detect import detect_spheres as detect_in_image
from service.compute.markers.records import SphereOutline
from service.compute.overlay import draw_overlay
from service.compute.photograph import read_photograph
from service.compute.registration.control import assign_controls
from service.compute.registration.evaluation import evaluate as evaluate_controls
from service.compute.registration.identity import identify
from service.compute.registration.solve import RegistrationResult, register as solve_registration
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse
from service.worker.job import JobAnswer, JobContext


def detect_spheres(context: JobContext) -> JobAnswer:
    """Outlines of every sphere in every image, as one artefact that all registrations share."""
    camera = context.camera()
    images = context.arguments["images"]
    tasks = [(context.input(image["sha256"]), camera) for image in images]
    found: dict[str, list[dict[str, Any]]] = {}
    workers = min(len(tasks), os.cpu_count() or 1)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for i, (image, outlines) in enumerate(zip(images, pool.map(_detect, tasks), strict=True)):
            found[image["viewpoint"]] = outlines
            context.progress("spheres in images", i + 1, len(images))
    total = sum(map(len, found.values()))
    ref = context.keep_json(found, kind="outlines", name="outlines.json")
    return JobAnswer({"outlines": float(total), "outlines_an_image": total / len(images)}, (ref,))


def _detect(task: tuple[Path, CameraModel]) -> list[dict[str, Any]]:
    path, camera = task
    cv2.setNumThreads(1)  # the pool already uses every core
    return [outline_record(outline) for outline in detect_in_image(read_photograph(path), camera)]


def register(context: JobContext) -> JobAnswer:
    """T_world_scan for one source of poses. With robot poses every station has a base frame of its own."""
    arguments = context.arguments
    camera, source = context.camera(), arguments["poses"]
    poses, groups, images = _poses(context)
    outlines = _outlines(context, images, camera)
    spheres = np.array(arguments["spheres_m"])
    radius_m = float(arguments["radius_m"])
    names = [image["viewpoint"] for image in images]
    robot = source == "robot"
    assignments = identify(
        outlines, spheres, camera, poses, radius_m=radius_m, groups=groups, metric=robot, names=names
    )
    answer = solve_registration(
        outlines, assignments, poses, groups, spheres, radius_m, camera, estimate_scale=not robot
    )
    centre = spheres.mean(axis=0)
    measures = {
        "rms_px": answer.rms_px,
        "markers": float(len({r.marker for r in answer.residuals if not r.excluded})),
        "images": float(answer.n_images),
        "excluded_outlines": float(len(answer.excluded)),
        "predicted_error_mm": 1e3 * answer.sigma_at_m(centre),
    }
    result = {
        "poses": source,
        "T_world_scan": answer.T_world_scan.tolist(),
        "scale": answer.scale,
        "covariance": answer.covariance.tolist(),
        "rms_px": answer.rms_px,
        "T_world_station": {
            _station(images, groups, g): T.tolist() for g, T in answer.T_world_group.items()
        },
        "T_scan_camera": {
            name: T.tolist() for name, T in zip(names, answer.T_scan_camera, strict=True) if np.isfinite(T).all()
        },
        "excluded": [f"{names[r.image]}, sphere {r.marker}: {r.reason}" for r in answer.excluded],
    }
    ref = context.keep_json({**result, **_residuals(answer, names)}, kind="registration", name=f"{source}.json")
    return JobAnswer(measures, (ref,), result)


def evaluate(context: JobContext) -> JobAnswer:
    """The paper's table: errors on the control spheres, which took no part in the registration."""
    arguments = context.arguments
    camera, radius_m = context.camera(), float(arguments["radius_m"])
    images = arguments["images"]
    outlines = _outlines(context, images, camera)
    spheres = np.array(arguments["spheres_m"])
    both = np.array(arguments["control_scan_spheres_m"])
    match = match_constellations(spheres, both)
    controls = apply(match.T_a_b, both[list(match.missing_b)])
    if not len(controls):
        raise ComputeError("the control scan shows no sphere beside the registration spheres")
    table: list[dict[str, Any]] = []
    refs = []
    for source, registration in arguments["registrations"].items():
        cameras = registration["T_scan_camera"]
        seen = [i for i, image in enumerate(images) if image["viewpoint"] in cameras]
        T_scan_camera = np.array([cameras[images[i]["viewpoint"]] for i in seen])
        mine = [outlines[i] for i in seen]
        assignments = assign_controls(mine, T_scan_camera, controls, radius_m, camera, others_m=spheres)
        answer = evaluate_controls(mine, assignments, T_scan_camera, controls, radius_m, camera)
        table.append(
            {
                "poses": source,
                "mean_radial_error_mm": answer.mean_radial_error_mm,
                "mean_reprojection_error_px": answer.mean_reprojection_error_px,
                "control_outlines": len(answer.errors),
                "images": len(seen),
            }
        )
        if source != "robot":
            refs += _overlays(context, images, seen, source, T_scan_camera, np.vstack([spheres, controls]))
    best = min(table, key=lambda row: row["mean_radial_error_mm"])
    measures = {f"{row['poses']}_mean_radial_error_mm": row["mean_radial_error_mm"] for row in table}
    measures |= {f"{row['poses']}_mean_reprojection_error_px": row["mean_reprojection_error_px"] for row in table}
    measures["best_mean_radial_error_mm"] = best["mean_radial_error_mm"]
    measures["control_spheres"] = float(len(controls))
    refs.append(context.keep_json(table, kind="evaluation", name="evaluation.json"))
    return JobAnswer(measures, tuple(refs), {"table": table})


def _poses(context: JobContext) -> tuple[Array, list[int], list[dict[str, Any]]]:
    """(N, 4, 4) poses in the frame of each image's group, the groups, and the images that have a pose."""
    arguments = context.arguments
    images = arguments["images"]
    if arguments["poses"] == "robot":
        T_flange_camera = np.array(arguments["T_flange_camera"])
        stations = sorted({image["station"] for image in images})
        poses = np.array([np.array(image["T_base_flange"]) @ T_flange_camera for image in images])
        return poses, [stations.index(image["station"]) for image in images], images
    model = context.input_json(arguments["model"])["T_world_camera"]
    images = [image for image in images if image["viewpoint"] in model]
    return np.array([model[image["viewpoint"]] for image in images]), [0] * len(images), images


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


def _overlays(
    context: JobContext,
    images: Sequence[dict[str, Any]],
    seen: Sequence[int],
    source: str,
    T_scan_camera: Array,
    spheres_m: Array,
) -> list[Any]:
    """Pictures of two images, one a station, with the registered spheres drawn over them."""
    camera, radius_m = context.camera(), float(context.arguments["radius_m"])
    stations: dict[str, int] = {}
    for k, i in enumerate(seen):
        stations.setdefault(images[i]["station"], k)
    refs = []
    for k in stations.values():
        image = images[seen[k]]
        picture = draw_overlay(
            read_photograph(context.input(image["sha256"])),
            _outlines(context, [image], camera)[0],
            apply(inverse(T_scan_camera[k]), spheres_m),
            radius_m,
            camera,
        )
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
        name = f"{source}_{image['viewpoint']}.jpg"
        refs.append(context.keep_bytes(jpeg, kind="overlay", media_type="image/jpeg", name=name))
    return refs
