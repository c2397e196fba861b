"""Finds spheres near their predicted places in one image; a sphere that is not visible is not found."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, ObservedCones, cone_of_sphere, fit_pose, ransac_cone
from service.compute.markers.detect import confirmed_outlines, detect_spheres, find_rough
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.compute.markers.refine import AveragedCone, approach_outlines, measure_outlines, refine_outline
from service.compute.markers.rough import envelope_edges, profiles, sample
from service.compute.registration.hypotheses import MatchGate
from service.core.geometry import Array, Transform, apply

# Lengths below are fractions of a sphere's apparent radius, unless the name has a unit.
NEAR = 0.08  # a prediction this good is refined directly; its region is searched only if that fails
WIDE = 0.42  # largest search range, for a robot that is off by millimetres
_GATE = MatchGate(0.05, 0.04)  # of a whole outline from the image's other spheres; scaled for partial ones
_ROUGH_GATE = 0.12
_APPROACH_GATE = 0.02  # of approached outlines, on whose agreement the others are predicted
CLEARLY_VISIBLE = 0.8  # the share from which on a sphere that is not found counts as lacking
_LEAST_PART = 0.45  # share of an outline that must be inside the image and not behind another sphere
_REGION_RADIUS_PX = 24.0  # of a sphere in the reduced region that is searched
_REGION_RAYS = 64
_APPROACHED = 5  # spheres from which an image's pose is first found; all, if these do not agree
_POSE_SPHERES = 3  # three parameters each: three spheres determine a pose with redundancy


@dataclass(frozen=True, slots=True)
class Tone:
    """Colour of the markers: chromaticity (a, b of CIELAB of 8-bit colours), and its tolerance."""

    a: float
    b: float
    reach: float

    def admits(self, outline: SphereOutline) -> bool:
        """Return whether the outline's colour may be a marker's."""
        a, b = _chromaticity([outline])[0]
        return bool(np.hypot(a - self.a, b - self.b) <= self.reach)


def tone_of(outlines: Sequence[SphereOutline]) -> Tone:
    """Return the common colour of one or more outlines."""
    tones = _chromaticity(outlines)
    middle = np.median(tones, axis=0)
    spread = float(np.median(np.linalg.norm(tones - middle, axis=1)))
    return Tone(float(middle[0]), float(middle[1]), max(21.0, 7 * spread))


def _chromaticity(outlines: Sequence[SphereOutline]) -> Array:
    pixels = np.array([o.colour_bgr for o in outlines], dtype=np.float32).reshape(1, -1, 3) / 255
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2LAB)[0, :, 1:].astype(np.float64)


@dataclass(frozen=True, slots=True)
class PredictedSpheres:
    """Expected positions of the spheres `centres_m` (M, 3), scan frame, and their tolerance `margin` in radii.

    Only the first `voting` spheres decide which outlines agree with one another, since the places of the others are
    not known from the scan; None: all do.
    """

    T_camera_scan: Transform = field(repr=False)
    centres_m: Array = field(repr=False)
    radius_m: float
    margin: float
    tone: Tone
    voting: int | None = None

    def votes(self, sphere: int) -> bool:
        """Return whether a sphere takes part in choosing outlines."""
        return self.voting is None or sphere < self.voting


@dataclass(frozen=True, slots=True)
class PredictedOutlines:
    """Outlines by sphere; reasons for spheres expected but not found; the image's own pose; the spheres that vote."""

    outlines: dict[int, SphereOutline]
    missing: dict[int, str]
    T_camera_scan: Transform = field(repr=False)
    voting: int | None = None

    @property
    def convincing(self) -> bool:
        """True if so many voting spheres were found where predicted that the prediction must be right."""
        found, lacking = (
            sum(self.voting is None or m < self.voting for m in part) for part in (self.outlines, self.missing)
        )
        expected = found + lacking
        return found >= max(min(4, expected), 0.5 * expected)


@dataclass(frozen=True, slots=True)
class ImageOutlines:
    """Outlines of one image; where they were predicted, the sphere of each, and the reason for each missing one."""

    outlines: tuple[SphereOutline, ...] = field(repr=False)
    spheres: tuple[int, ...] | None  # None: the whole image was searched, and they are not identified
    missing: dict[int, str]


