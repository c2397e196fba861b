"""One hand-held image: the camera pose from the spheres alone, and whether the image can be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.capture.live import clipped_fraction, expected_spheres, sharpness
from service.compute.layout.photographs import places_by_size
from service.compute.markers.cones import ObservedCones, fit_pose
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import DetectionOptions, SphereOutline
from service.compute.planning.information import ViewInformation, view_information
from service.compute.registration.hypotheses import paired
from service.compute.registration.identity import identify_each
from service.compute.scene import ScanSpheres
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse

_LEAST_SPHERES = 4  # with four, a wrong assignment contradicts itself
_LEAST_SHARE = 0.7  # of the spheres expected in the image; with fewer, something is in front of the lens
_MOST_EDGE_PX = 3.5  # edge width across an outline; a sharp image has about 1.5
_MOST_CLIPPED = 0.05  # of the pixels
_LEAST_BRIGHT = 60.0  # of 255: exceeded by at least a hundredth of the pixels
_ROUGH_M, _ROUGH_SIGMA_M = 0.012, 0.01  # difference between two layouts from photographs
_NO_POSE = (
    "{count} spheres found, which do not determine the camera pose: it may have moved, be out of focus or too near, "
    "or something may be in front of the lens"
)
_POSE_SIGMA_M = 2e-3  # outlines that contradict the image's own pose by more are not spheres of the list


@dataclass(frozen=True, slots=True)
class HandView:
    """The result of looking at one image.

    Attributes:
        T_scene_camera: (4, 4) in the spheres' frame; None if the spheres do not determine it.
        information: about the scan's pose relative to the camera; None without a pose.
        why: why the image is unusable; empty if it is good.
        shown: outlines by sphere.
    """

    T_scene_camera: Transform | None
    information: ViewInformation | None = field(repr=False)
    outlines: int
    spheres_seen: int
    spheres_expected: int
    edge_px: float
    rms_px: float
    clipped: float
    why: str
    shown: Mapping[int, SphereOutline] = field(default_factory=dict[int, SphereOutline], repr=False)


def look_at_image(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    spheres_m: Array,
    radius_m: float,
    options: DetectionOptions,
    *,
    rough: bool = False,
) -> HandView:
    """Search a whole image (H, W, 3) for the spheres (M, 3), without a predicted camera pose.

    Args:
        rough: whether the sphere centres come from photographs alone; they and the camera pose are then only good to
            some millimetres.
    """
    outlines = detect_spheres(image_bgr, camera, options)
    quality = sharpness(image_bgr, outlines, camera)
    clipped = clipped_fraction(image_bgr)
    found = _rough_pose(outlines, spheres_m, radius_m) if rough else _read(outlines, camera, spheres_m, radius_m)
    T_camera_scene, markers = pose_by_spheres(found, outlines, camera, spheres_m, radius_m)
    exposure = _exposure(image_bgr, clipped)
    if T_camera_scene is None:
        why = exposure or _NO_POSE.format(count=len(outlines))
        return HandView(None, None, len(outlines), 0, 0, quality.edge_px, quality.rms_px, clipped, why)
    T_scene_camera = inverse(T_camera_scene)
    expected = expected_spheres(T_camera_scene, spheres_m, radius_m, camera)
    information = view_information(
        T_scene_camera,
        np.eye(4),
        outlines,
        markers,
        ScanSpheres(spheres_m, radius_m),
        spheres_m.mean(axis=0),
        _ROUGH_SIGMA_M if rough else _POSE_SIGMA_M,
    )
    return HandView(
        T_scene_camera,
        information,
        len(outlines),
        len(markers),
        len(expected),
        quality.edge_px,
        quality.rms_px,
        clipped,
        exposure or _fault(quality.edge_px, len(markers), len(expected)),
        {sphere: outlines[o] for o, sphere in markers.items()},
    )


def _read(
    outlines: Sequence[SphereOutline], camera: CameraModel, spheres_m: Array, radius_m: float
) -> Transform | None:
    """T_camera_scene from the assignment on which the spheres agree; None if there is none."""
    if len(outlines) < _LEAST_SPHERES:
        return None
    try:
        (reading,) = identify_each([outlines], camera, ScanSpheres(spheres_m, radius_m))
    except ComputeError:
        return None
    return reading.T_camera_scan


def _rough_pose(outlines: Sequence[SphereOutline], spheres_m: Array, radius_m: float) -> Transform | None:
    """T_camera_scene by matching the spheres' positions in this image alone with those from other photographs."""
    places = places_by_size([outline.cone for outline in outlines], radius_m)
    if len(places) < _LEAST_SPHERES:
        return None
    try:
        return match_constellations(places, spheres_m, _ROUGH_M).T_a_b
    except ComputeError:
        return None


def pose_by_spheres(
    start: Transform | None,
    outlines: Sequence[SphereOutline],
    camera: CameraModel,
    spheres_m: Array,
    radius_m: float,
) -> tuple[Transform | None, dict[int, int]]:
    """T_camera_scene of one image and outline → sphere; None and {} if fewer than four spheres (M, 3) agree."""
    if start is None:
        return None, {}
    markers = paired(outlines, start, spheres_m, radius_m, camera)
    if len(markers) < _LEAST_SPHERES:
        return None, {}
    cones = ObservedCones.of(outlines[o].cone for o in markers)
    pose = fit_pose(cones, spheres_m[list(markers.values())], radius_m, start)
    return pose, paired(outlines, pose, spheres_m, radius_m, camera)


def _fault(edge_px: float, seen: int, expected: int) -> str:
    """What is wrong with an image whose camera pose is known; empty if nothing."""
    if edge_px > _MOST_EDGE_PX:
        return f"blurred: outlines are {edge_px:.1f} px wide; hold the camera still"
    if expected >= _LEAST_SPHERES and seen < _LEAST_SHARE * expected:
        return f"{seen} of {expected} spheres are seen: something is in front of the lens"
    return ""


def _exposure(image_bgr: NDArray[np.uint8], clipped: float) -> str:
    if clipped > _MOST_CLIPPED:
        return f"overexposed: {100 * clipped:.0f} % of the pixels are white"
    bright = float(np.percentile(image_bgr[::4, ::4].max(axis=2), 99))
    return f"underexposed: hardly a pixel is brighter than {bright:.0f} of 255" if bright < _LEAST_BRIGHT else ""
