"""Jobs of a hand-held camera: what an image shows, where the person should go next, and when it is enough."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.computations.conversion import camera_of, lens_covariance
from service.computations.hand_held import (
    HandBoardArguments,
    HandViewAnswer,
    HandViewArguments,
    HeldArguments,
    PlaceStatus,
    PlannedPlace,
)
from service.computations.inputs import CaptureScene, kept_surface, limits_of, nominal_camera
from service.computations.job import JobAnswer, JobContext, finite
from service.computations.records import Matrix, Point, matrices, matrix
from service.compute.calibration.board import Board, find_board
from service.compute.calibration.intrinsics import coverage_map_of, locate_view
from service.compute.hand_held import (
    HandView,
    ImageReading,
    WantedView,
    adjust_together,
    away_from_plane,
    covered,
    level_frame,
    look_at_image,
    nearest,
    place_at,
    same_view,
    words,
)
from service.compute.images.photographs import read_grey, read_image
from service.compute.live import expected_spheres
from service.compute.markers.detect import options_for
from service.compute.planning.coverage import (
    CurrentInformation,
    ViewGain,
    covered_fraction,
    lens_covariance_of_pose,
    next_best_views,
    predicted_information,
)
from service.compute.registration.problem import EXPECTED_COMMON_ERRORS
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse
from service.core.units import mm

_H = TypeVar("_H", bound=HeldArguments)


@dataclass(frozen=True, slots=True)
class HandheldImage:
    """An image that a person took, and its contribution.

    Attributes:
        viewpoint: its name.
        used: true if it counts.
        T_scene_camera: the camera's pose, (4, 4); None where the image does not show where the camera was.
        T_scene_level: the frame with z up and y towards the top of the first image whose pose is known.
        information: (6, 6) information about the scan's pose.
        seen: (P,) mask of the points of the surface that it shows.
        cells: the number of board corners in each cell of the frame; empty for images of the specimen.
        reading: the outlines and spheres, where the spheres have not been measured.
        spheres_m: (S, 3) centres as the images up to this one show them.
    """

    viewpoint: str
    used: bool
    T_scene_camera: Transform | None
    T_scene_level: Transform | None
    information: Array = field(repr=False)
    seen: NDArray[np.bool_] = field(repr=False)
    cells: NDArray[np.int64] = field(repr=False)
    reading: ImageReading | None = field(repr=False)
    spheres_m: Array | None = field(repr=False)

    def plain(self, *, rough: bool) -> dict[str, object]:
        """Return the view as it is written into its file; with `rough`, the spheres too."""
        record: dict[str, object] = {
            "viewpoint": self.viewpoint,
            "used": self.used,
            "T_scene_camera": None if self.T_scene_camera is None else self.T_scene_camera.tolist(),
            "T_scene_level": None if self.T_scene_level is None else self.T_scene_level.tolist(),
            "information": self.information.tolist(),
            "seen": base64.b64encode(np.packbits(self.seen).tobytes()).decode(),
            "cells": self.cells.tolist(),
        }
        if rough:
            record["reading"] = None if self.reading is None else self.reading.record()
            record["spheres_m"] = None if self.spheres_m is None else self.spheres_m.tolist()
        return record


def read_views(context: JobContext[_H], scene: CaptureScene) -> list[HandheldImage]:
    """Return the views of the earlier images, from their files."""
    return [_read(context, sha256, scene) for sha256 in context.arguments.earlier]


def _read(context: JobContext[_H], sha256: str, scene: CaptureScene) -> HandheldImage:
    data = context.input_json(sha256)
    bits = np.unpackbits(np.frombuffer(base64.b64decode(data["seen"]), np.uint8))
    T, level = (None if data[key] is None else np.array(data[key]) for key in ("T_scene_camera", "T_scene_level"))
    reading = data.get("reading")
    visible = bits[: scene.n_points].astype(bool)
    if len(bits) < scene.n_points:  # the surface was not ready yet
        visible = scene.seen_from(T)
    return HandheldImage(
        viewpoint=data["viewpoint"],
        used=bool(data["used"]),
        T_scene_camera=T,
        T_scene_level=level,
        information=np.array(data["information"]),
        seen=visible,
        cells=np.array(data["cells"], dtype=np.int64),
        reading=None if reading is None or T is None else ImageReading.read(data["viewpoint"], T, reading),
        spheres_m=None if data.get("spheres_m") is None else np.array(data["spheres_m"]),
    )


_LOST_AFTER = 1  # earlier images in a row that do not show where the camera was
AGAIN = "take this one again: hold the camera still, with everything in view and nothing before the lens"
_DENSER_TILTS_DEG, _DENSER_AZIMUTHS_DEG = (10.0, 25.0, 40.0, 48.0), tuple(np.arange(-180.0, 180.0, 30.0))
_TYPICAL_PX = 0.08  # standard deviation of an outline, for views that are only planned


@dataclass(frozen=True, slots=True)
class HandGuide:
    """The state of a capture by hand after one more image.

    Attributes:
        arguments: the job's arguments.
        scene: the scene with the spheres as they are known now.
        new: the new image.
        earlier: all images before it, in order.
        good: the images that count and whose pose is known, the new one included.
    """

    arguments: HeldArguments
    scene: CaptureScene
    new: HandheldImage
    earlier: Sequence[HandheldImage]
    good: Sequence[HandheldImage]

    def places(self) -> list[WantedView]:
        """Return the planned places."""
        return [_place(spot) for spot in self.arguments.places]

    def done(self) -> set[str]:
        """Return the names of the planned places that have an image."""
        level = self.new.T_scene_level
        return covered(self.places(), [] if level is None else self._poses(level), self.arguments.within_deg)

    def totals(self) -> dict[str, float]:
        """Return the numbers of all images that count."""
        places, measures = self.places(), {"images_used": float(len(self.good))}
        measures["hemisphere_coverage"] = len(self.done()) / len(places)
        if not isinstance(self.arguments, HandViewArguments) or not len(self.scene.spheres_m):
            cells = [view.cells for view in self.good if view.cells.size]
            return measures | {"coverage": float(np.mean(np.sum(cells, axis=0) > 0)) if cells else 0.0}
        present = self._information(self.arguments)
        error_m = present.error_m()
        if np.isfinite(error_m):
            measures["predicted_target_error_mm"] = mm(error_m)
        if self.scene.surface is not None:
            measures["specimen_coverage"] = covered_fraction([view.seen for view in self.good], present.min_views)
        return measures

    def next_place(self) -> tuple[str, WantedView | None]:
        """Return directions to the next place, and the place; those for the first image after repeated loss."""
        T, level = self.new.T_scene_camera, self.new.T_scene_level
        if T is None or level is None:
            return (self.arguments.first_words if self._lost() >= _LOST_AFTER else AGAIN), None
        here = inverse(level) @ T
        done, places = self.done(), self.places()
        left = [place for place in places if place.name not in done]
        target = nearest(left, here) if left else None
        if target is None and isinstance(self.arguments, HandViewArguments) and len(self.scene.spheres_m):
            target = self._most_helpful(self.arguments, level)
        if target is None:
            target = max(places, key=lambda place: float(np.linalg.norm(place.T_level_camera[:3, 3] - here[:3, 3])))
        return words(here, target.T_level_camera) or "stay there and take it again", target

    def _lost(self) -> int:
        """Count the consecutive images just before this one from which no camera pose could be found."""
        lost = 0
        for view in reversed(self.earlier):
            if view.T_scene_camera is not None:
                break
            lost += 1
        return lost

    def _poses(self, level: Transform) -> list[Transform]:
        return [inverse(level) @ v.T_scene_camera for v in self.good if v.T_scene_camera is not None]

    def _information(self, arguments: HandViewArguments) -> CurrentInformation:
        """Return the images as measurements of the scan's pose, with poses as expected of structure from motion."""
        sigma_m, sigma_rad = arguments.pose_sigma_m, arguments.pose_sigma_rad
        seen = np.array([v.seen for v in self.good], dtype=np.int64).reshape(len(self.good), self.scene.n_points)
        return CurrentInformation(
            tuple(v.information for v in self.good),
            np.diag([sigma_m**2 / 3] * 3 + [sigma_rad**2 / 3] * 3),
            self.scene.targets_m() - self.scene.spheres_m.mean(axis=0),
            seen.sum(axis=0),
            arguments.limits.min_views,
            self._shared(arguments),
        )

    def _shared(self, arguments: HandViewArguments) -> Array:
        """Return the (6, 6) covariance that all images share by the error budget: edges, calibration and scan."""
        scene, centre_m = self.scene, self.scene.spheres_m.mean(axis=0)
        placed = [(v.information, v.T_scene_camera) for v in self.good if v.T_scene_camera is not None]
        if not placed:
            return np.zeros((6, 6))
        distance_m = float(np.mean([np.linalg.norm(T[:3, 3] - centre_m) for _, T in placed]))
        light_m = EXPECTED_COMMON_ERRORS.light_px * distance_m / scene.camera.fx
        shared = np.zeros((6, 6))
        shared[:3, :3] = (light_m**2 + arguments.scan_sigma_m**2 / 3) * np.eye(3)
        lens = lens_covariance(arguments.intrinsics_covariance)
        if lens is None or not np.all(np.diag(sum((i for i, _ in placed), np.zeros((6, 6)))) > 0):
            return shared
        return shared + lens_covariance_of_pose(placed, scene.camera, lens, centre_m)

    def _most_helpful(self, arguments: HandViewArguments, T_scene_level: Transform) -> WantedView | None:
        """Return the most helpful view of a denser hemisphere, once every planned place has its image."""
        scene, taken = self.scene, self._poses(T_scene_level)
        distance_m = float(np.median([spot.distance_m for spot in arguments.places]))
        typical = (_TYPICAL_PX / scene.camera.fx) ** 2 * np.eye(3)
        places: dict[str, WantedView] = {}
        candidates: list[ViewGain] = []
        for place in _denser_places(distance_m):
            if covered([place], taken, 8.0):
                continue
            T = T_scene_level @ place.T_level_camera
            visible = expected_spheres(inverse(T), scene.spheres_m, scene.radius_m, scene.camera)
            centre = scene.spheres_m.mean(axis=0)
            information = predicted_information(T, scene.spheres_m[visible], scene.radius_m, centre, typical)
            candidates.append(ViewGain(place.name, information, scene.seen_from(T)))
            places[place.name] = place
        found = next_best_views(
            self._information(arguments),
            candidates,
            limit_m=arguments.limit_m,
            min_coverage=arguments.min_coverage,
            at_most=1,
        )
        return places[found[0].name] if found else None