def find_outlines(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    expected: PredictedSpheres | None,
    options: DetectionOptions = DEFAULTS,
) -> ImageOutlines:
    """Find outlines in an image (H, W, 3) of the camera's size: where they are predicted, or else in the whole image.

    The search of a capture under way and that of a registration are this one.

    Args:
        expected: None, or a prediction that too little of what is found confirms: the whole image is searched.
    """
    if expected is not None:
        located = locate_predicted(image_bgr, camera, expected, options)
        if located.convincing:
            return ImageOutlines(tuple(located.outlines.values()), tuple(located.outlines), located.missing)
    return ImageOutlines(detect_spheres(image_bgr, camera, options), None, {})


def locate_predicted(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    expected: PredictedSpheres,
    options: DetectionOptions = DEFAULTS,
) -> PredictedOutlines:
    """Locate the outlines of the predicted spheres in an image (H, W, 3) of the camera's size.

    Each region is searched as far as the prediction may be off. The outlines found must agree with one camera pose
    (the image's own, so the robot's pose may be off) in place, size and colour; spheres that do not are reported as
    missing.
    """
    found = _attempt(image_bgr, camera, expected, options)
    if not found.convincing and expected.margin < WIDE:
        wider = _attempt(image_bgr, camera, dataclasses.replace(expected, margin=WIDE), options)
        if len(wider.outlines) > len(found.outlines):
            return wider
    return found


def _attempt(
    image: NDArray[np.uint8], camera: CameraModel, expected: PredictedSpheres, options: DetectionOptions
) -> PredictedOutlines:
    centres, radius_m = expected.centres_m, expected.radius_m
    pose = expected.T_camera_scan
    starts = None
    if expected.margin <= NEAR:
        starts = _starts(image, camera, expected, pose, options)
    if starts is None:
        pose = _approached_pose(image, camera, expected, visible_cones(pose, centres, radius_m, camera))
        starts = _starts(image, camera, expected, pose, options)
    if starts is None:  # too few spheres to predict the others from
        shown = visible_cones(pose, centres, radius_m, camera)
        found = [refine_outline(image, camera, cone, options) for cone in shown.values()]
    else:
        shown = starts
        found = measure_outlines(image, camera, list(starts.values()), options)
    outlines: dict[int, SphereOutline] = {}
    missing: dict[int, str] = {}
    for m, outline in zip(shown, found, strict=True):
        if outline is None:
            missing[m] = "no outline where it is predicted"
        elif not expected.tone.admits(outline):
            missing[m] = "not of the markers' colour"
        else:
            outlines[m] = outline
    cones = {m: o.cone for m, o in outlines.items() if expected.votes(m)}
    agreed = _agreed_pose(cones, expected, pose, _GATE.place, 0.5 * len(cones))
    pose = pose if agreed is None else agreed
    for m, outline in list(outlines.items()):
        there = cone_of_sphere(apply(pose, centres[m]), radius_m)
        if expected.votes(m) and not _within_gate(outline.cone, there, max(outline.coverage, 0.2)):
            del outlines[m]
            missing[m] = "not where the image's other spheres predict it"
    return PredictedOutlines(outlines, missing, pose, expected.voting)


def _starts(
    image: NDArray[np.uint8],
    camera: CameraModel,
    expected: PredictedSpheres,
    pose: Transform,
    options: DetectionOptions,
) -> dict[int, AveragedCone] | None:
    """Return cones good to about a pixel for measurement: approached ones, and predictions by these for the others.

    None if the approached spheres do not agree on a pose.
    """
    centres, radius_m = expected.centres_m, expected.radius_m
    shown = visible_cones(pose, centres, radius_m, camera)
    near = approach_outlines(image, camera, list(shown.values()), options)
    approached = {m: a for m, a in zip(shown, near, strict=True) if a is not None}
    cones = {m: a.cone for m, a in approached.items() if expected.votes(m)}
    voters = sum(map(expected.votes, shown))
    agreed = _agreed_pose(cones, expected, pose, _APPROACH_GATE, max(0.5 * voters, _POSE_SPHERES))
    if agreed is None:
        return None
    out: dict[int, AveragedCone] = {}
    for m, cone in visible_cones(agreed, centres, radius_m, camera).items():
        own = approached.get(m)
        believed = own is not None and (not expected.votes(m) or _within_gate(own.cone, cone))
        out[m] = own if own is not None and believed else AveragedCone(cone)
    return out


def _within_gate(cone: Cone, predicted: Cone, part: float = 1.0) -> bool:
    """Return whether a cone is where the other spheres predict it; a part 0 … 1 of its outline is visible."""
    place, size = deviation(cone, predicted)
    return place <= _GATE.place / part and size <= _GATE.size / part


