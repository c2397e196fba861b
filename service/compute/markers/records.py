"""Holds the options and results of the sphere detector, and the colours of spheres."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_ellipse
from service.core.errors import ConfigurationError
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
    colour_tolerance: float = 0.18  # in chromaticity, around `colour_bgr`; see `chromaticity`


DEFAULTS = DetectionOptions()


@dataclass(frozen=True)
class OutlineEvidence:
    """Says how well one outline was fitted.

    `cone_covariance` (3, 3), rad²: of the displacement of the cone's axis along the first and the second column of
    `cone.frame()` and of the half angle, in this order (true axis ~ axis + frame[:, :2] @ d[:2], true half angle ~
    half angle + d[2]). It includes the noise of the edge points and the systematic error of one outline.
    """

    coverage: float  # share of the outline with accepted edge points, 0..1
    rms_px: float  # of the accepted edge points from the conic
    sigma_px: float  # robust standard deviation of one edge point
    n_edges: int
    systematic_px: float  # error of the outline as a whole, beyond the noise of its edge points
    contrast: float  # median step across the outline over full scale, linear light
    colour_bgr: tuple[float, float, float]  # median inside, 0..255
    score: float  # 0..1, how much it looks like a sphere
    cone_covariance: Array = field(repr=False)


_EVIDENCE = tuple(field.name for field in dataclasses.fields(OutlineEvidence))


@dataclass(frozen=True)
class SphereOutline(OutlineEvidence):
    """The outline of one sphere in one image.

    `centre_px` is the conic's centre in the image as captured; it is not the projection of the sphere's centre, whose
    direction is `cone.axis`.
    """

    cone: Cone
    n_points: int  # L
    focal_px: tuple[float, float] = field(repr=False)  # of the camera, along x and y
    principal_px: tuple[float, float] = field(repr=False)
    centre_px: tuple[float, float]
    semi_axes_px: tuple[float, float]
    angle_rad: float  # of the major axis from x

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
        """Return (L, 2) points of the outline in pixels of the image as captured (with distortion)."""
        return camera.project(np.column_stack([self.points, np.ones(len(self.points))]))

    def centre_camera_m(self, radius_m: float) -> Array:
        """Return (3,) position of the centre of a sphere of this radius in the camera frame."""
        return self.cone.axis * (radius_m / np.sin(self.cone.half_angle_rad))


def outline_from_cone(cone: Cone, camera: CameraModel, n_points: int, evidence: OutlineEvidence) -> SphereOutline:
    """Return the outline of a cone, which has `n_points` equidistant points."""
    ellipse = cone_ellipse(cone)
    centre = camera.project(np.array([[*ellipse.centre, 1.0]]))[0]
    f = 0.5 * (camera.fx + camera.fy)
    return SphereOutline(
        **vars(evidence),
        cone=cone,
        n_points=n_points,
        focal_px=(camera.fx, camera.fy),
        principal_px=(camera.cx, camera.cy),
        centre_px=(float(centre[0]), float(centre[1])),
        semi_axes_px=(ellipse.semi_major * f, ellipse.semi_minor * f),
        angle_rad=ellipse.angle_rad,
    )


def outline_record(outline: SphereOutline) -> dict[str, Any]:
    """Return an outline as JSON-compatible data."""
    record: dict[str, Any] = {name: getattr(outline, name) for name in _EVIDENCE}
    record["cone_covariance"] = outline.cone_covariance.tolist()
    record["axis"] = outline.cone.axis.tolist()
    record["half_angle_rad"] = float(outline.cone.half_angle_rad)
    record["centre_px"] = list(outline.centre_px)
    record["semi_axes_px"] = list(outline.semi_axes_px)
    record["angle_rad"] = outline.angle_rad
    return record


def outline_from_record(record: dict[str, Any], camera: CameraModel) -> SphereOutline:
    """Rebuild an outline from `outline_record`'s data, with new sample points on the same conic."""
    values = {name: _value(record[name]) for name in _EVIDENCE}
    values["cone_covariance"] = np.array(record["cone_covariance"], dtype=np.float64)
    evidence = OutlineEvidence(**values)
    cone = Cone(np.array(record["axis"]), float(record["half_angle_rad"]))
    return outline_from_cone(cone, camera, DetectionOptions().n_points, evidence)


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


Colour = tuple[float, float, float]  # B, G, R as coded in an image, 0..255

