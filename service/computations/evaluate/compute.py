"""Job `evaluate`: the paper's errors on the control spheres, and the error budget, for every registration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import cv2
import numpy as np

from service.computations import evaluate as job
from service.computations.conversion import camera_of
from service.computations.inputs import photographs_at, read_outlines
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Hash, PosedPhotograph, SpheresFound
from service.computations.registration import Registration
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.images.resample import resample
from service.compute.markers.cones import Cone
from service.compute.markers.detect import options_for
from service.compute.markers.image_files import search_nearby
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import INTRINSICS, Detection, draw_overlay
from service.compute.registration.accuracy import (
    CONTROL_SPHERES,
    Alignment,
    ErrorBudget,
    MeasuredSpheres,
    Observation,
    compare_shapes,
    contributions,
    control_observation,
    locate_in_images,
    loop_observations,
)
from service.compute.registration.contradictions import UNEXPLAINED
from service.compute.registration.control_spheres import ControlEvaluation, ExpectedNearby, evaluate_controls
from service.compute.registration.hypotheses import CONTROL_GATE, paired
from service.compute.registration.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse
from service.core.records.base import ArtefactRef
from service.core.units import metres, mm
from service.machine.resources import IMAGE_MB, processes_for

_COMMON = ("common", INTRINSICS, UNEXPLAINED)  # components that move all spheres equally


@dataclass(frozen=True, slots=True)
class _ScanAndCtSpheres:
    """The spheres as scanner and CT measured them, in the frame of the registered scan."""

    scan: MeasuredSpheres
    control: MeasuredSpheres
    ct: MeasuredSpheres | None  # in its own frame; one row for each sphere of the scan, NaN if it is missing


@dataclass(frozen=True, slots=True)
class _Registered:
    """One registration, with the images that have a pose in it."""

    name: str
    record: Registration
    camera: CameraModel
    images: Sequence[PosedPhotograph]
    outlines: Sequence[Sequence[SphereOutline]]
    T_scan_camera: Array
    markers: Sequence[Assignment]
    controls: ControlEvaluation


def evaluate(context: JobContext[job.Arguments]) -> JobAnswer:
    """Evaluate each registration on the control spheres, which it did not use; one row of the table for each."""
    arguments = context.arguments
    measured = _measured(arguments)
    radius_m = arguments.radius_m
    table: list[job.Row] = []
    budgets: dict[str, job.ErrorBudget] = {}
    pictures: dict[str, Callable[[], list[ArtefactRef]]] = {}
    read = cache(context.input_json)  # registrations share their file of outlines
    searched = _Searched(context)
    controls: dict[str, ControlEvaluation] = {}
    for name, record in arguments.registrations.items():
        registered = _registered(arguments, name, record, measured, read, searched)
        controls[name] = registered.controls
        budget = _budget(registered, measured, radius_m)
        budgets[name] = budget_record(budget)
        table.append(_row(registered, budget, _errors(registered, measured)))
        pictures[name] = partial(_overlays, context, registered, measured, radius_m)
    best = job.best_row(table)
    # Overlays of the best source and of the reported robot poses, to show the difference.
    refs = [ref for name in dict.fromkeys((best.poses, "robot")) if name in pictures for ref in pictures[name]()]
    numbers: dict[str, float | None] = {
        f"{row.poses}_mean_radial_error_mm": row.mean_radial_error_mm for row in table
    }
    numbers |= {f"{row.poses}_mean_reprojection_error_px": row.mean_reprojection_error_px for row in table}
    numbers["best_mean_radial_error_mm"] = best.mean_radial_error_mm
    numbers["best_predicted_error_mm"] = best.predicted_error_mm
    numbers["control_normalised_chi2"] = best.control_normalised_chi2
    measures = {name: number for name, number in numbers.items() if number is not None}
    measures |= controls[best.poses].measures() if len(measured.control.centres_m) else {"control_spheres": 0.0}
    answer = job.Answer(table=tuple(table), budgets=budgets)
    refs.append(context.keep_json(answer.plain()["table"], kind="evaluation", name="evaluation.json"))
    refs.append(context.keep_json(answer.plain()["budgets"], kind="error_budget", name="error_budget.json"))
    return JobAnswer(measures, tuple(refs), answer)


def budget_record(budget: ErrorBudget) -> job.ErrorBudget:
    """Return the record of an error budget, in millimetres."""
    return job.ErrorBudget(
        contributions=tuple(
            job.Contribution(name=c.name, sigma_mm=mm(c.sigma_m), how=c.how, counted=c.counted)
            for c in budget.contributions
        ),
        total_mm=mm(budget.total_m),
        observations=tuple(
            job.Observation(
                name=o.name,
                observed_mm=mm(o.observed_m),
                predicted_mm=mm(o.predicted_m),
                normalised_chi2=o.normalised_chi2,
                n=o.n,
                how=o.how,
                verdict=o.verdict,
            )
            for o in budget.observations
        ),
    )


def _row(registered: _Registered, budget: ErrorBudget, errors: _Errors) -> job.Row:
    control = next((o for o in budget.observations if o.name == CONTROL_SPHERES), None)
    registration = [c.sigma_m for c in budget.contributions if c.counted and c.name != "scan"]
    return job.Row(
        poses=registered.name,
        source=registered.record.poses,
        resolution=f"{registered.camera.width} × {registered.camera.height}",
        images=len(registered.images),
        predicted_error_mm=mm(float(np.sqrt(np.sum(np.square(registration))))),
        control_error_mm=None if control is None else mm(control.observed_m),
        control_normalised_chi2=None if control is None else control.normalised_chi2,
        mean_radial_error_mm=errors.mean_radial_mm,
        mean_reprojection_error_px=errors.mean_reprojection_px,
        evaluated_on=errors.evaluated_on,
        control_outlines=errors.control_outlines,
        control_spheres=registered.controls.spheres,
    )


@dataclass(frozen=True, slots=True)
class _Errors:
    """The paper's two errors, and what they were evaluated on."""

    mean_radial_mm: float
    mean_reprojection_px: float
    evaluated_on: str
    control_outlines: int