def deviation(cone: Cone, predicted: Cone) -> tuple[float, float]:
    """Return the distance of the centres in radii, and relative difference of the sizes."""
    apart = float(np.linalg.norm(cone.axis - predicted.axis))  # of unit vectors: equals a small angle
    half = predicted.half_angle_rad
    return apart / half, abs(cone.half_angle_rad / half - 1.0)


def visible_cones(
    T_camera_scan: Transform,
    centres_scan_m: Array,
    radius_m: float,
    camera: CameraModel,
    *,
    least: float = _LEAST_PART,
) -> dict[int, Cone]:
    """Return cones of spheres with the `least` share of their outline in the image and not behind another sphere."""
    centres = apply(T_camera_scan, centres_scan_m)
    distance = np.linalg.norm(centres, axis=1)
    cones = {
        m: cone_of_sphere(c, radius_m)
        for m, c in enumerate(centres)
        if c[2] > max(2 * radius_m, 0.35 * distance[m])  # farther to the side is outside any field of view here
    }
    corners = camera.normalise(np.array([[0.0, 0.0], [camera.width - 1.0, camera.height - 1.0]]))
    low, high = 1.2 * corners.min(axis=0), 1.2 * corners.max(axis=0)
    out: dict[int, Cone] = {}
    azimuth = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    for m, cone in cones.items():
        rays = cone.rays(azimuth, np.full(48, cone.half_angle_rad))
        if np.any(rays[:, 2] <= 0.1):
            continue
        plane = rays[:, :2] / rays[:, 2:]
        seen = np.all((plane > low) & (plane < high), axis=1)  # beyond, the distortion polynomial may fold back
        pixels = camera.project(rays)
        seen &= np.all((pixels > 2) & (pixels < [camera.width - 3, camera.height - 3]), axis=1)
        for k, other in cones.items():
            if distance[k] < distance[m] - 0.5 * radius_m:
                seen &= rays @ other.axis < np.cos(other.half_angle_rad)
        if seen.mean() >= least:
            out[m] = cone
    return out


