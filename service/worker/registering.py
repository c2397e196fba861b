"""Jobs on markers: detect their outlines, register the scan with one source of poses, evaluate on control spheres."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.images import read_image
from service.compute.markers.archive import outline_from_record, outline_record
from service.compute.markers.records import SphereOutline
from service.compute.overlay import draw_overlay
from service.compute.pipeline import CONTROL_GATE, CONTROL_SIZE_GATE, Detection, locate_outlines, register_images
from service.compute.registration.evaluation import evaluate as evaluate_controls
from service.compute.registration.hypotheses import match, sightings
from service.compute.registration.identity import Assignment
from service.compute.registration.solve import RegistrationResult
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse
from service.core.model import ArtefactRef
from service.worker.job import JobAnswer, JobContext
from service.worker.robot_poses import robot_camera_poses


def detect_spheres(context: JobContext) -> JobAnswer:
    """Outlines of every sphere in every image, as one artefact that all registrations share.

    The robot's poses tell where to look; where they are too far off, the images are searched whole.
    """
    images = context.arguments["images"]
    files = [context.input(image["sha256"]) for image in images]
    located = locate_outlines(
        files,
        context.camera(),
        robot_camera_poses(context.arguments, images),
        np.array(context.arguments["spheres_m"]),
        float(context.arguments["radius_m"]),
        groups=_numbered(image["station"] for image in images),
        scenes=_numbered(image["step"] for image in images),
        workers=min(len(files), os.cpu_count() or 1),
        progress=lambda done, total: context.progress("spheres in images", done, total),
    )
    records = [[outline_record(outline) for outline in found] for found in located.outlines]
    found = dict(zip((image["viewpoint"] for image in images), records, strict=True))
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
    metric = source in ("robot", "hybrid")
    solved = register_images(
        outlines, poses, camera, spheres, radius_m, groups=groups, estimate_scale=not metric, names=names
    )
    answer = solved.registration
    centre = spheres.mean(axis=0)
    measures = {
        "rms_px": answer.rms_px,
        "markers": float(len(solved.markers)),
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
        "T_world_station": {_station(images, groups, g): T.tolist() for g, T in answer.T_world_group.items()},
        "T_scan_camera": {
            name: T.tolist() for name, T in zip(names, answer.T_scan_camera, strict=True) if np.isfinite(T).all()
        },
        "excluded": [f"{names[r.image]}, sphere {r.marker}: {r.reason}" for r in answer.excluded],
    }
    if source == "hybrid":
        # The spheres are in these poses already: only their adjustment knows how well the scan is placed.
        adjusted = context.input_json(arguments["model"])
        measures["predicted_error_mm"] = adjusted["predicted_error_mm"]
        T_scan_world = inverse(np.array(adjusted["T_world_scan"]))
        result |= {key: adjusted[key] for key in ("T_world_scan", "T_world_station")}
        result["covariance"] = adjusted["scan_covariance"]
        result["T_scan_camera"] = {name: (T_scan_world @ T).tolist() for name, T in zip(names, poses, strict=True)}
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
    refs: list[ArtefactRef] = []
    pictures: dict[str, Callable[[], list[ArtefactRef]]] = {}
    for source, registration in arguments["registrations"].items():
        cameras = registration["T_scan_camera"]
        seen = [i for i, image in enumerate(images) if image["viewpoint"] in cameras]
        T_scan_camera = np.array([cameras[images[i]["viewpoint"]] for i in seen])
        mine = [outlines[i] for i in seen]
        assignments = [
            _controls(o, T, spheres, controls, radius_m, camera) for o, T in zip(mine, T_scan_camera, strict=True)
        ]
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
        pictures[source] = partial(
            _overlays, context, [images[i] for i in seen], source, mine, T_scan_camera, spheres, controls
        )
    best = min(table, key=lambda row: row["mean_radial_error_mm"])
    # The best source, and beside it the robot's own poses: the eye sees the difference.
    for source in dict.fromkeys((best["poses"], "robot")):
        refs += pictures[source]() if source in pictures else []
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


def _controls(
    outlines: Sequence[SphereOutline],
    T_scan_camera: Array,
    spheres: Array,
    controls: Array,
    radius_m: float,
    camera: CameraModel,
) -> Assignment:
    """Which outlines are control spheres: those that the registration predicts there, and no registration sphere."""
    centres = apply(inverse(T_scan_camera), np.vstack([spheres, controls]))
    pairs = match(sightings(outlines, radius_m, camera), centres, radius_m, CONTROL_GATE, CONTROL_SIZE_GATE)
    markers = {outline: marker - len(spheres) for outline, marker, _ in pairs if marker >= len(spheres)}
    return Assignment(markers, inverse(T_scan_camera))


def _overlays(
    context: JobContext,
    images: Sequence[dict[str, Any]],
    source: str,
    outlines: Sequence[Sequence[SphereOutline]],
    T_scan_camera: Array,
    spheres: Array,
    controls: Array,
) -> list[ArtefactRef]:
    """Pictures of one image a station, with detected and predicted outlines drawn over it."""
    camera, radius_m = context.camera(), float(context.arguments["radius_m"])
    first: dict[str, int] = {}
    for i, image in enumerate(images):
        first.setdefault(image["station"], i)
    refs: list[ArtefactRef] = []
    for i in first.values():
        centres = apply(inverse(T_scan_camera[i]), np.vstack([spheres, controls]))
        pairs = match(sightings(outlines[i], radius_m, camera), centres, radius_m, CONTROL_GATE, CONTROL_SIZE_GATE)
        marker = {outline: m for outline, m, _ in pairs}
        detections = [
            Detection(
                outline,
                m if m is not None and m < len(spheres) else None,
                m - len(spheres) if m is not None and m >= len(spheres) else None,
                None,
            )
            for outline, m in ((o, marker.get(j)) for j, o in enumerate(outlines[i]))
        ]
        picture = draw_overlay(
            read_image(context.input(images[i]["sha256"])),
            camera,
            detections,
            T_scan_camera=T_scan_camera[i],
            registration_centres_m=spheres,
            control_centres_m=controls,
            radius_m=radius_m,
        )
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
        name = f"{source}_{images[i]['viewpoint']}.jpg"
        refs.append(context.keep_bytes(jpeg, kind="overlay", media_type="image/jpeg", name=name))
    return refs
