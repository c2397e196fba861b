"""Job `live_view`: an image just taken; its spheres, the registration of its station so far, the predicted error."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from service.computations import live_view as job
from service.computations.inputs import robot_camera_poses
from service.computations.job import JobAnswer, JobContext, finite
from service.computations.live_view.station import LiveRecord, LiveStation, last_known, read_records, solve_station
from service.computations.scene import CaptureScene, live_scene
from service.compute.images.photographs import read_image
from service.compute.live import LiveView, expected_spheres, image_measures
from service.compute.markers.predicted import NEAR, PredictedSpheres, find_outlines, tone_of
from service.compute.planning.coverage import covered_fraction
from service.core.errors import ComputeError
from service.core.geometry import Transform, inverse
from service.core.units import mm


def live_view(context: JobContext[job.Arguments]) -> JobAnswer:
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
    answer = job.Answer(viewpoint=image.viewpoint, station=image.station, reason=reason, black=black)
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
