"""Jobs while the specimen is still there: what each image brings, and whether the images are enough."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.capture.live import (
    LiveView,
    ProvisionalRegistration,
    clipped_fraction,
    expected_spheres,
    register_station,
    sharpness,
)
from service.compute.images.files import read_image
from service.compute.images.quality import image_quality
from service.compute.markers.archive import outline_from_record, outline_record
from service.compute.markers.search.predicted import NEAR, Prediction, find_spheres, tone_of
from service.compute.planning.coverage import (
    CoverageLimits,
    CoverageSurface,
    coverage_surface,
    covered_fraction,
    seen,
)
from service.compute.planning.information import (
    ViewInformation,
    mounting_covariance,
    point_sigmas_m,
    pose_covariance,
    pose_scatter,
    predicted_information,
    view_information,
)
from service.compute.planning.next_best_view import Candidate, CurrentInformation, next_best_views
from service.compute.registration.identification.pairing import paired
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse
from service.core.units import mm
from service.jobs.capture import live_summary as summary_job
from service.jobs.capture import live_view as view_job
from service.jobs.capture.live_view import LiveArguments
from service.jobs.records import Hash, Limits
from service.jobs.surfaces import coverage_points as coverage_job
from service.worker.camera import camera_of
from service.worker.job import JobAnswer, JobContext
from service.worker.poses.robot_poses import robot_camera_poses


@dataclass(frozen=True, slots=True)
class _Record:
    """A `live_view` artefact, read back."""

    viewpoint: str
    station: str
    view: LiveView
    T_base_scan: Transform | None  # as it was known then
    seen: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Station:
    """One station's registration so far, and what its images say."""

    solved: ProvisionalRegistration
    informations: tuple[ViewInformation, ...]
    P: Array
    mounting: Array  # (6, 6) of the scan's pose, from the hand-eye's covariance
    centre_m: Array  # (3,) base frame
    targets_m: Array  # (T, 3) relative to the centre, base axes

    def error_m(self) -> float:
        return self._worst_m(pose_covariance([v.information for v in self.informations], self.P) + self.mounting)

    def outline_limited_m(self) -> float:
        return self._worst_m(pose_covariance([v.information for v in self.informations], np.zeros((6, 6))))

    def _worst_m(self, covariance: Array) -> float:
        return float(point_sigmas_m(covariance, self.targets_m).max())


def coverage_points(context: JobContext[coverage_job.Arguments]) -> JobAnswer:
    """Points of the specimen that the images should see, on the CT's surface."""
    arguments = context.arguments
    spheres, radius_m = np.array(arguments.spheres_m), arguments.radius_m
    with np.load(context.input(arguments.mesh), allow_pickle=False) as mesh:
        surface = coverage_surface(mesh["vertices_m"], mesh["faces"], spheres, radius_m, limits_of(arguments.limits))
    buffer = io.BytesIO()
    np.savez(
        buffer,
        points_m=surface.points_m,
        normals=surface.normals,
        occluder_vertices_m=surface.occluder_vertices_m,
        occluder_faces=surface.occluder_faces,
    )
    ref = context.keep_bytes(
        buffer.getvalue(), kind="coverage_points", media_type="application/x-npz", name="coverage_points.npz"
    )
    return JobAnswer({"coverage_points": float(len(surface.points_m))}, (ref,))


