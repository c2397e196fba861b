"""Finds a further camera's pose from the spheres in its images: in the scan's frame, or in the first camera's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton
from service.compute.markers.records import SphereOutline
from service.compute.registration.hypotheses import paired
from service.compute.registration.identity import Assignment, identify_each
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.result import of_inverse, of_product
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, increment, inverse

_OUTLIER_CHI2 = 22.46  # of six degrees of freedom: exceeded by chance once in a thousand
_MEDIAN_CHI2 = 5.348  # of six degrees of freedom
_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class RigidMean:
    """The mean of N poses.

    Attributes:
        T: (4, 4) T_a_b.
        covariance: (6, 6) covariance of (d, w) of `T`: exp([w]x) R, t + d, m and rad. It follows the scatter of the
            poses where that is larger than their given covariances.
        chi2_reduced: reduced chi square of the poses in the mean against their given covariances; 1 for a single
            pose.
        kept: (N,) true for poses that agree with the mean.
        deviations: (N, 6) deviation (d, w) of every pose from the mean, m and rad.
    """

    T: Transform
    covariance: Array = field(repr=False)
    chi2_reduced: float
    kept: NDArray[np.bool_] = field(repr=False)
    deviations: Array = field(repr=False)

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the poses in the mean from the mean."""
        return _rms(self.deviations[self.kept, :3])

    @property
    def rms_rad(self) -> float:
        """Root mean square angle of the poses in the mean from the mean."""
        return _rms(self.deviations[self.kept, 3:])


def rigid_mean(poses: Array, covariances: Array) -> RigidMean:
    """Return the pose T on which most of N independent measurements of it agree, weighted by their covariances.

    It minimises the sum of squared Mahalanobis distances of the poses that agree; the others are excluded. A distance
    is judged against the given covariances times a common factor, the median distance over its expectation, if that
    is above 1: so the poses may scatter more than given, as long as few stand out. If all contradict one another,
    none is excluded, and `covariance`, `chi2_reduced` and `rms_m` show it.

    Args:
        poses: (N, 4, 4) measurements of T.
        covariances: (N, 6, 6) covariance of (d, w) of each, positive definite.

    Raises:
        DataError: the shapes do not agree, or there is no pose.
    """
    n = len(poses)
    if n == 0 or poses.shape != (n, 4, 4) or covariances.shape != (n, 6, 6):
        raise DataError(f"{poses.shape} poses and {covariances.shape} covariances")
    weights = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
    mean, kept = poses[_middle(poses, weights)], np.ones(n, dtype=np.bool_)
    for _ in range(_ROUNDS):  # the nearer a pose, the more it counts, so that the start does not decide
        chi2 = _chi2(_deviations(poses, mean), weights)
        nearness = 1.0 / (1.0 + chi2 / (6 * _scatter(chi2)))
        mean = _mean(poses, weights * nearness[:, None, None], mean)
    for _ in range(_ROUNDS):
        chi2 = _chi2(_deviations(poses, mean), weights)
        agree = chi2 <= _OUTLIER_CHI2 * _scatter(chi2)
        mean = _mean(poses[agree], weights[agree], mean)
        if np.array_equal(agree, kept):
            break
        kept = agree
    deviations = _deviations(poses, mean)
    chi2 = _chi2(deviations[kept], weights[kept])
    count = int(kept.sum())
    reduced = float(chi2.sum() / (6 * (count - 1))) if count > 1 else 1.0
    covariance = max(1.0, reduced) * np.linalg.inv(weights[kept].sum(axis=0))
    return RigidMean(mean, covariance, reduced, kept, deviations)


def _middle(poses: Array, weights: Array) -> int:
    """Return the pose from which the median distance to all poses is least."""
    return int(np.argmin([np.median(_chi2(_deviations(poses, T), weights)) for T in poses]))


def _scatter(chi2: Array) -> float:
    return max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)


def _mean(poses: Array, weights: Array, start: Transform) -> Transform:
    total = np.linalg.inv(weights.sum(axis=0))

    def step(T: Transform) -> Array:
        return total @ np.einsum("nij,nj->i", weights, _deviations(poses, T))

    return gauss_newton(start, step, lambda T, d: increment(T, d[:3], d[3:]), most=_ROUNDS, settled=1e-12)


def _deviations(poses: Array, T: Transform) -> Array:
    """Return (N, 6) (d, w) with which T becomes each pose."""
    turned = Rotation.from_matrix(poses[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    return np.hstack([poses[:, :3, 3] - T[:3, 3], turned])


def _chi2(deviations: Array, weights: Array) -> Array:
    return np.einsum("ni,nij,nj->n", deviations, weights, deviations)


def _rms(rows: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1)))) if len(rows) else 0.0


_LEAST_SPHERES = 4  # with four, a wrong assignment contradicts itself
_FLOOR = np.diag([1e-7] * 3 + [1e-7] * 3) ** 2  # keeps the covariance of an outline without noise invertible


