"""Options and results of the sphere detector."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_ellipse
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """Parameters of the detector; relative lengths are fractions of the image's width.

    The defaults suit spheres of any colour that fill 2 % to 25 % of the image's width.
    """

    coarse_width_px: int = 1500  # largest width of the copy that is searched
    min_radius: float = 0.011  # of the image's width
    max_radius: float = 0.13
    max_candidates: int = 60  # circles examined in one image
    min_vote: float = 0.2  # share of a circle's edge that must vote for its centre
    min_coverage: float = 0.38  # share of the outline that must be visible
    max_rms_px: float = 1.0  # of the edge points of one outline, after rejection
    max_interior_edges: float = 0.11  # edge pixels inside a sphere over its area
    min_score: float = 0.2  # of a disc in the reduced image
    min_contrast: float = 0.01  # median step across the outline over full scale, linear light
    max_leak: float = 0.2  # share of the outline across which the sphere's colour continues without an edge
    n_points: int = 200  # L, points sampled equidistantly on an outline
    srgb: bool = True  # whether pixel values are sRGB coded
    seed: int = 0  # of RANSAC
    colour_bgr: tuple[float, float, float] | None = None  # of the spheres, 0..255; None: learnt in each image
    colour_tolerance: float = 0.18  # in chromaticity, around `colour_bgr`; see colours.chromaticity


DEFAULTS = DetectionOptions()


@dataclass(frozen=True)
class SphereOutline:
    """The outline of one sphere in one image.

    `centre_px` is the conic's centre in the image as captured; it is not the projection of the sphere's centre, whose
    direction is `cone.axis`.

    `cone_covariance` (3, 3), rad²: of the displacement of the cone's axis along the first and the second column of
    `cone.frame()` and of the half angle, in this order (true axis ~ axis + frame[:, :2] @ d[:2], true half angle ~
    half angle + d[2]). It includes the noise of the edge points and the systematic error of one outline.
    """

    cone: Cone
    n_points: int  # L
    focal_px: tuple[float, float] = field(repr=False)  # of the camera, along x and y
    principal_px: tuple[float, float] = field(repr=False)
    centre_px: tuple[float, float]
    semi_axes_px: tuple[float, float]
    angle_rad: float  # of the major axis from x
    coverage: float  # share of the outline with accepted edge points, 0..1
    rms_px: float  # of the accepted edge points from the conic
    sigma_px: float  # robust standard deviation of one edge point
    n_edges: int
    systematic_px: float  # error of the outline as a whole, beyond the noise of its edge points
    contrast: float  # median step across the outline over full scale, linear light
    colour_bgr: tuple[float, float, float]  # median inside, 0..255
    score: float  # 0..1, how much it looks like a sphere
    cone_covariance: Array = field(repr=False)

    @cached_property
    def points(self) -> Array:
        """(L, 2) undistorted normalised coordinates (z = 1), equidistant on the fitted conic."""
        return cone_ellipse(self.cone).equidistant(self.n_points)

    @property
    def points_px(self) -> Array:
        """(L, 2) the same points in pixels of an ideal pinhole with the camera's K."""
        return self.points * self.focal_px + self.principal_px

    @property
    def conic(self) -> Array:
        """(3, 3) of normalised coordinates, x^T E x = 0, negative inside."""
        return self.cone.conic

    def captured_px(self, camera: CameraModel) -> Array:
        """(L, 2) points of the outline in pixels of the image as captured (with distortion)."""
        return camera.project(np.column_stack([self.points, np.ones(len(self.points))]))

    def centre_camera_m(self, radius_m: float) -> Array:
        """(3,) position of the centre of a sphere of this radius in the camera frame."""
        return self.cone.axis * (radius_m / np.sin(self.cone.half_angle_rad))


@dataclass(frozen=True, slots=True)
class OutlineEvidence:
    """Quality measures of the fit of one outline."""

    coverage: float
    rms_px: float
    sigma_px: float
    n_edges: int
    systematic_px: float
    contrast: float
    colour_bgr: tuple[float, float, float]
    score: float
    cone_covariance: Array  # (3, 3), see SphereOutline


def outline_from_cone(cone: Cone, camera: CameraModel, n_points: int, evidence: OutlineEvidence) -> SphereOutline:
    """The outline of a cone, which has `n_points` equidistant points."""
    ellipse = cone_ellipse(cone)
    centre = camera.project(np.array([[*ellipse.centre, 1.0]]))[0]
    f = 0.5 * (camera.fx + camera.fy)
    return SphereOutline(
        cone=cone,
        n_points=n_points,
        focal_px=(camera.fx, camera.fy),
        principal_px=(camera.cx, camera.cy),
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
