"""Processes each new image during the capture: finds its spheres and registers all images so far.

The first images of a station are searched whole; from then on the registration predicts the spheres, and only their
regions are searched (markers/search/predicted.py). Each station is an independent problem, since its robot poses are
in a base frame of its own, so only the new image's station is solved again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import image_quality
from service.compute.markers.records import SphereOutline
from service.compute.markers.rough import profiles, sample
from service.compute.registration.hypotheses import paired
from service.compute.registration.identity import Assignment, identify
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse

_FULL_SCALE = 254  # of 255: JPEG changes a clipped 255 by one
_MARGIN = 1.1  # of the outline's radius: spheres nearer to the image's border are not expected to be found


@dataclass(frozen=True, slots=True)
class LiveView:
    """One image with its outlines, as input of the provisional registration."""

    name: str
    T_base_camera: Transform  # (4, 4) from robot pose and hand-eye, in its station's base frame
    outlines: tuple[SphereOutline, ...] = field(repr=False)


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Sharpness of the sphere outlines in an image."""

    edge_px: float  # median width of the luma step across the outlines; NaN without outlines
    coverage: float  # median share of an outline with accepted edge points
    rms_px: float  # median rms distance of edge points from their own outline


@dataclass(frozen=True, slots=True)
class ProvisionalRegistration:
    """The registration of one station's images so far.

    `registration.residuals` count the `used` images. `T_base_scan` maps the scan (or CT) frame to the station's base.
    """

    T_base_scan: Transform
    registration: RegistrationResult = field(repr=False)
    used: tuple[str, ...]  # images with spheres assigned, in the order of the registration

    def predicted_error_m(self, point_scan_m: Array) -> float:
        """Predict the standard deviation (3D, metres) with which this station's images place a scan point (3,)."""
        return self.registration.sigma_at_m(point_scan_m)


def expected_spheres(T_camera_scan: Transform, spheres_m: Array, radius_m: float, camera: CameraModel) -> list[int]:
    """Return the indices of the spheres (M, 3) whose whole outline lies in the image, ignoring occlusion."""
    centres = apply(T_camera_scan, spheres_m)
    distance = np.linalg.norm(centres, axis=1)
    front = (centres[:, 2] > 0.3 * distance) & (distance > 2 * radius_m)
    out: list[int] = []
    for m in np.nonzero(front)[0]:
        x, y = camera.project(centres[m][None])[0]
        reach = _MARGIN * camera.fx * radius_m / distance[m] / (centres[m, 2] / distance[m])
        if reach <= x <= camera.width - 1 - reach and reach <= y <= camera.height - 1 - reach:
            out.append(int(m))
    return out


def register_station(
    views: Sequence[LiveView],
    spheres_m: Array,
    radius_m: float,
    camera: CameraModel,
    T_base_scan: Transform | None = None,
) -> ProvisionalRegistration:
    """Register the images of one station.

    Args:
        views: any number of images with their outlines.
        spheres_m: (M, 3) centres in the frame of the scan or the CT.
        T_base_scan: result of a registration of earlier images, by which spheres are identified; None: they are
            identified from scratch.

    Raises:
        ComputeError: the outlines do not determine an answer yet.
    """
    outlines = [view.outlines for view in views]
    poses = np.array([view.T_base_camera for view in views]).reshape(-1, 4, 4)
    if T_base_scan is None:
        assignments = identify(
            outlines, PosedImages(poses, camera, names=[v.name for v in views]), ScanSpheres(spheres_m, radius_m)
        )
    else:
        assignments = tuple(
            Assignment(paired(found, T, spheres_m, radius_m, camera), T)
            for found, T in ((o, inverse(p) @ T_base_scan) for o, p in zip(outlines, poses, strict=True))
        )
    keep = [i for i, assignment in enumerate(assignments) if assignment.markers]
    if not keep:
        raise ComputeError("no image shows a sphere where the registration expects one")
    answer = register(
        [outlines[i] for i in keep],
        [assignments[i] for i in keep],
        PosedImages(poses[keep], camera, groups=np.zeros(len(keep), dtype=np.int64)),
        ScanSpheres(spheres_m, radius_m),
    )
    return ProvisionalRegistration(answer.T_world_scan, answer, tuple(views[i].name for i in keep))


def sharpness(image_bgr: NDArray[np.uint8], outlines: Sequence[SphereOutline], camera: CameraModel) -> Sharpness:
    """Return the width of the luma step across the outlines, and the outlines' own quality.

    The width of an edge is its height over its steepest slope, in pixels; about 1.5 in a sharp image.
    """
    if not outlines:
        return Sharpness(float("nan"), 0.0, float("nan"))
    widths: list[float] = []
    for outline in outlines:
        where = profiles(outline.cone, camera, 64, np.arange(-8.0, 8.25, 0.5))
        values = np.asarray(sample(image_bgr, where.pixels), dtype=np.float64) @ [0.114, 0.587, 0.299]
        values = cv2.blur(values, (3, 1))
        step = np.abs(np.median(values[:, :6], axis=1) - np.median(values[:, -6:], axis=1))
        slope = np.abs(np.diff(values, axis=1)[:, 10:-10]).max(axis=1) / 0.5
        clear = (step > 12) & (slope > 0) & where.inside.all(axis=1)
        if clear.sum() >= 8:
            widths.append(float(np.median(step[clear] / slope[clear])))
    return Sharpness(
        float(np.median(widths)) if widths else float("nan"),
        float(np.median([o.coverage for o in outlines])),
        float(np.median([o.rms_px for o in outlines])),
    )


def clipped_fraction(image_bgr: NDArray[np.uint8]) -> float:
    """Return the share of pixels of an image (H, W, 3) with a clipped channel, from every sixteenth pixel."""
    return float(np.mean(image_bgr[::4, ::4].max(axis=2) >= _FULL_SCALE))


def image_measures(
    image_bgr: NDArray[np.uint8], outlines: Sequence[SphereOutline], camera: CameraModel
) -> tuple[dict[str, float], bool]:
    """Return the measures of an image (H, W, 3) as it arrives, by name, some NaN; and whether it is black."""
    quality = sharpness(image_bgr, outlines, camera)
    whole = image_quality(np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8))
    measures = {
        "image_edge_px": whole.edge_px,
        "outlines": float(len(outlines)),
        "outline_coverage": quality.coverage,
        "outline_rms_px": quality.rms_px,
        "edge_width_px": quality.edge_px,
        "clipped_fraction": clipped_fraction(image_bgr),
    }
    return measures, whole.black
