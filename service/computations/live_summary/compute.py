"""Job `live_summary`: predicted error and coverage of all images so far, and the views that would help most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.computations import live_summary as job
from service.computations.job import JobAnswer, JobContext
from service.computations.live_view.station import LiveRecord, LiveStation, last_known, read_records, solve_station
from service.computations.scene import CaptureScene, live_scene
from service.compute.live import expected_spheres
from service.compute.planning.coverage import (
    CurrentInformation,
    ViewGain,
    covered_fraction,
    next_best_views,
    predicted_information,
)
from service.core.errors import ComputeError
from service.core.geometry import apply, inverse
from service.core.units import mm


def live_summary(context: JobContext[job.Arguments]) -> JobAnswer:
    """Compute the error predicted for the worst station, the coverage, and suggestions for the robot's station."""
    scene = live_scene(context)
    records = read_records(context, context.arguments.views, scene)
    stations, reasons = _stations(context.arguments, scene, records)
    measures = {"live_images": float(sum(len(s.solved.used) for s in stations.values()))}
    if stations and not reasons:
        measures["predicted_target_error_mm"] = mm(max(s.error_m() for s in stations.values()))
        measures["outline_limited_error_mm"] = mm(max(s.outline_limited_m() for s in stations.values()))
    if scene.surface is not None:
        measures["specimen_coverage"] = covered_fraction([r.seen for r in records], scene.limits.min_views)
    here = stations.get(context.arguments.station)
    answer = job.Answer(
        next_best_views=() if here is None else _suggestions(context.arguments, scene, here, records),
        reasons=reasons,
        stations={
            name: job.StationPrediction(predicted_target_error_mm=mm(s.error_m()), images=len(s.solved.used))
            for name, s in stations.items()
        },
    )
    return JobAnswer(measures, (), answer)


def _stations(
    arguments: job.Arguments, scene: CaptureScene, records: Sequence[LiveRecord]
) -> tuple[dict[str, LiveStation], dict[str, str]]:
    """Return the registration of each station that its images determine; for the others, why they do not."""
    stations: dict[str, LiveStation] = {}
    reasons: dict[str, str] = {}
    for name in dict.fromkeys(record.station for record in records):
        mine = [record for record in records if record.station == name]
        try:
            stations[name] = solve_station([record.view for record in mine], last_known(mine), arguments, scene)
        except ComputeError as error:
            reasons[name] = str(error)
    return stations, reasons


def _suggestions(
    arguments: job.Arguments, scene: CaptureScene, here: LiveStation, records: Sequence[LiveRecord]
) -> tuple[job.Suggestion, ...]:
    present = CurrentInformation(
        tuple(view.information for view in here.informations),
        here.P,
        here.targets_m,
        np.array([record.seen for record in records], dtype=np.int64).sum(axis=0),
        scene.limits.min_views,
        here.mounting,
    )
    found = next_best_views(
        present,
        _candidates(arguments, scene, here, records),
        limit_m=arguments.limit_m,
        min_coverage=arguments.min_coverage,
    )
    return tuple(
        job.Suggestion(viewpoint=s.name, predicted_error_mm=mm(s.predicted_error_m), coverage=s.coverage)
        for s in found
    )


def _candidates(
    arguments: job.Arguments, scene: CaptureScene, here: LiveStation, records: Sequence[LiveRecord]
) -> list[ViewGain]:
    """Return the information that each candidate view would add, with outlines as precise as those seen so far."""
    spheres, radius_m = scene.spheres_m, scene.radius_m
    typical = np.median([o.cone_covariance for r in records for o in r.view.outlines], axis=0)
    typical = np.diag(np.diag(typical))  # a median of matrices need not be positive definite
    T_base_scan = here.solved.T_base_scan
    out: list[ViewGain] = []
    for candidate in arguments.candidates:
        T_base_camera = np.array(candidate.T_base_camera)
        T_scan_camera = inverse(T_base_scan) @ T_base_camera
        visible = expected_spheres(inverse(T_scan_camera), spheres, radius_m, scene.camera)
        if scene.surface is not None:
            way = T_scan_camera[:3, 3] - spheres[visible]
            outside = spheres[visible] + 1.3 * radius_m * way / np.linalg.norm(way, axis=1, keepdims=True)
            free = scene.surface.free(outside, T_scan_camera[:3, 3])
            visible = [m for m, is_free in zip(visible, free, strict=True) if is_free]
        base = apply(T_base_scan, spheres[visible]) if visible else np.zeros((0, 3))
        information = predicted_information(T_base_camera, base, radius_m, here.centre_m, typical)
        out.append(ViewGain(candidate.name, information, scene.seen_from(T_scan_camera), candidate.travel_s))
    return out