@dataclass(frozen=True, slots=True)
class SightedPose:
    """The pose of a camera from the spheres in one of its images.

    Attributes:
        T_scan_camera: (4, 4) the camera's pose in the scan frame.
        noise: (6, 6) covariance due to the noise of the outlines, which differs between images.
        common: (6, 6) covariance due to errors of spheres, lens and edges, which many images share.
        spheres: number of spheres.
        rms_px: root mean square residual of their outlines.
    """

    T_scan_camera: Transform = field(repr=False)
    noise: Array = field(repr=False)
    common: Array = field(repr=False)
    spheres: int
    rms_px: float


@dataclass(frozen=True, slots=True)
class FurtherPose:
    """A further camera in its outer frame: that of the scan, or of the first camera.

    Attributes:
        mean: mean of the views' poses; its covariance is that of their noise alone.
        covariance: (6, 6) covariance of the mean, with what is common to the views.
        names: names of the views, in the order of the mean's.
    """

    mean: RigidMean
    covariance: Array = field(repr=False)
    names: tuple[str, ...] = field(repr=False)


@dataclass(frozen=True, slots=True)
class OuterFrame:
    """The first camera while a further one exposed.

    Attributes:
        T_scan_first: (4, 4) its pose in the scan frame.
        covariance: (6, 6) the part of its pose's covariance that is common to all views.
    """

    T_scan_first: Transform = field(repr=False)
    covariance: Array = field(repr=False)


def sighted_pose(
    outlines: Sequence[SphereOutline], camera: CameraModel, spheres: ScanSpheres, lens: Array | None
) -> SightedPose:
    """Compute the pose of a camera from the outlines in one image, which show which sphere is which.

    Args:
        outlines: the image's outlines.
        camera: its intrinsics.
        spheres: the spheres in the frame of the scan.
        lens: (8, 8) covariance of fx, fy, cx, cy, k1, k2, p1, p2; None: exact.

    Raises:
        ComputeError: too few spheres, or more than one way to identify them.
    """
    (read,) = identify_each([outlines], camera, spheres)
    if read.T_camera_scan is None:
        raise ComputeError("the spheres cannot be told apart")
    markers = paired(outlines, read.T_camera_scan, spheres.centres_m, spheres.radius_m, camera)
    if len(markers) < _LEAST_SPHERES:
        raise ComputeError(f"{len(markers)} spheres are seen, {_LEAST_SPHERES} are needed")
    settings = RegistrationSettings(pose_covariance="exact", intrinsics_covariance=lens)
    still = PosedImages(np.eye(4)[None], camera)  # the camera is the world
    solved = register([outlines], [Assignment(markers, read.T_camera_scan)], still, spheres, settings)
    T = solved.T_world_scan
    parts = {name: of_inverse(T, part[:6, :6]) for name, part in solved.components.items()}
    noise = parts.pop("outlines") + _FLOOR
    return SightedPose(
        inverse(T), noise, np.sum(list(parts.values()), axis=0), len(markers) - len(solved.excluded), solved.rms_px
    )


def fixed_pose(views: Mapping[str, SightedPose]) -> FurtherPose:
    """Return T_scan_camera of a camera that stood still.

    It saw each sphere at the same pixels in every image. What the outlines err there is the same in each, so many
    images are no more certain than one; they show whether the camera was moved.

    Raises ComputeError: there is no view.
    """
    return _mean_pose({name: (v.T_scan_camera, v.noise, v.noise + v.common) for name, v in views.items()})


def rigid_pose(views: Mapping[str, SightedPose], first: Mapping[str, OuterFrame]) -> FurtherPose:
    """Return T_first_camera of a camera beside the first one, from the views at which the first one's pose is known.

    What both cameras' poses have in common by the spheres is counted twice, which overstates it.

    Raises ComputeError: there is no such view.
    """
    nothing = np.zeros((6, 6))
    found: dict[str, tuple[Transform, Array, Array]] = {}
    for name, view in views.items():
        if name not in first:
            continue
        outer = first[name]
        T_first_scan = inverse(outer.T_scan_first)
        known = of_inverse(outer.T_scan_first, outer.covariance)
        noise = of_product(T_first_scan, view.T_scan_camera, nothing, view.noise)
        common = of_product(T_first_scan, view.T_scan_camera, known, view.common)
        found[name] = (T_first_scan @ view.T_scan_camera, noise, common)
    return _mean_pose(found)


def _mean_pose(views: Mapping[str, tuple[Transform, Array, Array]]) -> FurtherPose:
    if not views:
        raise ComputeError("no image shows four spheres that can be told apart")
    poses, noise, common = (np.array(part) for part in zip(*views.values(), strict=True))
    mean = rigid_mean(poses, noise)
    return FurtherPose(mean, mean.covariance + common[mean.kept].mean(axis=0), tuple(views))