def _denser_places(distance_m: float) -> list[WantedView]:
    return [
        place_at(
            f"t{tilt:02.0f}{azimuth:+04.0f}",
            tilt_deg=tilt,
            azimuth_deg=azimuth,
            distance_m=distance_m,
            walk_round=True,
            aim_m=(0.0, 0.0, 0.0),
        )
        for tilt in _DENSER_TILTS_DEG
        for azimuth in _DENSER_AZIMUTHS_DEG
    ]


def _place(spot: PlannedPlace) -> WantedView:
    return place_at(
        spot.name,
        tilt_deg=spot.tilt_deg,
        azimuth_deg=spot.azimuth_deg,
        distance_m=spot.distance_m,
        walk_round=spot.walk_round,
        aim_m=spot.aim_m,
    )


_SAME_M, _SAME_RAD = 0.02, np.deg2rad(3.0)  # an image nearer than this to another one repeats it


@dataclass(frozen=True, slots=True)
class NewImage:
    """The facts that can be determined from the new image alone.

    Attributes:
        T_scene_camera: the camera's pose, (4, 4); None if it cannot be determined.
        why: the reason why it cannot be used; "" if it can.
        measures: the numbers of this image.
        information: (6, 6) information about the scan's pose.
        up: (3,) direction away from the table, frame of the scene.
        middle_m: (3,) middle of the scene.
        cells: the number of board corners in each cell of the frame.
        reading: the outlines and spheres, where the spheres have not been measured.
    """

    T_scene_camera: Transform | None
    why: str
    measures: Mapping[str, float]
    information: Array = field(repr=False)
    up: Array
    middle_m: Array
    cells: NDArray[np.int64] = field(repr=False)
    reading: ImageReading | None = field(default=None, repr=False)


