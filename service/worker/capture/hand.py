"""Jobs on hand-held images: what one shows, where the camera was, and where it should go next, in words."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board.board import Board, find_board
from service.compute.calibration.intrinsics.estimate import coverage_map_of, locate_view
from service.compute.camera_model import CameraModel
from service.compute.capture.hand_bundle import Reading, adjust_together
from service.compute.capture.hand_view import look_at_image
from service.compute.capture.live import expected_spheres
from service.compute.images.files import read_grey, read_image
from service.compute.markers.detectors import options_for
from service.compute.planning.coverage import CoverageLimits, CoverageSurface, covered_fraction, seen
from service.compute.planning.hand_guidance import (
    Place,
    away_from_plane,
    covered,
    level_frame,
    nearest,
    place_at,
    same_view,
    words,
)
from service.compute.planning.information import predicted_information
from service.compute.planning.next_best_view import Candidate, CurrentInformation, next_best_views
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse
from service.core.units import mm
from service.jobs.capture import hand_board as board_job
from service.jobs.capture import hand_view as view_job
from service.jobs.capture.hand_view import HeldArguments, PlannedPlace
from service.worker.camera import camera_of
from service.worker.capture.live import kept_surface, limits_of
from service.worker.job import JobAnswer, JobContext
from service.worker.surfaces.layout import nominal_camera

_SAME_M, _SAME_RAD = 0.02, np.deg2rad(3.0)  # nearer than this, an image repeats another
_LOST_AFTER = 1  # images in a row, before this one, that do not tell where the camera is
_H = TypeVar("_H", bound=HeldArguments)
AGAIN = "take this one again: hold the camera still, with everything in view and nothing before the lens"
_DENSER_TILTS_DEG, _DENSER_AZIMUTHS_DEG = (10.0, 25.0, 40.0, 48.0), tuple(np.arange(-180.0, 180.0, 30.0))
_TYPICAL_PX = 0.08  # of an outline's place and size, where a view is only planned


@dataclass(frozen=True, slots=True)
class _EarlierImage:
    """An image that was looked at before."""

    viewpoint: str
    used: bool
    T_scene_camera: Transform | None
    T_scene_level: Transform | None
    information: Array = field(repr=False)  # (6, 6)
    seen: NDArray[np.bool_] = field(repr=False)
    cells: NDArray[np.int64] = field(repr=False)
    reading: Mapping[str, Any] | None = field(repr=False)  # outlines and spheres, where nobody has measured these
    spheres_m: Array | None = field(repr=False)  # as this image and those before it tell them


@dataclass(frozen=True, slots=True)
class _NewImage:
    """What the new image itself says."""

    T_scene_camera: Transform | None
    why: str
    measures: Mapping[str, float]
    information: Array = field(repr=False)
    up: Array
    middle_m: Array
    cells: NDArray[np.int64] = field(repr=False)
    spheres_m: Array = field(default_factory=lambda: np.zeros((0, 3)), repr=False)  # none in images of the board
    reading: Reading | None = field(default=None, repr=False)


def hand_view(context: JobContext[view_job.Arguments]) -> JobAnswer:
    """An image of the specimen: pose from the spheres, verdict, coverage, predicted error, way on.

    Spheres that only photographs tell of are rough: they, and every camera, are adjusted to all images together.
    """
    cv2.setNumThreads(1)
    arguments, camera = context.arguments, camera_of(context.arguments.camera)
    name, radius_m, rough = arguments.image.viewpoint, arguments.radius_m, arguments.rough
    surface = kept_surface(context, arguments.surface)
    earlier = _all_earlier(context, surface, camera)
    known = [e.spheres_m for e in earlier if e.spheres_m is not None]
    spheres = known[-1] if known else np.array(arguments.spheres_m)
    pixels = read_image(context.input(arguments.image.sha256))
    options = options_for(arguments.colour)
    view = look_at_image(pixels, camera, spheres, radius_m, options, rough=rough)
    pose, reading = view.T_scene_camera, None
    measures = {
        "outlines": float(view.outlines),
        "spheres_seen": float(view.spheres_seen),
        "spheres_expected": float(view.spheres_expected),
        "edge_width_px": view.edge_px,
        "outline_rms_px": view.rms_px,
        "clipped_fraction": view.clipped,
    }
    if rough:
        good = not (view.why or arguments.image.settings)
        reading = Reading.of(name, pose, view.shown) if pose is not None and good else None
        bundle = adjust_together([*_readings(earlier), *([reading] if reading else [])], spheres, camera, radius_m)
        if bundle is not None:
            spheres, pose = bundle.spheres_m, bundle.poses.get(name, pose)
            earlier = [replace(e, T_scene_camera=bundle.poses.get(e.viewpoint, e.T_scene_camera)) for e in earlier]
            measures["spheres_sigma_mm"] = mm(bundle.sigma_m)
    eye = np.zeros(3) if pose is None else pose[:3, 3]
    information = np.zeros((6, 6)) if view.information is None else view.information.information
    found = _NewImage(
        pose, view.why, measures, information, away_from_plane(spheres, eye), spheres.mean(axis=0),
        np.zeros((0, 0), dtype=np.int64), spheres, reading,
    )  # fmt: skip
    return _answer(context, found, camera, surface, earlier)


def _all_earlier(
    context: JobContext[_H], surface: CoverageSurface | None, camera: CameraModel | None = None
) -> list[_EarlierImage]:
    return [_read(context, sha256, surface, camera) for sha256 in context.arguments.earlier]


def _readings(earlier: Sequence[_EarlierImage]) -> list[Reading]:
    return [
        Reading.read(e.viewpoint, e.T_scene_camera, e.reading)
        for e in earlier
        if e.used and e.reading is not None and e.T_scene_camera is not None
    ]


def hand_board(context: JobContext[board_job.Arguments]) -> JobAnswer:
    """An image of the calibration board: pose from the board by the nominal lens, verdict, coverage, way on."""
    cv2.setNumThreads(1)
    arguments = context.arguments
    image = arguments.image
    board = Board(arguments.columns, arguments.rows, arguments.square_m)
    grey = read_grey(context.input(image.sha256))
    size = (grey.shape[1], grey.shape[0])
    camera = nominal_camera(*size, image.focal_mm, arguments.sensor_width_mm)
    middle = board.points().mean(axis=0)
    pose, why, measures, cells = None, "", {}, np.zeros((0, 0), dtype=np.int64)
    try:
        corners = find_board(grey, board)
        T_camera_board, rms_px = locate_view(corners, board, camera)
    except ComputeError as error:
        why = error.what
    else:
        pose, cells = inverse(T_camera_board), coverage_map_of([corners.corners], size)
        measures = {"corners": float(len(corners.indices)), "nominal_rms_px": rms_px}
    up = np.array([0.0, 0.0, -1.0])  # the board's z points into the table
    found = _NewImage(pose, why, measures, np.zeros((6, 6)), up, middle, cells)
    return _answer(context, found, camera, None, _all_earlier(context, None))


def _answer(
    context: JobContext[_H],
    found: _NewImage,
    camera: CameraModel,
    surface: CoverageSurface | None,
    earlier: Sequence[_EarlierImage],
) -> JobAnswer:
    """The verdict on the image among those before it, what all of them come to, and where to go next."""
    arguments = context.arguments
    image = arguments.image
    used = [e for e in earlier if e.used and e.T_scene_camera is not None]
    T = found.T_scene_camera
    why = image.settings or found.why or _repeats(T, used)
    level = next((e.T_scene_level for e in earlier if e.T_scene_level is not None), None)
    if level is None and T is not None:
        level = level_frame(found.middle_m, found.up, -T[:3, 1])
    visible = _visible(limits_of(arguments.limits), surface, T, camera)
    reading = None if found.reading is None else found.reading.record()
    mine = _EarlierImage(
        image.viewpoint, not why, T, level, found.information, visible, found.cells, reading, found.spheres_m
    )
    good = [*used, mine] if mine.used and T is not None else used
    places = _places(arguments.places)
    poses = [] if level is None else [inverse(level) @ e.T_scene_camera for e in good if e.T_scene_camera is not None]
    done = covered(places, poses, arguments.within_deg)
    measures = {**found.measures, "images_used": float(len(good)), "hemisphere_coverage": len(done) / len(places)}
    measures |= _totals(arguments, good, found.spheres_m, surface)
    next_words, target = _way_on(arguments, mine, earlier, good, places, done, surface, camera)
    record = {
        "viewpoint": mine.viewpoint,
        "used": mine.used,
        "T_scene_camera": None if T is None else T.tolist(),
        "T_scene_level": None if level is None else level.tolist(),
        "information": found.information.tolist(),
        "seen": base64.b64encode(np.packbits(visible).tobytes()).decode(),
        "cells": found.cells.tolist(),
    }
    rough: dict[str, Any] = {}
    if arguments.rough:
        record |= {"reading": reading, "spheres_m": found.spheres_m.tolist()}
        poses = {e.viewpoint: e.T_scene_camera.tolist() for e in [*used, mine] if e.T_scene_camera is not None}
        rough = {"spheres_m": record["spheres_m"], "T_scene_cameras": poses}
    ref = context.keep_json(record, kind="hand_view", name=f"{mine.viewpoint}.hand.json")
    result = {
        "viewpoint": mine.viewpoint,
        "used": mine.used,
        "why": why,
        "words": next_words,
        "target": None if target is None else _listed(target),
        "T_scene_camera": record["T_scene_camera"],
        "T_level_camera": None if T is None or level is None else (inverse(level) @ T).tolist(),
        "places": [{**_listed(p), "done": p.name in done} for p in places],
        "cells": np.sum([e.cells for e in good if e.cells.size], axis=0).tolist() if found.cells.size else [],
        **rough,
    }
    answer = view_job.Answer.model_validate(result)
    return JobAnswer({k: v for k, v in measures.items() if np.isfinite(v)}, (ref,), answer)


def _listed(place: Place) -> dict[str, Any]:
    return {"name": place.name, "T_level_camera": place.T_level_camera.tolist()}


def _repeats(T: Transform | None, used: Sequence[_EarlierImage]) -> str:
    if T is None:
        return ""
    same = [e.viewpoint for e in used if e.T_scene_camera is not None and _same(e.T_scene_camera, T)]
    return f"it repeats {same[0]}" if same else ""


def _same(a: Transform, b: Transform) -> bool:
    return same_view(a, b, _SAME_M, _SAME_RAD)


def _totals(
    arguments: HeldArguments, good: Sequence[_EarlierImage], spheres: Array, surface: CoverageSurface | None
) -> dict[str, float]:
    """What the used images come to."""
    if not isinstance(arguments, view_job.Arguments) or not len(spheres):
        cells = [e.cells for e in good if e.cells.size]
        return {"coverage": float(np.mean(np.sum(cells, axis=0) > 0)) if cells else 0.0}
    measures: dict[str, float] = {}
    present = _present(arguments, good, spheres, surface)
    error_m = present.error_m()
    if np.isfinite(error_m):
        measures["predicted_target_error_mm"] = mm(error_m)
    if surface is not None:
        measures["specimen_coverage"] = covered_fraction([e.seen for e in good], present.min_views)
    return measures


def _present(
    arguments: view_job.Arguments, good: Sequence[_EarlierImage], spheres: Array, surface: CoverageSurface | None
) -> CurrentInformation:
    """The images as measurements of the scan's pose, whose cameras structure from motion will place."""
    sigma_m, sigma_rad = arguments.pose_sigma_m, arguments.pose_sigma_rad
    targets = spheres if surface is None else surface.points_m[:: max(1, len(surface.points_m) // 200)]
    points = 0 if surface is None else len(surface.points_m)
    seen_by = np.array([e.seen for e in good], dtype=np.int64).reshape(len(good), points)
    return CurrentInformation(
        tuple(e.information for e in good),
        np.diag([sigma_m**2 / 3] * 3 + [sigma_rad**2 / 3] * 3),
        targets - spheres.mean(axis=0),
        seen_by.sum(axis=0),
        arguments.limits.min_views,
    )


def _way_on(
    arguments: HeldArguments,
    mine: _EarlierImage,
    earlier: Sequence[_EarlierImage],
    good: Sequence[_EarlierImage],
    places: Sequence[Place],
    done: set[str],
    surface: CoverageSurface | None,
    camera: CameraModel,
) -> tuple[str, Place | None]:
    """Words that lead to the next place, and the place; the first words again for a camera that got lost."""
    if mine.T_scene_camera is None or mine.T_scene_level is None:
        lost = 0
        for view in reversed(earlier):
            if view.T_scene_camera is not None:
                break
            lost += 1
        return (arguments.first_words if lost >= _LOST_AFTER else AGAIN), None
    here = inverse(mine.T_scene_level) @ mine.T_scene_camera
    left = [place for place in places if place.name not in done]
    target = nearest(left, here) if left else None
    spheres = mine.spheres_m
    if target is None and isinstance(arguments, view_job.Arguments) and spheres is not None and len(spheres):
        target = _informative(arguments, mine.T_scene_level, good, spheres, surface, camera)
    if target is None:
        target = max(places, key=lambda place: float(np.linalg.norm(place.T_level_camera[:3, 3] - here[:3, 3])))
    return words(here, target.T_level_camera) or "stay there and take it again", target


def _informative(
    arguments: view_job.Arguments,
    T_scene_level: Transform,
    good: Sequence[_EarlierImage],
    spheres: Array,
    surface: CoverageSurface | None,
    camera: CameraModel,
) -> Place | None:
    """Of a denser hemisphere, the view that helps most once every planned place has its image."""
    radius_m, limits = arguments.radius_m, limits_of(arguments.limits)
    taken = [inverse(T_scene_level) @ e.T_scene_camera for e in good if e.T_scene_camera is not None]
    distance_m = float(np.median([spot.distance_m for spot in arguments.places]))
    places: dict[str, Place] = {}
    candidates: list[Candidate] = []
    typical = (_TYPICAL_PX / camera.fx) ** 2 * np.eye(3)
    for tilt in _DENSER_TILTS_DEG:
        for azimuth in _DENSER_AZIMUTHS_DEG:
            name = f"t{tilt:02.0f}{azimuth:+04.0f}"
            place = place_at(
                name,
                tilt_deg=tilt,
                azimuth_deg=azimuth,
                distance_m=distance_m,
                walk_round=True,
                aim_m=(0.0, 0.0, 0.0),
            )
            if covered([place], taken, 8.0):
                continue
            T = T_scene_level @ place.T_level_camera
            visible = expected_spheres(inverse(T), spheres, radius_m, camera)
            mask = np.zeros(0, dtype=bool) if surface is None else seen(surface, T[:3, 3], limits, T, camera)
            information = predicted_information(T, spheres[visible], radius_m, spheres.mean(axis=0), typical)
            candidates.append(Candidate(name, information, mask))
            places[name] = place
    found = next_best_views(
        _present(arguments, good, spheres, surface),
        candidates,
        limit_m=arguments.limit_m,
        min_coverage=arguments.min_coverage,
        at_most=1,
    )
    return places[found[0].name] if found else None


def _places(listed: Sequence[PlannedPlace]) -> list[Place]:
    return [
        place_at(
            spot.name,
            tilt_deg=spot.tilt_deg,
            azimuth_deg=spot.azimuth_deg,
            distance_m=spot.distance_m,
            walk_round=spot.walk_round,
            aim_m=spot.aim_m,
        )
        for spot in listed
    ]


def _visible(
    limits: CoverageLimits, surface: CoverageSurface | None, T: Transform | None, camera: CameraModel
) -> NDArray[np.bool_]:
    if surface is None or T is None:
        return np.zeros(0 if surface is None else len(surface.points_m), dtype=bool)
    return seen(surface, T[:3, 3], limits, T, camera)


def _read(
    context: JobContext[_H], sha256: str, surface: CoverageSurface | None, camera: CameraModel | None
) -> _EarlierImage:
    data = context.input_json(sha256)
    points = 0 if surface is None else len(surface.points_m)
    bits = np.unpackbits(np.frombuffer(base64.b64decode(data["seen"]), np.uint8))
    T, level = (None if data[key] is None else np.array(data[key]) for key in ("T_scene_camera", "T_scene_level"))
    visible = bits[:points].astype(bool)
    if len(bits) < points and camera is not None:  # looked at before the surface was ready
        visible = _visible(limits_of(context.arguments.limits), surface, T, camera)
    cells = np.array(data["cells"], dtype=np.int64)
    spheres = None if data.get("spheres_m") is None else np.array(data["spheres_m"])
    return _EarlierImage(
        data["viewpoint"], bool(data["used"]), T, level, np.array(data["information"]), visible, cells,
        data.get("reading"), spheres,
    )  # fmt: skip
