"""A further camera's pose from the spheres in its images: in the scan's frame, or in the first camera's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.further_cameras.pose_covariances import of_inverse, of_product
from service.compute.registration.further_cameras.rigid_mean import RigidMean, rigid_mean
from service.compute.registration.identification.identity import Assignment, identify_each
from service.compute.registration.identification.pairing import paired
from service.compute.registration.settings import RegistrationSettings
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse

_LEAST_SPHERES = 4  # with four, a wrong assignment contradicts itself
_FLOOR = np.diag([1e-7] * 3 + [1e-7] * 3) ** 2  # keeps the covariance of an outline without noise invertible


@dataclass(frozen=True, slots=True)
class SightedPose:
    """The pose of a camera from the spheres in one of its images.

    Attributes:
        T_scan_camera: (4, 4).
        noise: (6, 6) covariance due to the noise of the outlines, which differs between images.
        common: (6, 6) covariance due to errors of spheres, lens and edges, which many images share.
        spheres: number of them.
        rms_px: of their outlines.
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
        mean: of the views' poses; its covariance is that of their noise alone.
        covariance: (6, 6) of the mean, with what is common to the views.
        names: of the views, in the order of the mean's.
    """

    mean: RigidMean
    covariance: Array = field(repr=False)
    names: tuple[str, ...] = field(repr=False)


@dataclass(frozen=True, slots=True)
class OuterFrame:
    """The first camera while a further one exposed.

    Attributes:
        T_scan_first: (4, 4) its pose.
        covariance: (6, 6) of that, the part that is common to all views.
    """

    T_scan_first: Transform = field(repr=False)
    covariance: Array = field(repr=False)


def sighted_pose(
    outlines: Sequence[SphereOutline], camera: CameraModel, spheres: ScanSpheres, lens: Array | None
) -> SightedPose:
    """The pose of a camera from the outlines in one image, which tell which sphere is which.

    Args:
        outlines: of the image.
        camera: its intrinsics.
        spheres: in the frame of the scan.
        lens: (8, 8) covariance of fx, fy, cx, cy, k1, k2, p1, p2; None: exact.

    Raises:
        ComputeError: too few spheres, or more than one way to tell them apart.
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
    """T_scan_camera of a camera that stood still.

    It saw each sphere at the same pixels in every image. What the outlines err there is the same in each, so many
    images are no more certain than one; they show whether the camera was moved.

    Raises ComputeError: there is no view.
    """
    return _joined({name: (v.T_scan_camera, v.noise, v.noise + v.common) for name, v in views.items()})


def rigid_pose(views: Mapping[str, SightedPose], first: Mapping[str, OuterFrame]) -> FurtherPose:
    """T_first_camera of a camera beside the first one, from the views at which the first one's pose is known.

    What both cameras' poses have in common by the spheres is counted twice, which states more than there is.

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
    return _joined(found)


def _joined(views: Mapping[str, tuple[Transform, Array, Array]]) -> FurtherPose:
    if not views:
        raise ComputeError("no image shows four spheres that can be told apart")
    poses, noise, common = (np.array(part) for part in zip(*views.values(), strict=True))
    mean = rigid_mean(poses, noise)
    return FurtherPose(mean, mean.covariance + common[mean.kept].mean(axis=0), tuple(views))