def answer_to(
    context: JobContext[_H], found: NewImage, scene: CaptureScene, earlier: Sequence[HandheldImage]
) -> JobAnswer:
    """Judge the new image by those before it, and write its file."""
    arguments = context.arguments
    used = [view for view in earlier if view.used and view.T_scene_camera is not None]
    T = found.T_scene_camera
    why = arguments.image.settings or found.why or _repeats(T, used)
    new = HandheldImage(
        viewpoint=arguments.image.viewpoint,
        used=not why,
        T_scene_camera=T,
        T_scene_level=_level(found, earlier),
        information=found.information,
        seen=scene.seen_from(T),
        cells=found.cells,
        reading=found.reading,
        spheres_m=scene.spheres_m,
    )
    good = [*used, new] if new.used and T is not None else used
    guide = HandGuide(arguments, scene, new, earlier, good)
    measures = {**found.measures, **guide.totals()}
    ref = context.keep_json(new.plain(rough=arguments.rough), kind="hand_view", name=f"{new.viewpoint}.hand.json")
    answer = _result(guide, why)
    if arguments.rough:
        answer = _refined(answer, guide, used)
    return JobAnswer(finite(measures), (ref,), answer)


def _level(found: NewImage, earlier: Sequence[HandheldImage]) -> Transform | None:
    """Return T_scene_level of the first image that had one, else of this image if its pose is known."""
    level = next((view.T_scene_level for view in earlier if view.T_scene_level is not None), None)
    if level is None and found.T_scene_camera is not None:
        level = level_frame(found.middle_m, found.up, -found.T_scene_camera[:3, 1])
    return level