def live_view(context: JobContext[view_job.Arguments]) -> JobAnswer:
    """One image, just taken: its spheres, the registration of its station's images so far, the error to expect."""
    cv2.setNumThreads(1)  # the capture runs beside this
    arguments = context.arguments
    camera, spheres = camera_of(arguments.camera), np.array(arguments.spheres_m)
    radius_m, image, limits = arguments.radius_m, arguments.image, limits_of(arguments.limits)
    surface = kept_surface(context, arguments.surface)
    earlier = _records(context, arguments.earlier, camera, surface, limits)
    mine = [r for r in earlier if r.station == image.station]
    known = next((r.T_base_scan for r in reversed(mine) if r.T_base_scan is not None), None)
    (T_base_camera,) = robot_camera_poses(arguments, [image])
    pixels = read_image(context.input(image.sha256))
    expected: Prediction | None = None
    shown = [o for r in mine for o in r.view.outlines]
    if known is not None and shown:
        expected = Prediction(inverse(T_base_camera) @ known, spheres, radius_m, NEAR, tone_of(shown))
    outlines = find_spheres(pixels, camera, expected).outlines
    quality = sharpness(pixels, outlines, camera)
    whole = image_quality(np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8))
    view = LiveView(image.viewpoint, T_base_camera, outlines)
    measures = {
        "image_edge_px": whole.edge_px,
        "outlines": float(len(outlines)),
        "outline_coverage": quality.coverage,
        "outline_rms_px": quality.rms_px,
        "edge_width_px": quality.edge_px,
        "clipped_fraction": clipped_fraction(pixels),
    }
    reason = ""
    visible = np.zeros(0 if surface is None else len(surface.points_m), dtype=bool)
    T_base_scan = known
    try:
        station = _solve([*(r.view for r in mine), view], known, arguments, surface)
    except ComputeError as error:
        reason = str(error)
        measures["spheres_seen"] = 0.0
    else:
        T_base_scan = station.solved.T_base_scan
        T_camera_scan = inverse(T_base_camera) @ T_base_scan
        residuals = station.solved.registration.residuals
        own = [r.rms_px for r in residuals if station.solved.used[r.image] == view.name and not r.excluded]
        measures["spheres_seen"] = float(len(own))
        measures["spheres_expected"] = float(len(expected_spheres(T_camera_scan, spheres, radius_m, camera)))
        measures["registration_rms_px"] = float(np.median(own)) if own else float("nan")
        measures["images"] = float(len(station.solved.used))
        measures["predicted_target_error_mm"] = mm(station.error_m())
        measures["outline_limited_error_mm"] = mm(station.outline_limited_m())
        measures["pose_scatter_mm"] = mm(float(np.sqrt(np.trace(station.P[:3, :3]))))
        if surface is not None:
            visible = _seen(limits, surface, view, T_base_scan, camera)
            masks = [*(r.seen for r in earlier), visible]
            measures["specimen_coverage"] = covered_fraction(masks, limits.min_views)
    record = {
        "viewpoint": image.viewpoint,
        "station": image.station,
        "sha256": image.sha256,
        "T_base_camera": T_base_camera.tolist(),
        "T_base_scan": None if T_base_scan is None else T_base_scan.tolist(),
        "outlines": [outline_record(o) for o in outlines],
        "seen": base64.b64encode(np.packbits(visible).tobytes()).decode(),
    }
    ref = context.keep_json(record, kind="live_view", name=f"{image.viewpoint}.live.json")
    answer = view_job.Answer(viewpoint=image.viewpoint, station=image.station, reason=reason, black=whole.black)
    return JobAnswer({k: v for k, v in measures.items() if np.isfinite(v)}, (ref,), answer)


def live_summary(context: JobContext[summary_job.Arguments]) -> JobAnswer:
    """All images so far: the predicted error of the worst station, the coverage, and which views would help most."""
    arguments = context.arguments
    camera, limits = camera_of(arguments.camera), limits_of(arguments.limits)
    surface = kept_surface(context, arguments.surface)
    records = _records(context, arguments.views, camera, surface, limits)
    stations: dict[str, _Station] = {}
    reasons: dict[str, str] = {}
    for name in dict.fromkeys(r.station for r in records):
        mine = [r for r in records if r.station == name]
        known = next((r.T_base_scan for r in reversed(mine) if r.T_base_scan is not None), None)
        try:
            stations[name] = _solve([r.view for r in mine], known, arguments, surface)
        except ComputeError as error:
            reasons[name] = str(error)
    measures: dict[str, float] = {"live_images": float(sum(len(s.solved.used) for s in stations.values()))}
    masks = [r.seen for r in records]
    if stations and not reasons:
        measures["predicted_target_error_mm"] = mm(max(s.error_m() for s in stations.values()))
        measures["outline_limited_error_mm"] = mm(max(s.outline_limited_m() for s in stations.values()))
    if surface is not None:
        measures["specimen_coverage"] = covered_fraction(masks, limits.min_views)
    suggestions: list[summary_job.Suggestion] = []
    here = stations.get(arguments.station)
    if here is not None:
        counts = np.array(masks, dtype=np.int64).sum(axis=0)
        present = CurrentInformation(
            tuple(v.information for v in here.informations),
            here.P,
            here.targets_m,
            counts,
            limits.min_views,
            here.mounting,
        )
        found = next_best_views(
            present,
            _candidates(arguments, here, camera, surface, limits, records),
            limit_m=arguments.limit_m,
            min_coverage=arguments.min_coverage,
        )
        suggestions = [
            summary_job.Suggestion(viewpoint=s.name, predicted_error_mm=mm(s.predicted_error_m), coverage=s.coverage)
            for s in found
        ]
    answer = summary_job.Answer(
        next_best_views=tuple(suggestions),
        reasons=reasons,
        stations={
            name: summary_job.StationSoFar(predicted_target_error_mm=mm(s.error_m()), images=len(s.solved.used))
            for name, s in stations.items()
        },
    )
    return JobAnswer(measures, (), answer)


def limits_of(record: Limits) -> CoverageLimits:
    """When a view counts, as the coverage takes it."""
    return CoverageLimits(record.max_angle_deg, record.max_distance_m, record.min_views)