# Typical matte plastic under neutral light, and the chromaticity tolerance for spheres of that name.
NAMED_BGR: Mapping[str, tuple[Colour, float]] = {
    "white": ((230.0, 230.0, 230.0), 0.16),
    "grey": ((140.0, 140.0, 140.0), 0.16),
    "green": ((75.0, 200.0, 130.0), 0.3),  # from yellowish to dark green
    "orange": ((56.0, 139.0, 236.0), 0.22),
}
_HEX_TOLERANCE = 0.18  # covers the light's colour and the camera's white balance
_ALIKE = 0.07  # largest distance of discs of one colour
_LEARNT_TOLERANCE = (0.1, 0.16)  # smallest and largest tolerance of a learnt colour
_PALEST = 0.2  # saturation of a pale picture over that of the named colour
_SAME_HUE_RAD = 0.45
_MEMBERS = 3  # least number of discs from which a colour is learnt


@dataclass(frozen=True, slots=True)
class ColourModel:
    """The chromaticity (2,) of the spheres in an image, and its tolerance for single pixels."""

    middle: Array
    tolerance: float
    srgb: bool
    palest: float = 1.0  # least saturation over that of `middle`; below 1, the hue decides, not the saturation

    def distance(self, colours_bgr: Array) -> Array:
        """Return (N,) distance of colours (N, 3) in tolerances; up to 1 is a sphere's colour."""
        tones = chromaticity(colours_bgr, srgb=self.srgb)
        if self.palest == 1.0:
            return np.linalg.norm(tones - self.middle, axis=1) / self.tolerance
        saturation = float(np.linalg.norm(self.middle))
        along, across = (tones @ [u, v] / saturation for u, v in _axes(self.middle / saturation))
        off = np.abs(np.arctan2(across, along)) / _SAME_HUE_RAD
        return np.asarray(np.where(np.hypot(along, across) < self.palest, 9.0, off), dtype=np.float64)

    def paler(self) -> ColourModel | None:
        """Return the model for cheap cameras' pale pictures, by its hue; None if the colour is hardly saturated."""
        pale = float(np.linalg.norm(self.middle)) > 2 * self.tolerance
        return replace(self, palest=_PALEST) if pale else None


def _axes(unit: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    u, v = (float(x) for x in unit)
    return (u, v), (-v, u)


def colour_of(text: str) -> tuple[Colour, float]:
    """Return a colour and its chromaticity tolerance from a name (white, grey, green, orange) or #rrggbb.

    Raises:
        ConfigurationError: neither a known name nor #rrggbb.
    """
    word = text.strip().lower()
    if word in NAMED_BGR:
        return NAMED_BGR[word]
    if len(word) == 7 and word[0] == "#" and all(c in "0123456789abcdef" for c in word[1:]):
        r, g, b = (int(word[i : i + 2], 16) for i in (1, 3, 5))
        return (float(b), float(g), float(r)), _HEX_TOLERANCE
    raise ConfigurationError(
        f"{text!r} is not a known sphere colour", remedy=f"Give one of {', '.join(NAMED_BGR)}, or #rrggbb"
    )


def learn_colour(colours_bgr: Array, weights: Array, clear: NDArray[np.bool_], *, srgb: bool) -> ColourModel | None:
    """Learn the colour that most of the discs share, since all spheres have one colour; None if too few agree.

    Args:
        colours_bgr: (N, 3) median colours of discs.
        weights: (N,) likeness of each to a sphere.
        clear: (N,) discs that pass every test by themselves; at least one must have the colour.
        srgb: true if the values are sRGB coded.
    """
    if len(colours_bgr) < _MEMBERS:
        return None
    tones = chromaticity(colours_bgr, srgb=srgb)
    near = np.linalg.norm(tones[:, None] - tones[None], axis=2) < _ALIKE
    total = near @ weights
    members = near[int(np.argmax(total))]
    if members.sum() < _MEMBERS or not np.any(members & clear) or float(total.max()) < 0.4 * float(weights.sum()):
        return None
    middle = np.median(tones[members], axis=0)
    spread = float(np.median(np.linalg.norm(tones[members] - middle, axis=1)))
    return ColourModel(middle, float(np.clip(4 * spread, *_LEARNT_TOLERANCE)), srgb)


def given_colour(colour_bgr: Colour, tolerance: float, *, srgb: bool) -> ColourModel:
    """Return the model of a colour known in advance."""
    return ColourModel(chromaticity(np.array([colour_bgr]), srgb=srgb)[0], tolerance, srgb)


def chromaticity(colours_bgr: Array, *, srgb: bool = True) -> Array:
    """Return (N, 2) opponent colours over channel sum, of colours (N, 3) 0..255; independent of light's strength.

    They are red minus green and blue minus yellow, divided by the sum: a stronger lamp scales all channels alike.
    """
    x = np.asarray(colours_bgr, dtype=np.float64).reshape(-1, 3) / 255
    if srgb:
        x = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    total = np.maximum(x.sum(axis=1), 0.02)  # black has no colour
    b, g, r = x.T
    return np.stack([(r - g) / total, (b - 0.5 * (r + g)) / total], axis=1)