def _errors(registered: _Registered, measured: _ScanAndCtSpheres) -> _Errors:
    """Return the paper's two errors: on the control spheres or, without any, on each sphere predicted from others."""
    if not len(measured.control.centres_m):
        left_out = registered.record.leave_one_out
        if left_out is None:
            raise ComputeError(
                "there are no control spheres, and too few registration spheres to predict one from the others",
                remedy="Place control spheres, or more registration spheres",
            )
        return _Errors(left_out.mean_radial_error_mm, left_out.mean_reprojection_error_px, "each sphere left out", 0)
    answer = registered.controls.means
    if answer is None:
        raise ComputeError(
            f"no control sphere was found in any image; {'; '.join(registered.controls.findings)}",
            where=registered.name,
            remedy="Capture control images before the spheres are removed, and check the control scan",
        )
    return _Errors(
        answer.mean_radial_error_mm, answer.mean_reprojection_error_px, "control spheres", len(answer.errors)
    )


def _measured(arguments: job.Arguments) -> _ScanAndCtSpheres:
    """Match scan, control scan and CT by their spheres."""
    scan = _spheres(arguments.scan)
    control = _control(scan, arguments.control_scan)
    if arguments.ct is None:
        return _ScanAndCtSpheres(scan, control, None)
    ct = _spheres(arguments.ct)
    shared = match_constellations(scan.centres_m, ct.centres_m).pairs
    centres, covariance = np.full_like(scan.centres_m, np.nan), np.zeros((len(scan.centres_m), 3, 3))
    for a, b in shared:
        centres[a], covariance[a] = ct.centres_m[b], ct.covariance_m2[b]
    return _ScanAndCtSpheres(scan, control, MeasuredSpheres(centres, covariance, ct.surface_rms_m))


