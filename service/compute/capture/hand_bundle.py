"""Adjusts unmeasured spheres and camera poses together, from the outlines of all images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.layout.photo_adjustment import CALIBRATED, SpherePhotograph, adjust
from service.compute.markers.cones import Cone
from service.compute.markers.records import SphereOutline
from service.compute.registration.cost import EXPECTED_COMMON_ERRORS
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, inverse

_WORST_CHI2 = 20.0  # per degree of freedom: above it, the spheres of some image were mixed up
_LEAST_SPHERES = 4


@dataclass(frozen=True, slots=True)
class ImageReading:
    """One image's contribution: n outlines with their spheres' numbers, and the camera pose from this image alone."""

    viewpoint: str
    T_scene_camera: Transform
    spheres: NDArray[np.int64]  # (n,)
    axes: Array  # (n, 3)
    half_angles_rad: Array  # (n,)
    covariances: Array  # (n, 3, 3), as SphereOutline.cone_covariance

    @classmethod
    def of(cls, viewpoint: str, T_scene_camera: Transform, shown: Mapping[int, SphereOutline]) -> ImageReading:
        """From an image's outlines by sphere."""
        outlines = list(shown.values())
        return cls(
            viewpoint,
            T_scene_camera,
            np.array(list(shown), dtype=np.int64),
            np.array([o.cone.axis for o in outlines]).reshape(-1, 3),
            np.array([o.cone.half_angle_rad for o in outlines]),
            np.array([o.cone_covariance for o in outlines]).reshape(-1, 3, 3),
        )

    def of_spheres(self, numbers: NDArray[np.int64]) -> ImageReading:
        """The reading with these spheres only."""
        kept = np.isin(self.spheres, numbers)
        return replace(
            self,
            spheres=self.spheres[kept],
            axes=self.axes[kept],
            half_angles_rad=self.half_angles_rad[kept],
            covariances=self.covariances[kept],
        )

    def record(self) -> dict[str, Any]:
        """The reading as plain data, as `read` takes it."""
        return {
            "spheres": self.spheres.tolist(),
            "axes": self.axes.tolist(),
            "half_angles_rad": self.half_angles_rad.tolist(),
            "covariances": self.covariances.tolist(),
        }

    @classmethod
    def read(cls, viewpoint: str, T_scene_camera: Transform, data: Mapping[str, Any]) -> ImageReading:
        """Read plain data written by `record`."""
        return cls(
            viewpoint,
            T_scene_camera,
            np.array(data["spheres"], dtype=np.int64),
            np.array(data["axes"]).reshape(-1, 3),
            np.array(data["half_angles_rad"]),
            np.array(data["covariances"]).reshape(-1, 3, 3),
        )

    def photograph(self, camera: CameraModel) -> SpherePhotograph:
        """The reading as input of the adjustment."""
        cones = tuple(Cone(axis, float(half)) for axis, half in zip(self.axes, self.half_angles_rad, strict=True))
        return SpherePhotograph(camera, cones, self.covariances)


@dataclass(frozen=True, slots=True)
class AdjustedCapture:
    """The adjusted spheres and poses.

    Attributes:
        spheres_m: (N, 3) in the frame in which they were given; a sphere seen in fewer than two images is unchanged.
        known: numbers of the spheres seen in at least two images.
        sigma_m: standard deviation of the least certain of these against the others.
        poses: T_scene_camera by viewpoint.
    """

    spheres_m: Array
    known: NDArray[np.int64]
    sigma_m: float
    poses: Mapping[str, Transform]


def adjust_together(
    readings: Sequence[ImageReading], spheres_m: Array, camera: CameraModel, radius_m: float
) -> AdjustedCapture | None:
    """Refine spheres (N, 3) and cameras from the outlines of all images.

    Spheres seen in only one image take no part, because one image determines their distance poorly. None if fewer
    than two images show four of the others, or if the images do not fit together.
    """
    counts = np.zeros(len(spheres_m), dtype=np.int64)
    for reading in readings:
        counts[reading.spheres] += 1
    shared = np.nonzero(counts >= 2)[0]
    number = np.full(len(spheres_m), -1, dtype=np.int64)
    number[shared] = np.arange(len(shared))
    joined = [r.of_spheres(shared) for r in readings]
    joined = [r for r in joined if len(r.spheres) >= _LEAST_SPHERES]
    if len(joined) < 2 or len(np.unique(np.concatenate([r.spheres for r in joined]))) < len(shared):
        return None
    first = joined[0].T_scene_camera
    try:
        found = adjust(
            [r.photograph(camera) for r in joined],
            [number[r.spheres] for r in joined],
            apply(inverse(first), spheres_m[shared]),
            [inverse(r.T_scene_camera) @ first for r in joined],
            radius_m,
            CALIBRATED,
        )
    except ComputeError:
        return None
    if found.chi2 > _WORST_CHI2:
        return None
    T_scene_first, _ = align_points(spheres_m[shared], found.centres_m)
    refined = spheres_m.copy()
    refined[shared] = apply(T_scene_first, found.centres_m)
    poses = {r.viewpoint: T_scene_first @ inverse(T) for r, T in zip(joined, found.T_photo_first, strict=True)}
    halves = np.concatenate([r.half_angles_rad for r in joined])
    scale_sigma = EXPECTED_COMMON_ERRORS.growth_px / (camera.fx * float(np.tan(np.median(halves))))
    return AdjustedCapture(refined, shared, _worst_sigma_m(found.centres_m, found.covariance, scale_sigma), poses)


def _worst_sigma_m(centres_m: Array, covariance: Array, scale_sigma: float) -> float:
    """Worst standard deviation of the shape alone, without position and rotation of the whole.

    The spheres' radius is the only length in the images, so outlines that are all too wide make the whole too small.
    """
    away = centres_m - centres_m.mean(axis=0)
    turns = np.stack([np.cross(axis, away).ravel() for axis in np.eye(3)], axis=1)
    free, _ = np.linalg.qr(np.hstack([np.tile(np.eye(3), (len(away), 1)), turns]))
    shape = np.eye(len(free)) - free @ free.T
    own = (shape @ covariance @ shape.T).reshape(len(away), 3, len(away), 3)
    of_scale = scale_sigma**2 * np.sum(away**2, axis=1)
    return float(np.sqrt((np.einsum("ijij->i", own) + of_scale).max()))
