"""What the sphere detector is told and what it returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_ellipse
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """Parameters of the detector; lengths that are relative are relative to the image's width.

    The defaults suit spheres that fill 2 % to 25 % of the image's width, whatever their colour.
    """

    coarse_width_px: int = 1500  # the search runs on a copy not wider than this
    min_radius: float = 0.011  # of the image width
    max_radius: float = 0.13
    max_candidates: int = 60  # circles looked at more closely in one image
    min_vote: float = 0.2  # part of a circle's edge that must vote for its centre
    min_coverage: float = 0.38  # part of the outline that must be seen
    max_rms_px: float = 1.0  # of the edge points of one outline, after rejection
    max_interior_edges: float = 0.11  # edge pixels inside a sphere over its area
    min_score: float = 0.2  # of a disc on the coarse copy
    min_contrast: float = 0.01  # median step across the outline over full scale, linear light
    max_leak: float = 0.2  # part of the outline across which the sphere's colour goes on without an edge
    n_points: int = 200  # L, points sampled equidistantly on an outline
    srgb: bool = True  # pixel values carry the sRGB transfer curve
    seed: int = 0  # of RANSAC
    colour_bgr: tuple[float, float, float] | None = None  # of the spheres, 0..255; None: learnt in each image
    colour_tolerance: float = 0.18  # in chromaticity, of the colour given: see colours.chromaticity


DEFAULTS = DetectionOptions()


@dataclass(frozen=True, slots=True)
class SphereOutline:
    """The outline of one sphere in one image.

    `points` are (L, 2) undistorted normalised coordinates (z = 1), equidistant on the fitted conic, and
    `points_px` the same in pixels of an ideal pinhole with the camera's K. `centre_px` is the conic's centre in the
    image as captured; it is not the projection of the sphere's centre, whose direction is `cone.axis`.

    `cone_covariance` (3, 3), rad²: of the displacement of the cone's axis along the first and the second column of
    `cone.frame()` and of the half angle, in this order (true axis ~ axis + frame[:, :2] @ d[:2], true half angle ~
    half angle + d[2]). It holds the noise of the edge points and what is systematic within one outline.
    """

    points: Array = field(repr=False)
    points_px: Array = field(repr=False)
    conic: Array = field(repr=False)  # (3, 3) of normalised coordinates, x^T E x = 0, negative inside
    cone: Cone
    centre_px: tuple[float, float]
    semi_axes_px: tuple[float, float]
    angle_rad: float  # of the major axis against x
    coverage: float  # part of the outline with accepted edge points, 0..1
    rms_px: float  # of the accepted edge points against the conic
    sigma_px: float  # robust standard deviation of one edge point
    n_edges: int
    systematic_px: float  # of the outline as a whole, beyond the noise of its edge points
    contrast: float  # median step across the outline over full scale, linear light
    colour_bgr: tuple[float, float, float]  # median inside, 0..255
    score: float  # 0..1, how much it looks like a sphere
    cone_covariance: Array = field(repr=False)

    def captured_px(self, camera: CameraModel) -> Array:
        """(L, 2) the outline in pixels of the image as captured (with distortion)."""
        return camera.project(np.column_stack([self.points, np.ones(len(self.points))]))

    def centre_camera_m(self, radius_m: float) -> Array:
        """(3,) position of the centre of a sphere of this radius in the camera frame."""
        return self.cone.axis * (radius_m / np.sin(self.cone.half_angle_rad))


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the fit of one outline was made of."""

    coverage: float
    rms_px: float
    sigma_px: float
    n_edges: int
    systematic_px: float
    contrast: float
    colour_bgr: tuple[float, float, float]
    score: float
    cone_covariance: Array  # (3, 3), see SphereOutline


def outline_from_cone(cone: Cone, camera: CameraModel, n_points: int, evidence: Evidence) -> SphereOutline:
    """The record of an outline, with its conic and `n_points` equidistant points."""
    ellipse = cone_ellipse(cone)
    points = ellipse.equidistant(n_points)
    focal = np.array([camera.fx, camera.fy])
    centre = camera.project(np.array([[*ellipse.centre, 1.0]]))[0]
    f = float(focal.mean())
    return SphereOutline(
        points=points,
        points_px=points * focal + [camera.cx, camera.cy],
        conic=cone.conic,
        cone=cone,
        centre_px=(float(centre[0]), float(centre[1])),
        semi_axes_px=(ellipse.semi_major * f, ellipse.semi_minor * f),
        angle_rad=ellipse.angle_rad,
        coverage=evidence.coverage,
        rms_px=evidence.rms_px,
        sigma_px=evidence.sigma_px,
        n_edges=evidence.n_edges,
        systematic_px=evidence.systematic_px,
        contrast=evidence.contrast,
        colour_bgr=evidence.colour_bgr,
        score=evidence.score,
        cone_covariance=evidence.cone_covariance,
    )
