"""Job `hand_view`: a hand-held image of the specimen; its pose, whether it counts, and where to go next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from service.computations import hand_view as job
from service.computations.conversion import camera_of
from service.computations.hand_view.answer import HandheldImage, NewImage, answer_to, read_views
from service.computations.job import JobAnswer, JobContext
from service.computations.scene import CaptureScene, kept_surface, limits_of
from service.compute.hand_held import HandView, ImageReading, adjust_together, away_from_plane, look_at_image
from service.compute.images.photographs import read_image
from service.compute.markers.detect import options_for
from service.core.geometry import Array, Transform
from service.core.units import mm


def hand_view(context: JobContext[job.Arguments]) -> JobAnswer:
    """Locate the camera by the spheres.

    Spheres that are known from photographs alone are rough: they are adjusted together with all camera poses.
    """
    cv2.setNumThreads(1)
    arguments = context.arguments
    scene, earlier = _scene(context)
    pixels = read_image(context.input(arguments.image.sha256))
    options = options_for(arguments.colour)
    view = look_at_image(pixels, scene.camera, scene.spheres_m, scene.radius_m, options, rough=arguments.rough)
    pose, reading = view.T_scene_camera, None
    measures = _measures(view)
    if arguments.rough:
        name = arguments.image.viewpoint
        good = not (view.why or arguments.image.settings)
        reading = ImageReading.of(name, pose, view.shown) if pose is not None and good else None
        readings = [*_readings(earlier), *([reading] if reading else [])]
        bundle = adjust_together(readings, scene.spheres_m, scene.camera, scene.radius_m)
        if bundle is not None:
            scene, pose = replace(scene, spheres_m=bundle.spheres_m), bundle.poses.get(name, pose)
            earlier = [replace(e, T_scene_camera=bundle.poses.get(e.viewpoint, e.T_scene_camera)) for e in earlier]
            measures["spheres_sigma_mm"] = mm(bundle.sigma_m)
    found = NewImage(
        pose,
        view.why,
        measures,
        np.zeros((6, 6)) if view.information is None else view.information.information,
        away_from_plane(scene.spheres_m, _eye(pose)),
        scene.spheres_m.mean(axis=0),
        np.zeros((0, 0), dtype=np.int64),
        reading,
    )
    return answer_to(context, found, scene, earlier)


def _scene(context: JobContext[job.Arguments]) -> tuple[CaptureScene, list[HandheldImage]]:
    """Return the scene, with the spheres as the last image left them, and the earlier images."""
    arguments = context.arguments
    scene = CaptureScene(
        camera_of(arguments.camera),
        np.array(arguments.spheres_m),
        arguments.radius_m,
        limits_of(arguments.limits),
        kept_surface(context),
    )
    earlier = read_views(context, scene)
    known = [view.spheres_m for view in earlier if view.spheres_m is not None]
    return (replace(scene, spheres_m=known[-1]) if known else scene), earlier


def _measures(view: HandView) -> dict[str, float]:
    return {
        "outlines": float(view.outlines),
        "spheres_seen": float(view.spheres_seen),
        "spheres_expected": float(view.spheres_expected),
        "edge_width_px": view.edge_px,
        "outline_rms_px": view.rms_px,
        "clipped_fraction": view.clipped,
    }


def _readings(earlier: Sequence[HandheldImage]) -> list[ImageReading]:
    return [e.reading for e in earlier if e.used and e.reading is not None]


def _eye(pose: Transform | None) -> Array:
    return np.zeros(3) if pose is None else pose[:3, 3]