def _approach(image: NDArray[np.uint8], camera: CameraModel, cone: Cone, margin: float) -> Cone | None:
    """Return the circle near a predicted one, searched in its region at reduced size."""
    shrink = max(1.0, cone.half_angle_rad * camera.fx / _REGION_RADIUS_PX)
    angle = cone.half_angle_rad * (1.15 + margin)
    rim = camera.project(cone.rays(np.linspace(0, 2 * np.pi, 24), np.full(24, angle)))
    x0, y0 = (int(v) for v in np.clip(np.floor(rim.min(axis=0)), 0, [camera.width - 8, camera.height - 8]))
    x1, y1 = (int(v) for v in np.clip(np.ceil(rim.max(axis=0)), [x0 + 8, y0 + 8], [camera.width, camera.height]))
    width, height = max(8, round((x1 - x0) / shrink)), max(8, round((y1 - y0) / shrink))
    region = np.asarray(
        cv2.resize(image[y0:y1, x0:x1], (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )
    sx, sy = width / (x1 - x0), height / (y1 - y0)
    there = dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=(camera.cx - x0 + 0.5) * sx - 0.5,
        cy=(camera.cy - y0 + 0.5) * sy - 0.5,
    )
    rng = np.random.default_rng(0)
    radius_px = cone.half_angle_rad * there.fx
    for envelope in (margin, 0.1):
        reach = max(3.0, envelope * radius_px)
        where = profiles(cone, there, _REGION_RAYS, np.arange(-reach, reach + 0.1, 0.5))
        points = envelope_edges(sample(region, where.pixels), where)
        if len(points.slot) < 16:
            return None
        per_pixel = where.per_pixel_rad[points.slot]
        rays = cone.rays(where.azimuth_rad[points.slot], cone.half_angle_rad + points.offset_px * per_pixel)
        bounds = (0.9 * cone.half_angle_rad, 1.1 * cone.half_angle_rad)
        fit = ransac_cone(
            rays, points.strength, points.slot, bounds, 0.8 * float(np.median(per_pixel)), rng, trials=120
        )
        if fit is None:
            return None
        cone = fit[0]
    return cone


def _approached_pose(
    image: NDArray[np.uint8], camera: CameraModel, expected: PredictedSpheres, shown: dict[int, Cone]
) -> Transform:
    """Compute the image's pose from circles near predicted ones: from a few spheres, or all if those disagree."""
    order = _spread({m: cone for m, cone in shown.items() if expected.votes(m)})
    roughs: dict[int, Cone] = {}
    for part, agreeing in ((order[:_APPROACHED], 4), (order[_APPROACHED:], 3)):
        for m in part:
            rough = _approach(image, camera, shown[m], expected.margin)
            if rough is not None:
                roughs[m] = rough
        least = max(agreeing, 0.5 * len(roughs))
        pose = _agreed_pose(roughs, expected, expected.T_camera_scan, _ROUGH_GATE, least)
        if pose is not None:
            return pose
    return expected.T_camera_scan


def _spread(cones: dict[int, Cone]) -> list[int]:
    """Return the spheres in an order in which each is as far as possible from those before it."""
    if not cones:
        return []
    names = list(cones)
    axes = np.array([cone.axis for cone in cones.values()])
    order = [int(np.argmax(np.linalg.norm(axes - axes.mean(axis=0), axis=1)))]
    gap = np.full(len(names), np.inf)
    while len(order) < len(names):
        gap = np.minimum(gap, np.linalg.norm(axes - axes[order[-1]], axis=1))
        gap[order] = -1.0
        order.append(int(np.argmax(gap)))
    return [names[k] for k in order]


def _agreed_pose(
    cones: dict[int, Cone], expected: PredictedSpheres, start: Transform, gate: float, least: float
) -> Transform | None:
    """Return T_camera_scan on which `least` cones (at least three) agree; None if they do not."""
    if len(cones) < _POSE_SPHERES:
        return None
    index = list(cones)
    pose = fit_pose(ObservedCones.of(cones.values()), expected.centres_m[index], expected.radius_m, start)
    agreeing = sum(
        deviation(c, cone_of_sphere(apply(pose, expected.centres_m[m]), expected.radius_m))[0] < gate
        for m, c in cones.items()
    )
    return pose if agreeing >= max(_POSE_SPHERES, least) else None


_SIZES = (0.75, 1.3)  # of the expected radius, which is wrong by the displacement along the view
_SAME = 0.6  # of an outline's half angle: one whose axis is nearer is of the same sphere
_CANDIDATES = 24  # circles examined around one place


def find_nearby(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    expected: Sequence[tuple[Cone, float]],
    options: DetectionOptions = DEFAULTS,
) -> tuple[SphereOutline, ...]:
    """Find outlines of spheres around expected ones in an image (H, W, 3); they may be others than those expected.

    Args:
        image_bgr: an image of the camera's size.
        camera: intrinsics.
        expected: cones of the expected spheres, and the angle (rad) by which each may be elsewhere.
        options: the detector's options.
    """
    found: list[SphereOutline] = []
    for cone, window_rad in expected:
        for outline in _around(image_bgr, camera, cone, window_rad, options):
            if is_another(outline, found):
                found.append(outline)
    return tuple(found)


def is_another(outline: SphereOutline, known: Sequence[SphereOutline]) -> bool:
    """Return whether an outline is of another sphere than each of those that are known in the same image."""
    apart = (float(np.linalg.norm(outline.cone.axis - other.cone.axis)) for other in known)
    return all(gap > _SAME * outline.cone.half_angle_rad for gap in apart)


def _around(
    image: NDArray[np.uint8], camera: CameraModel, cone: Cone, window_rad: float, options: DetectionOptions
) -> tuple[SphereOutline, ...]:
    azimuth = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = camera.project(cone.rays(azimuth, np.full(24, 1.3 * cone.half_angle_rad + window_rad)))
    x0, y0 = (int(v) for v in np.clip(np.floor(rim.min(axis=0)), 0, [camera.width - 8, camera.height - 8]))
    x1, y1 = (int(v) for v in np.clip(np.ceil(rim.max(axis=0)), [x0 + 8, y0 + 8], [camera.width, camera.height]))
    region = np.ascontiguousarray(image[y0:y1, x0:x1])
    there = dataclasses.replace(camera, width=x1 - x0, height=y1 - y0, cx=camera.cx - x0, cy=camera.cy - y0)
    radius = cone.half_angle_rad * camera.fx / there.width
    near = dataclasses.replace(
        options,
        min_radius=_SIZES[0] * radius,
        max_radius=_SIZES[1] * radius,
        max_candidates=min(_CANDIDATES, options.max_candidates),
    )
    return confirmed_outlines(image, camera, find_rough(region, there, near), options)