def _control(scan: MeasuredSpheres, control_scan: SpheresFound | None) -> MeasuredSpheres:
    """Return the control spheres in the frame of the registered scan; none without a control scan."""
    if control_scan is None:
        return MeasuredSpheres(np.zeros((0, 3)), np.zeros((0, 3, 3)), 0.0)
    both = _spheres(control_scan)
    found = match_constellations(scan.centres_m, both.centres_m)
    pairs = np.array(found.pairs)
    here, there = pairs[:, 0], pairs[:, 1]
    _, alignment = compare_shapes(
        scan.centres_m[here], scan.covariance_m2[here], both.centres_m[there], both.covariance_m2[there]
    )
    extra = list(found.missing_b)
    if not extra:
        raise ComputeError("the control scan shows no sphere except the registration spheres")
    R = alignment.T_a_b[:3, :3]
    return MeasuredSpheres(
        apply(alignment.T_a_b, both.centres_m[extra]),
        R @ both.covariance_m2[extra] @ R.T + alignment.covariance_at_m2(both.centres_m[extra]),
        both.surface_rms_m,
    )


def _spheres(found: SpheresFound) -> MeasuredSpheres:
    records = found.details.spheres
    rms_m = [metres(record.rms_mm) for record in records]
    return MeasuredSpheres(
        np.array([record.centre_m for record in records]),
        np.array([record.covariance_m2 for record in records]),
        float(np.sqrt(np.mean(np.square(rms_m)))),
    )


def _registered(
    arguments: job.Arguments,
    name: str,
    record: Registration,
    measured: _ScanAndCtSpheres,
    read: Callable[[Hash], Any],
    searched: _Searched,
) -> _Registered:
    camera = camera_of(record.camera)
    cameras = record.T_scan_camera
    images = [image for image in arguments.images if image.viewpoint in cameras]
    if not images:
        raise ComputeError(f"registration {name!r} has a pose for none of the control images")
    outlines = read_outlines(read, record.outlines, images, camera)
    T_scan_camera = np.array([cameras[image.viewpoint] for image in images])
    found = [
        paired(mine, inverse(T), measured.scan.centres_m, arguments.radius_m, camera, CONTROL_GATE)
        for mine, T in zip(outlines, T_scan_camera, strict=True)
    ]
    markers = [Assignment(pairs, inverse(T)) for pairs, T in zip(found, T_scan_camera, strict=True)]
    steps = sorted({image.step for image in images})
    controls = evaluate_controls(
        outlines,
        markers,
        PosedImages(T_scan_camera, camera),
        ScanSpheres(measured.scan.centres_m, arguments.radius_m, control_m=measured.control.centres_m),
        captures=[steps.index(image.step) for image in images],
        search=partial(searched.around, images, camera, record),
    )
    return _Registered(name, record, camera, images, controls.outlines, T_scan_camera, markers, controls)


class _Searched:
    """The findings of searches around control spheres in the photographs, which registrations share."""

    def __init__(self, context: JobContext[job.Arguments]) -> None:
        self._context = context
        self._known: dict[tuple[str, int], list[tuple[Cone, float, tuple[SphereOutline, ...]]]] = {}

    def around(
        self, images: Sequence[PosedPhotograph], camera: CameraModel, record: Registration, expected: ExpectedNearby
    ) -> list[tuple[SphereOutline, ...]]:
        """Return the outlines in images, by index, around cones; read only photographs not searched there before."""
        new: list[tuple[int, list[tuple[Cone, float]]]] = []
        for i, around in expected:
            known = self._known.setdefault((images[i].viewpoint, camera.width), [])
            lacking = [one for one in around if not any(_covers(entry, *one) for entry in known)]
            if lacking:
                new.append((i, lacking))
        if new:
            context = self._context
            full = None if record.full_camera is None else camera_of(record.full_camera)
            files = photographs_at(context, [images[i] for i, _ in new], camera, full)
            tasks = [(file, lacking) for file, (_, lacking) in zip(files, new, strict=True)]
            found = search_nearby(
                tasks,
                camera,
                options_for(context.arguments.colour),
                processes_for(len(tasks), IMAGE_MB),
                lambda done, total: context.progress("control spheres", done, total),
            )
            for (i, lacking), outlines in zip(new, found, strict=True):
                known = self._known[images[i].viewpoint, camera.width]
                known += [(cone, window_rad, outlines) for cone, window_rad in lacking]
        return [
            tuple(o for _, _, outlines in self._known[images[i].viewpoint, camera.width] for o in outlines)
            for i, _ in expected
        ]


