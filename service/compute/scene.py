"""What registrations share: posed images of one camera, a scan's spheres, and what is found of a control sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array


@dataclass(frozen=True, slots=True, eq=False)
class PosedImages:
    """N images of one camera, with their poses.

    Attributes:
        poses: (N, 4, 4) T_world_camera, or T_base_camera in the base frame of each image's station.
        camera: intrinsics of all images.
        groups: (N,) station of each image; images of one station share a base frame. None: all the same.
        metric: true if the positions are in metres; if not, their scale is estimated.
        names: names of the images, for messages and results; empty: "image 0", "image 1" and so on.
    """

    poses: Array = field(repr=False)
    camera: CameraModel
    groups: Sequence[int] | NDArray[np.int64] | None = None
    metric: bool = True
    names: Sequence[str] = ()

    @property
    def stations(self) -> NDArray[np.int64]:
        """(N,) station of each image."""
        if self.groups is None:
            return np.zeros(len(self.poses), dtype=np.int64)
        return np.asarray(self.groups, dtype=np.int64)

    @property
    def labels(self) -> list[str]:
        """A name for each image."""
        return list(self.names) or [f"image {i}" for i in range(len(self.poses))]

    def require(self, n: int) -> None:
        """Check that there is a finite pose and a station for each of `n` images.

        Raises:
            DataError: there is not.
        """
        if self.poses.shape != (n, 4, 4) or len(self.stations) != n:
            raise DataError(f"{n} images, but {len(self.poses)} poses and {len(self.stations)} stations")
        if not np.all(np.isfinite(self.poses)):
            raise DataError("a camera pose holds a number that is not finite")


@dataclass(frozen=True, slots=True, eq=False)
class ScanSpheres:
    """Spheres in the frame of a scan, all of one radius.

    Attributes:
        centres_m: (M, 3) registration spheres.
        radius_m: radius of all spheres.
        control_m: (C, 3) control spheres, which only the evaluation uses.
        covariance_m2: (M, 3, 3) covariance of the registration spheres' centres; None takes them as exact.
    """

    centres_m: Array = field(repr=False)
    radius_m: float
    control_m: Array = field(default_factory=lambda: np.zeros((0, 3)), repr=False)
    covariance_m2: Array | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class ControlSphere:
    """The evaluation of one control sphere.

    Attributes:
        index: its index in the list of control spheres.
        expected: number of images that should show it.
        measured: number of images in which it was measured.
        radial_error_mm: mean radial error over its outlines; None if it was not measured.
        reprojection_error_px: mean reprojection error over its outlines.
        displacement_mm: distance from where scan and registration put it to where the images see it; None below three
            images.
        displacement_sigma_mm: standard deviation of the displacement, as far as the outlines determine it.
        finding: the fault, and the remedy; "" if there is none.
    """

    index: int
    expected: int
    measured: int
    radial_error_mm: float | None = None
    reprojection_error_px: float | None = None
    displacement_mm: float | None = None
    displacement_sigma_mm: float | None = None
    finding: str = ""

    @property
    def share(self) -> float:
        """Share of the expected outlines that were measured, 1 if none was expected."""
        return min(1.0, self.measured / self.expected) if self.expected else 1.0
