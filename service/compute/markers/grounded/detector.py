"""The detectors `grounded` and `vote`: boxes and masks by networks, outlines by our own edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.files import read_image_of
from service.compute.markers.cones import Cone, cones_through, fit_cone
from service.compute.markers.detect import confirmed_outlines, detect_spheres
from service.compute.markers.grounded.boxes import find_boxes
from service.compute.markers.grounded.masks import sphere_masks
from service.compute.markers.grounded.networks import Networks, load_networks
from service.compute.markers.grounded.weights import Weights
from service.compute.markers.outlines.rough import RoughSphere, apart_rad
from service.compute.markers.paper_chain import MARGIN, MOST_LOSS, Box, EllipseEstimate, fit_ellipse, middle_colour
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline

_POINTS = 48  # of an ellipse, through which its cone is fitted
_SAME = 0.3  # of the half angle: outlines of two detectors so close are of one sphere
_SURE = 0.6  # coverage and score with which an outline counts that only one detector finds


@dataclass(frozen=True, slots=True)
class GroundedDetector:
    """The paper's chain on image files (supplement, "Ellipse Detection"), with our edges after its rough ellipse.

    `least` is the number of spheres below which the threshold of the boxes falls. With `vote`, the classical detector
    searches the image as well: an outline counts if both find it, or if one finds it whole and clear.
    """

    networks: Networks
    least: int
    vote: bool = False

    @classmethod
    def of(cls, weights: Weights, least: int, *, vote: bool = False) -> GroundedDetector:
        """With the weights of a folder; see `load_networks` for the errors raised."""
        return cls(load_networks(weights), least, vote)

    def __call__(self, path: Path, camera: CameraModel, options: DetectionOptions) -> tuple[SphereOutline, ...]:
        """The outlines in one image file, the most certain first.

        Raises:
            DataError: the file is not an image of the camera's size.
        """
        return self.detect(read_image_of(path, camera), camera, options)

    def detect(
        self, image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions = DEFAULTS
    ) -> tuple[SphereOutline, ...]:
        """The outlines in an image (H, W, 3) of the camera's size, the most certain first."""
        boxes = [_widened(box) for box in find_boxes(image_bgr, self.networks, self.least, options)]
        roughs: list[RoughSphere] = []
        for box, mask in zip(boxes, sphere_masks(image_bgr, boxes, self.networks), strict=True):
            if mask is not None and (rough := _rough(image_bgr, camera, fit_ellipse(mask, box))) is not None:
                roughs.append(rough)
        roughs.sort(key=lambda rough: -rough.score)
        outlines = confirmed_outlines(image_bgr, camera, roughs, options)
        return voted(outlines, detect_spheres(image_bgr, camera, options)) if self.vote else outlines


def voted(first: Sequence[SphereOutline], second: Sequence[SphereOutline]) -> tuple[SphereOutline, ...]:
    """The outlines that both detectors find, and the complete and clear ones of either; the best first."""
    out = [o for o in first if _shown_by(o, second) or _sure(o)]
    out += [o for o in second if _sure(o) and not _shown_by(o, first)]
    return tuple(sorted(out, key=lambda outline: -outline.score))


def _shown_by(outline: SphereOutline, others: Sequence[SphereOutline]) -> bool:
    return any(
        apart_rad(outline.cone, other.cone) < _SAME * outline.cone.half_angle_rad
        and abs(other.cone.half_angle_rad - outline.cone.half_angle_rad) < _SAME * outline.cone.half_angle_rad
        for other in others
    )


def _sure(outline: SphereOutline) -> bool:
    return outline.coverage > _SURE and outline.score > _SURE


def _widened(box: Box) -> Box:
    """The box with the margin that masks and ellipses expect around a sphere."""
    x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    half = 0.5 * (1 + MARGIN) * max(box[2] - box[0], box[3] - box[1])
    return x - half, y - half, x + half, y + half


def _rough(image_bgr: NDArray[np.uint8], camera: CameraModel, ellipse: EllipseEstimate) -> RoughSphere | None:
    """The cone through an ellipse in pixels; None if the ellipse does not fit its mask or is not an outline."""
    if ellipse.loss > MOST_LOSS:
        return None
    t = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False)
    c, s = np.cos(ellipse.theta_rad), np.sin(ellipse.theta_rad)
    along, across = ellipse.a * np.cos(t), ellipse.b * np.sin(t)
    pixels = np.stack([ellipse.x + c * along - s * across, ellipse.y + s * along + c * across], axis=1)
    rays = np.column_stack([camera.normalise(pixels), np.ones(_POINTS)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    third = _POINTS // 3
    axis, half = cones_through(rays[None, [0, third, 2 * third]])
    if not np.isfinite(half[0]):
        return None
    cone = fit_cone(rays, np.ones(_POINTS), Cone(axis[0], float(half[0])))
    return RoughSphere(cone, 1.0, 0.0, ellipse.loss, middle_colour(image_bgr, ellipse), plain=True)