def _covers(entry: tuple[Cone, float, tuple[SphereOutline, ...]], cone: Cone, window_rad: float) -> bool:
    """Return whether an earlier search looked wherever one around a cone would."""
    there, wide_rad, _ = entry
    return window_rad + float(np.linalg.norm(there.axis - cone.axis)) < 1.2 * wide_rad


def _budget(registered: _Registered, measured: _ScanAndCtSpheres, radius_m: float) -> ErrorBudget:
    """Return the error budget at the centre of the control spheres, which is the middle of the anatomy."""
    record = registered.record
    T_world_scan = np.array(record.T_world_scan)
    target = (measured.control if len(measured.control.centres_m) else measured.scan).centres_m.mean(axis=0)
    components = {
        name: Alignment(T_world_scan, np.array(covariance)[:6, :6]) for name, covariance in record.components.items()
    }
    sigma_m = {
        name: float(np.sqrt(np.trace(component.covariance_at_m2(target[None])[0])))
        for name, component in components.items()
    }
    # To locate a sphere takes three images; with fewer control images, two have to suffice.
    least = min(3, len(registered.images))
    controls = {s: one for s, one in registered.controls.located.items() if one.n_images >= least}
    observations: list[Observation] = []
    if controls:
        own = [c.covariance for name, c in components.items() if name not in _COMMON] or [np.zeros((6, 6))]
        placed = Alignment(T_world_scan, np.sum(own, axis=0))
        observations.append(control_observation(placed, controls, measured.control))
    places = locate_in_images(
        registered.outlines,
        registered.markers,
        registered.T_scan_camera,
        measured.scan.centres_m,
        radius_m,
        least_images=least,
    )
    observations += loop_observations(places, measured.scan, measured.ct)
    return ErrorBudget(contributions(sigma_m, measured.scan, measured.ct), tuple(observations))


def _overlays(
    context: JobContext[job.Arguments], registered: _Registered, measured: _ScanAndCtSpheres, radius_m: float
) -> list[ArtefactRef]:
    """Return one image of each station with detected and predicted outlines drawn over it."""
    first: dict[str, int] = {}
    for i, image in enumerate(registered.images):
        first.setdefault(image.station, i)
    refs: list[ArtefactRef] = []
    for i in first.values():
        markers, controls = registered.markers[i].markers, registered.controls.assignments[i].markers
        detections = [
            Detection(outline, markers.get(j), controls.get(j), None)
            for j, outline in enumerate(registered.outlines[i])
        ]
        photograph = read_image(context.input(registered.images[i].sha256))
        if registered.record.full_camera is not None:
            full = camera_of(registered.record.full_camera)
            photograph = resample(photograph, full, registered.camera.width, registered.camera.height)
        picture = draw_overlay(
            photograph,
            registered.camera,
            detections,
            T_scan_camera=registered.T_scan_camera[i],
            registration_centres_m=measured.scan.centres_m,
            control_centres_m=measured.control.centres_m,
            radius_m=radius_m,
        )
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
        name = f"{registered.name}_{registered.images[i].viewpoint}.jpg"
        refs.append(context.keep_bytes(jpeg, kind="overlay", media_type="image/jpeg", name=name))
    return refs
