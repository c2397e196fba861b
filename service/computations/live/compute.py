"""Jobs during a capture: each image as it arrives, the station so far, and the surface that images should see."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations.inputs import CaptureScene, limits_of, live_scene, robot_camera_poses
from service.computations.job import JobAnswer, JobContext, finite
from service.computations.live import (
    CoveragePointsArguments,
    LiveArguments,
    LiveSummaryAnswer,
    LiveSummaryArguments,
    LiveViewAnswer,
    LiveViewArguments,
    StationPrediction,
    Suggestion,
)
from service.computations.records import Hash
from service.compute.images.photographs import read_image
from service.compute.live import LiveView, ProvisionalRegistration, expected_spheres, image_measures, register_station
from service.compute.markers.predicted import NEAR, PredictedSpheres, find_outlines, tone_of
from service.compute.markers.records import outline_from_record, outline_record
from service.compute.planning.coverage import (
    CurrentInformation,
    ViewGain,
    ViewInformation,
    coverage_surface,
    covered_fraction,
    mounting_covariance,
    next_best_views,
    point_sigmas_m,
    pose_covariance,
    pose_scatter,
    predicted_information,
    view_information,
)
from service.compute.registration.hypotheses import paired
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse
from service.core.units import mm
from service.machine.resources import large_arrays_returned

_L = TypeVar("_L", bound=LiveArguments)


@dataclass(frozen=True, slots=True)
class LiveRecord:
    """The file of a job `live_view`: an image's outlines and pose, and the points of the specimen that it shows."""

    viewpoint: str
    station: str
    view: LiveView
    T_base_scan: Transform | None  # as the images up to this one determined it
    seen: NDArray[np.bool_]

    def plain(self, sha256: str) -> dict[str, object]:
        """Return the record as it is written, with the hash of the photograph."""
        return {
            "viewpoint": self.viewpoint,
            "station": self.station,
            "sha256": sha256,
            "T_base_camera": self.view.T_base_camera.tolist(),
            "T_base_scan": None if self.T_base_scan is None else self.T_base_scan.tolist(),
            "outlines": [outline_record(o) for o in self.view.outlines],
            "seen": base64.b64encode(np.packbits(self.seen).tobytes()).decode(),
        }


def read_records(context: JobContext[_L], hashes: Sequence[Hash], scene: CaptureScene) -> list[LiveRecord]:
    """Return the records of earlier images, from their files."""
    out: list[LiveRecord] = []
    for sha256 in hashes:
        data = context.input_json(sha256)
        outlines = tuple(outline_from_record(o, scene.camera) for o in data["outlines"])
        bits = np.unpackbits(np.frombuffer(base64.b64decode(data["seen"]), np.uint8))
        T = None if data["T_base_scan"] is None else np.array(data["T_base_scan"])
        view = LiveView(data["viewpoint"], np.array(data["T_base_camera"]), outlines)
        visible = bits[: scene.n_points].astype(bool)
        if len(bits) < scene.n_points:  # the surface was not ready yet
            visible = scene.seen_from(None if T is None else inverse(T) @ view.T_base_camera)
        out.append(LiveRecord(data["viewpoint"], data["station"], view, T, visible))
    return out


def last_known(records: Sequence[LiveRecord]) -> Transform | None:
    """Return the newest T_base_scan of a station's images; None before one is determined."""
    return next((r.T_base_scan for r in reversed(records) if r.T_base_scan is not None), None)


@dataclass(frozen=True, slots=True)
class LiveStation:
    """One station's registration so far, and the information of each of its images.

    Attributes:
        solved: the registration.
        informations: the information of each image about the scan's pose.
        P: (6, 6) covariance of one camera pose of the arm.
        mounting: (6, 6) covariance of the scan's pose due to the hand-eye transform.
        centre_m: (3,) centre of the spheres, base frame.
        targets_m: (T, 3) points at which errors are predicted, relative to the centre, base axes.
    """

    solved: ProvisionalRegistration
    informations: tuple[ViewInformation, ...]
    P: Array
    mounting: Array
    centre_m: Array
    targets_m: Array

    def error_m(self) -> float:
        """Predict the error (1σ, 3D) at the worst target."""
        return self._worst_m(pose_covariance([v.information for v in self.informations], self.P) + self.mounting)

    def outline_limited_m(self) -> float:
        """Predict the error (1σ, 3D) at the worst target if the camera poses were exact."""
        return self._worst_m(pose_covariance([v.information for v in self.informations], np.zeros((6, 6))))

    def _worst_m(self, covariance: Array) -> float:
        return float(point_sigmas_m(covariance, self.targets_m).max())


