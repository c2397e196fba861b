"""Where a hand-held camera should go next: the planned place that is nearest, or the view that would help most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.compute.live import expected_spheres
from service.compute.planning.coverage import covered_fraction
from service.compute.planning.hand_guidance import WantedView, covered, nearest, place_at, words
from service.compute.planning.next_views import (
    CurrentInformation,
    ViewGain,
    lens_covariance_of_pose,
    next_best_views,
    predicted_information,
)
from service.compute.registration.cost import EXPECTED_COMMON_ERRORS
from service.core.geometry import Array, Transform, inverse
from service.core.units import mm
from service.jobs.capture import hand_view as job
from service.jobs.capture.hand_view import HeldArguments, PlannedPlace
from service.worker.camera import lens_covariance
from service.worker.capture.held_images import HandheldImage
from service.worker.capture.scene import CaptureScene

_LOST_AFTER = 1  # earlier images in a row that do not show where the camera was
AGAIN = "take this one again: hold the camera still, with everything in view and nothing before the lens"
_DENSER_TILTS_DEG, _DENSER_AZIMUTHS_DEG = (10.0, 25.0, 40.0, 48.0), tuple(np.arange(-180.0, 180.0, 30.0))
_TYPICAL_PX = 0.08  # standard deviation of an outline, for views that are only planned


@dataclass(frozen=True, slots=True)
class HandGuide:
    """The state of a capture by hand after one more image.

    Attributes:
        arguments: of the job.
        scene: with the spheres as they are known now.
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
        """The planned places."""
        return [_place(spot) for spot in self.arguments.places]

    def done(self) -> set[str]:
        """Names of the planned places that have an image."""
        level = self.new.T_scene_level
        return covered(self.places(), [] if level is None else self._poses(level), self.arguments.within_deg)

    def totals(self) -> dict[str, float]:
        """The numbers of all images that count."""
        places, measures = self.places(), {"images_used": float(len(self.good))}
        measures["hemisphere_coverage"] = len(self.done()) / len(places)
        if not isinstance(self.arguments, job.Arguments) or not len(self.scene.spheres_m):
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
        """Directions to the next place, and the place; those for the first image if the pose was lost repeatedly."""
        T, level = self.new.T_scene_camera, self.new.T_scene_level
        if T is None or level is None:
            return (self.arguments.first_words if self._lost() >= _LOST_AFTER else AGAIN), None
        here = inverse(level) @ T
        done, places = self.done(), self.places()
        left = [place for place in places if place.name not in done]
        target = nearest(left, here) if left else None
        if target is None and isinstance(self.arguments, job.Arguments) and len(self.scene.spheres_m):
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

    def _information(self, arguments: job.Arguments) -> CurrentInformation:
        """The images as measurements of the scan's pose, with the camera poses expected of structure from motion."""
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

    def _shared(self, arguments: job.Arguments) -> Array:
        """(6, 6) covariance that all images share, as the error budget counts it: edges, calibration and scan."""
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

    def _most_helpful(self, arguments: job.Arguments, T_scene_level: Transform) -> WantedView | None:
        """The most helpful view of a denser hemisphere, once every planned place has its image."""
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