def _result(guide: HandGuide, why: str) -> HandViewAnswer:
    new, done = guide.new, guide.done()
    next_words, target = guide.next_place()
    T, level = new.T_scene_camera, new.T_scene_level
    cells = [view.cells for view in guide.good if view.cells.size]
    return HandViewAnswer(
        viewpoint=new.viewpoint,
        used=new.used,
        why=why,
        words=next_words,
        target=None if target is None else PlaceStatus(name=target.name, T_level_camera=_pose(target)),
        T_scene_camera=None if T is None else matrix(T),
        T_level_camera=None if T is None or level is None else matrix(inverse(level) @ T),
        places=tuple(
            PlaceStatus(name=place.name, T_level_camera=_pose(place), done=place.name in done)
            for place in guide.places()
        ),
        cells=np.sum(cells, axis=0).tolist() if new.cells.size else (),
    )


def _refined(answer: HandViewAnswer, guide: HandGuide, used: Sequence[HandheldImage]) -> HandViewAnswer:
    """Add the spheres and all camera poses, as estimated from the images, to the answer."""
    poses = {v.viewpoint: v.T_scene_camera for v in [*used, guide.new] if v.T_scene_camera is not None}
    spheres_m: tuple[Point, ...] = tuple((float(x), float(y), float(z)) for x, y, z in guide.scene.spheres_m)
    return answer.model_copy(update={"spheres_m": spheres_m, "T_scene_cameras": matrices(poses)})


def _pose(place: WantedView) -> Matrix:
    return matrix(place.T_level_camera)


def _repeats(T: Transform | None, used: Sequence[HandheldImage]) -> str:
    """Return why an image adds nothing to the earlier ones, or ""."""
    if T is None:
        return ""
    same = [
        view.viewpoint
        for view in used
        if view.T_scene_camera is not None and same_view(view.T_scene_camera, T, _SAME_M, _SAME_RAD)
    ]
    return f"it repeats {same[0]}" if same else ""


def hand_view(context: JobContext[HandViewArguments]) -> JobAnswer:
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


def _scene(context: JobContext[HandViewArguments]) -> tuple[CaptureScene, list[HandheldImage]]:
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


def hand_board(context: JobContext[HandBoardArguments]) -> JobAnswer:
    """Locate the camera by the board, with nominal intrinsics."""
    cv2.setNumThreads(1)
    arguments = context.arguments
    board = Board(arguments.columns, arguments.rows, arguments.square_m)
    grey = read_grey(context.input(arguments.image.sha256))
    size = (grey.shape[1], grey.shape[0])
    camera = nominal_camera(*size, arguments.image.focal_mm, arguments.sensor_width_mm)
    scene = CaptureScene(camera, np.zeros((0, 3)), 0.0, limits_of(arguments.limits), None)
    pose, why, measures, cells = None, "", {}, np.zeros((0, 0), dtype=np.int64)
    try:
        corners = find_board(grey, board)
        T_camera_board, rms_px = locate_view(corners, board, camera)
    except ComputeError as error:
        why = error.what
    else:
        pose, cells = inverse(T_camera_board), coverage_map_of([corners.corners], size)
        measures = {"corners": float(len(corners.indices)), "nominal_rms_px": rms_px}
    up = np.array([0.0, 0.0, -1.0])  # the board's z axis points into the table
    found = NewImage(pose, why, measures, np.zeros((6, 6)), up, board.points().mean(axis=0), cells)
    return answer_to(context, found, scene, read_views(context, scene))