def _solve(
    views: Sequence[LiveView], known: Transform | None, arguments: LiveArguments, surface: CoverageSurface | None
) -> _Station:
    """Register a station's images and predict the error. Raises ComputeError while they do not determine it."""
    camera = camera_of(arguments.camera)
    spheres, radius_m = np.array(arguments.spheres_m), arguments.radius_m
    sigma_m, sigma_rad = arguments.arm_sigma_m, arguments.arm_sigma_rad
    solved = register_station(views, spheres, radius_m, camera, known)
    T = solved.T_base_scan
    centre = apply(T, spheres.mean(axis=0))
    informations = tuple(
        view_information(
            v.T_base_camera, T, v.outlines,
            paired(v.outlines, inverse(v.T_base_camera) @ T, spheres, radius_m, camera),
            spheres, radius_m, centre, 3 * sigma_m,
        )
        for v in views
    )  # fmt: skip
    targets = spheres if surface is None else surface.points_m[:: max(1, len(surface.points_m) // 200)]
    scatter = pose_scatter(informations, sigma_m, sigma_rad)
    # Raises while the views do not determine the pose, as the next line would without saying so.
    pose_covariance([v.information for v in informations], scatter)
    mounting = mounting_covariance(
        [(i.information, v.T_base_camera) for i, v in zip(informations, views, strict=True)],
        np.array(arguments.T_flange_camera),
        np.array(arguments.hand_eye_covariance),
        centre,
    )
    return _Station(solved, informations, scatter, mounting, centre, apply(T, targets) - centre)


def _candidates(
    arguments: summary_job.Arguments,
    here: _Station,
    camera: CameraModel,
    surface: CoverageSurface | None,
    limits: CoverageLimits,
    records: Sequence[_Record],
) -> list[Candidate]:
    """What each candidate viewpoint would bring, with outlines as good as those seen so far."""
    spheres, radius_m = np.array(arguments.spheres_m), arguments.radius_m
    typical = np.median([o.cone_covariance for r in records for o in r.view.outlines], axis=0)
    typical = np.diag(np.diag(typical))  # a median of matrices need not be positive definite
    T_base_scan = here.solved.T_base_scan
    out: list[Candidate] = []
    for candidate in arguments.candidates:
        T_base_camera = np.array(candidate.T_base_camera)
        T_scan_camera = inverse(T_base_scan) @ T_base_camera
        visible = expected_spheres(inverse(T_scan_camera), spheres, radius_m, camera)
        mask = np.zeros(0, dtype=bool)
        if surface is not None:
            way = T_scan_camera[:3, 3] - spheres[visible]
            outside = spheres[visible] + 1.3 * radius_m * way / np.linalg.norm(way, axis=1, keepdims=True)
            free = surface.free(outside, T_scan_camera[:3, 3])
            visible = [m for m, is_free in zip(visible, free, strict=True) if is_free]
            mask = seen(surface, T_scan_camera[:3, 3], limits, T_scan_camera, camera)
        base = apply(T_base_scan, spheres[visible]) if visible else np.zeros((0, 3))
        information = predicted_information(T_base_camera, base, radius_m, here.centre_m, typical)
        out.append(Candidate(candidate.name, information, mask, candidate.travel_s))
    return out


def kept_surface(context: JobContext[Any], sha256: Hash | None) -> CoverageSurface | None:
    """The specimen's surface from its file; None where there is none, or none yet."""
    if sha256 is None:
        return None
    with np.load(context.input(sha256), allow_pickle=False) as arrays:
        return CoverageSurface(**{name: arrays[name] for name in arrays.files})


def _records(
    context: JobContext[Any],
    hashes: Sequence[Hash],
    camera: CameraModel,
    surface: CoverageSurface | None,
    limits: CoverageLimits,
) -> list[_Record]:
    points = 0 if surface is None else len(surface.points_m)
    out: list[_Record] = []
    for sha256 in hashes:
        data = context.input_json(sha256)
        outlines = tuple(outline_from_record(o, camera) for o in data["outlines"])
        bits = np.unpackbits(np.frombuffer(base64.b64decode(data["seen"]), np.uint8))
        T = None if data["T_base_scan"] is None else np.array(data["T_base_scan"])
        view = LiveView(data["viewpoint"], np.array(data["T_base_camera"]), outlines)
        visible = bits[:points].astype(bool)
        if len(bits) < points:  # taken before the surface was ready
            visible = np.zeros(points, dtype=bool) if T is None else _seen(limits, surface, view, T, camera)
        out.append(_Record(data["viewpoint"], data["station"], view, T, visible))
    return out


def _seen(
    limits: CoverageLimits,
    surface: CoverageSurface | None,
    view: LiveView,
    T_base_scan: Transform,
    camera: CameraModel,
) -> NDArray[np.bool_]:
    """Which points of the surface (N,) a view shows; none without a surface."""
    if surface is None:
        return np.zeros(0, dtype=bool)
    T_scan_camera = inverse(T_base_scan) @ view.T_base_camera
    return seen(surface, T_scan_camera[:3, 3], limits, T_scan_camera, camera)
