"""The scene of a capture: the camera, the spheres and the specimen's surface that new images are judged by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.computations.conversion import camera_of
from service.computations.hand_view import HeldArguments
from service.computations.job import JobContext
from service.computations.live_view import LiveArguments
from service.computations.records import Limits
from service.compute.camera_model import CameraModel
from service.compute.planning.coverage import CoverageLimits, CoverageSurface, seen
from service.core.geometry import Array, Transform

_L = TypeVar("_L", bound=LiveArguments)
_A = TypeVar("_A", bound=LiveArguments | HeldArguments)


@dataclass(frozen=True, slots=True)
class CaptureScene:
    """The camera, spheres and surface by which the images of a capture are judged.

    Attributes:
        camera: the calibrated camera or, for images of the board, the nominal one.
        spheres_m: (S, 3) centres, frame of the scene.
        radius_m: the spheres' radius.
        limits: the conditions on which a view counts for a point of the surface.
        surface: the specimen's surface; None without a CT, and until it is computed.
    """

    camera: CameraModel
    spheres_m: Array
    radius_m: float
    limits: CoverageLimits
    surface: CoverageSurface | None

    @property
    def n_points(self) -> int:
        """Number of points of the surface."""
        return 0 if self.surface is None else len(self.surface.points_m)

    def seen_from(self, T_scene_camera: Transform | None) -> NDArray[np.bool_]:
        """Return the mask (P,) of the surface's points that a view shows; none where its pose is not known."""
        if self.surface is None or T_scene_camera is None:
            return np.zeros(self.n_points, dtype=bool)
        return seen(self.surface, T_scene_camera[:3, 3], self.limits, T_scene_camera, self.camera)

    def targets_m(self) -> Array:
        """Return the points (T, 3) at which the registration's error is predicted: some 200, or the spheres."""
        if self.surface is None:
            return self.spheres_m
        return self.surface.points_m[:: max(1, self.n_points // 200)]


def live_scene(context: JobContext[_L]) -> CaptureScene:
    """Return the scene of a job on the images of a capture by the robot."""
    arguments = context.arguments
    return CaptureScene(
        camera_of(arguments.camera),
        np.array(arguments.spheres_m),
        arguments.radius_m,
        limits_of(arguments.limits),
        kept_surface(context),
    )


def kept_surface(context: JobContext[_A]) -> CoverageSurface | None:
    """Return the specimen's surface from the file of the job `coverage_points`; None without such a file."""
    sha256 = context.arguments.surface
    return None if sha256 is None else _surface_in(context.input(sha256))


@lru_cache(maxsize=1)
def _surface_in(artefact: Path) -> CoverageSurface:
    """Return the surface in an artefact, whose file never changes, with its tree of rays, slow to build."""
    with np.load(artefact, allow_pickle=False) as arrays:
        return CoverageSurface(**{name: arrays[name] for name in arrays.files})


def limits_of(record: Limits) -> CoverageLimits:
    """Return the limits of a job's record."""
    return CoverageLimits(record.max_angle_deg, record.max_distance_m, record.min_views)