def solve_station(
    views: Sequence[LiveView], known: Transform | None, arguments: LiveArguments, scene: CaptureScene
) -> LiveStation:
    """Register a station's images and predict the error. Raises ComputeError while they do not determine it."""
    spheres, radius_m = scene.spheres_m, scene.radius_m
    sigma_m, sigma_rad = arguments.arm_sigma_m, arguments.arm_sigma_rad
    solved = register_station(views, spheres, radius_m, scene.camera, known)
    T = solved.T_base_scan
    centre = apply(T, spheres.mean(axis=0))
    informations = tuple(
        view_information(
            v.T_base_camera, T, v.outlines,
            paired(v.outlines, inverse(v.T_base_camera) @ T, spheres, radius_m, scene.camera),
            ScanSpheres(spheres, radius_m), centre, 3 * sigma_m,
        )
        for v in views
    )  # fmt: skip
    scatter = pose_scatter(informations, sigma_m, sigma_rad)
    # Raises if the views do not determine the pose; the next call would return a wrong result instead.
    pose_covariance([v.information for v in informations], scatter)
    mounting = mounting_covariance(
        [(i.information, v.T_base_camera) for i, v in zip(informations, views, strict=True)],
        np.array(arguments.T_flange_camera),
        np.array(arguments.hand_eye_covariance),
        centre,
    )
    return LiveStation(solved, informations, scatter, mounting, centre, apply(T, scene.targets_m()) - centre)


@large_arrays_returned()
def coverage_points(context: JobContext[CoveragePointsArguments]) -> JobAnswer:
    """Sample the surface of the CT outside the spheres."""
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


def live_view(context: JobContext[LiveViewArguments]) -> JobAnswer:
    """Find the spheres in a new image, and register its station's images so far."""
    cv2.setNumThreads(1)  # the capture goes on in parallel
    arguments, image = context.arguments, context.arguments.image
    scene = live_scene(context)
    earlier = read_records(context, arguments.earlier, scene)
    mine = [record for record in earlier if record.station == image.station]
    known = last_known(mine)
    (T_base_camera,) = robot_camera_poses(arguments, [image])
    pixels = read_image(context.input(image.sha256))
    outlines = find_outlines(pixels, scene.camera, _prediction(scene, mine, known, T_base_camera)).outlines
    measures, black = image_measures(pixels, outlines, scene.camera)
    view = LiveView(image.viewpoint, T_base_camera, outlines)
    reason, T_base_scan, visible = "", known, scene.seen_from(None)
    try:
        station = solve_station([*(record.view for record in mine), view], known, arguments, scene)
    except ComputeError as error:
        reason = str(error)
        measures["spheres_seen"] = 0.0
    else:
        T_base_scan = station.solved.T_base_scan
        measures |= _station_measures(station, view, scene)
        if scene.surface is not None:
            visible = scene.seen_from(inverse(T_base_scan) @ T_base_camera)
            masks = [*(record.seen for record in earlier), visible]
            measures["specimen_coverage"] = covered_fraction(masks, scene.limits.min_views)
    record = LiveRecord(image.viewpoint, image.station, view, T_base_scan, visible)
    ref = context.keep_json(record.plain(image.sha256), kind="live_view", name=f"{image.viewpoint}.live.json")
    answer = LiveViewAnswer(viewpoint=image.viewpoint, station=image.station, reason=reason, black=black)
    return JobAnswer(finite(measures), (ref,), answer)


def _prediction(
    scene: CaptureScene, mine: Sequence[LiveRecord], known: Transform | None, T_base_camera: Transform
) -> PredictedSpheres | None:
    """Predict where the image should show the spheres; None before the station is registered."""
    shown = [outline for record in mine for outline in record.view.outlines]
    if known is None or not shown:
        return None
    return PredictedSpheres(inverse(T_base_camera) @ known, scene.spheres_m, scene.radius_m, NEAR, tone_of(shown))


def _station_measures(station: LiveStation, view: LiveView, scene: CaptureScene) -> dict[str, float]:
    """Return the numbers of the registration so far, and of the new image in it."""
    solved = station.solved
    T_camera_scan = inverse(view.T_base_camera) @ solved.T_base_scan
    residuals = solved.registration.residuals
    own = [r.rms_px for r in residuals if solved.used[r.image] == view.name and not r.excluded]
    expected = expected_spheres(T_camera_scan, scene.spheres_m, scene.radius_m, scene.camera)
    return {
        "spheres_seen": float(len(own)),
        "spheres_expected": float(len(expected)),
        "registration_rms_px": float(np.median(own)) if own else float("nan"),
        "images": float(len(solved.used)),
        "predicted_target_error_mm": mm(station.error_m()),
        "outline_limited_error_mm": mm(station.outline_limited_m()),
        "pose_scatter_mm": mm(float(np.sqrt(np.trace(station.P[:3, :3])))),
    }


def live_summary(context: JobContext[LiveSummaryArguments]) -> JobAnswer:
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
    answer = LiveSummaryAnswer(
        next_best_views=() if here is None else _suggestions(context.arguments, scene, here, records),
        reasons=reasons,
        stations={
            name: StationPrediction(predicted_target_error_mm=mm(s.error_m()), images=len(s.solved.used))
            for name, s in stations.items()
        },
    )
    return JobAnswer(measures, (), answer)


def _stations(
    arguments: LiveSummaryArguments, scene: CaptureScene, records: Sequence[LiveRecord]
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
    arguments: LiveSummaryArguments, scene: CaptureScene, here: LiveStation, records: Sequence[LiveRecord]
) -> tuple[Suggestion, ...]:
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
        Suggestion(viewpoint=s.name, predicted_error_mm=mm(s.predicted_error_m), coverage=s.coverage) for s in found
    )


def _candidates(
    arguments: LiveSummaryArguments, scene: CaptureScene, here: LiveStation, records: Sequence[LiveRecord]
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
