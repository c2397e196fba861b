"""Spheres in one image: box, mask, rough ellipse, edge points in an envelope, RANSAC, equidistant outline points."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.candidates import Candidate, colour_gradient, edges, find_candidates
from service.compute.markers.cones import Cone, ransac_cone
from service.compute.markers.edges import envelope_edges, profiles, sample
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.compute.markers.refine import refine_outline
from service.core.errors import DataError
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class RoughSphere:
    """An outline found on the coarse copy."""

    cone: Cone
    coverage: float  # of the outline by edges, weighted by their strength
    interior_edges: float  # edge pixels inside over area
    mask_loss: float  # false positives and negatives of the ellipse against the mask, over the ellipse's area
    colour_bgr: tuple[float, float, float]

    @property
    def score(self) -> float:
        """0..1: a whole, clean disc has about 0.9."""
        clean = max(0.0, 1.0 - 6.0 * self.interior_edges)
        return float(self.coverage * clean * (1.0 - 0.5 * min(1.0, self.mask_loss)))


def detect_spheres(
    image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions = DEFAULTS
) -> tuple[SphereOutline, ...]:
    """The outlines of all spheres in an image (H, W, 3), the most certain first; none is an empty tuple.

    What is returned looks like a sphere; whether it is one of the markers is for identity and registration to say.

    Raises:
        DataError: the image has not the camera's size.
    """
    if image_bgr.shape[:2] != (camera.height, camera.width) or image_bgr.ndim != 3:
        raise DataError(
            f"the image has {image_bgr.shape[1]}×{image_bgr.shape[0]} pixels, "
            f"the camera model is for {camera.width}×{camera.height}",
            remedy="Use the calibration made at this image size, and images that no program has rotated or resized",
        )
    roughs = find_rough(image_bgr, camera, options)
    found: list[SphereOutline] = []
    for rough in sorted(roughs, key=lambda r: -r.score):
        outline = refine_outline(image_bgr, camera, rough.cone, options, score=rough.score)
        if outline is not None and all(_distinct(outline, other) for other in found):
            found.append(outline)
    return tuple(found)


def find_rough(image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions) -> list[RoughSphere]:
    """Discs on the coarse copy that pass the tests of coverage, interior and mask, without overlaps."""
    scale = min(1.0, options.coarse_width_px / camera.width)
    coarse_camera = camera
    coarse = image_bgr
    if scale < 1.0:
        size = (round(camera.width * scale), round(camera.height * scale))
        coarse = np.asarray(cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        coarse_camera = camera.scaled(*size)
    width = coarse_camera.width
    candidates = find_candidates(
        coarse, options.min_radius * width, options.max_radius * width, options.min_vote, options.max_candidates
    )
    edge_map = edges(*colour_gradient(coarse))
    rng = np.random.default_rng(options.seed)
    kept: list[RoughSphere] = []
    for candidate in candidates:
        middle = np.append(coarse_camera.normalise(np.array([[candidate.x, candidate.y]]))[0], 1.0)
        angle = float(np.arctan(candidate.radius / coarse_camera.fx))
        if any(_within(middle, k.cone) and angle < 1.4 * k.cone.half_angle_rad for k in kept if k.score > 0.6):
            continue  # a highlight or a shadow on a sphere that is already known
        rough = _examine(coarse, edge_map, coarse_camera, candidate, options, rng)
        if rough is not None:
            kept.append(rough)
    kept.sort(key=lambda r: -r.score)
    return _consistent(_without_overlaps(kept))


def _examine(
    coarse: NDArray[np.uint8],
    edge_map: NDArray[np.bool_],
    camera: CameraModel,
    candidate: Candidate,
    options: DetectionOptions,
    rng: np.random.Generator,
) -> RoughSphere | None:
    axis = np.append(camera.normalise(np.array([[candidate.x, candidate.y]]))[0], 1.0)
    length = float(np.linalg.norm(axis))
    cone = Cone(axis / length, float(np.arctan(candidate.radius / camera.fx / length)))
    coverage = 0.0
    votes = np.zeros(96)
    for envelope in (0.3, 0.14):
        reach = max(4.0, envelope * candidate.radius)
        where = profiles(cone, camera, 96, np.arange(-reach, reach + 0.1, max(0.5, reach / 24)))
        points = envelope_edges(sample(coarse, where.pixels), where)
        if len(points.slot) < 16:
            return None
        per_pixel = where.per_pixel_rad[points.slot]
        rays = cone.rays(where.azimuth_rad[points.slot], cone.half_angle_rad + points.offset_px * per_pixel)
        bounds = (0.6 * cone.half_angle_rad, 1.5 * cone.half_angle_rad)
        tolerance = max(0.9, 0.02 * candidate.radius) * float(np.median(per_pixel))
        fit = ransac_cone(rays, points.strength, points.slot, bounds, tolerance, rng)
        if fit is None:
            return None
        cone, inlier = fit
        votes = np.zeros(96)
        np.maximum.at(votes, points.slot[inlier], points.strength[inlier])
        coverage = float(votes.mean())
        if coverage < 0.8 * options.min_coverage * 0.8:
            return None
    if cone.axis[2] < 0.3:
        return None
    interior, loss, leak, colour = _interior(coarse, edge_map, cone, camera, votes < 0.3)
    if (
        leak > options.max_leak
        or interior > options.max_interior_edges
        or loss > 0.6
        or coverage < 0.8 * options.min_coverage
    ):
        return None
    rough = RoughSphere(cone, coverage, interior, loss, colour)
    return rough if rough.score >= options.min_score else None


def _interior(
    coarse: NDArray[np.uint8],
    edge_map: NDArray[np.bool_],
    cone: Cone,
    camera: CameraModel,
    edgeless: NDArray[np.bool_],
) -> tuple[float, float, float, tuple[float, float, float]]:
    """Edge density inside, loss of the ellipse against the colour mask, leak, and median colour.

    The mask holds what has the chromaticity of the disc's own middle; the loss is the paper's FP + FN, over the
    area. The leak is the part of the outline without an edge (`edgeless`, one for each of K azimuths) across which
    the mask goes on: the circle is then only a part of something of another shape.
    """
    outline = camera.project(cone.rays(np.linspace(0, 2 * np.pi, 64), np.full(64, cone.half_angle_rad)))
    centre = outline.mean(axis=0)
    h, w = edge_map.shape
    reach = 1.25 * (outline - centre)
    low = np.clip(np.floor((centre + reach).min(axis=0)).astype(int), 0, [w - 1, h - 1])
    high = np.clip(np.ceil((centre + reach).max(axis=0)).astype(int) + 1, low + 1, [w, h])
    box = coarse[low[1] : high[1], low[0] : high[0]]
    masks: list[NDArray[np.bool_]] = []
    for part in (1.0, 0.8):
        canvas = np.zeros(box.shape[:2], np.uint8)
        polygon = np.rint((centre + part * (outline - centre) - low) * 16).astype(np.int32)
        cv2.fillPoly(canvas, [polygon], 1, shift=4)
        masks.append(canvas > 0)
    whole, core = masks
    if core.sum() < 20:
        return 1.0, 1.0, 1.0, (0.0, 0.0, 0.0)
    interior = float(edge_map[low[1] : high[1], low[0] : high[0]][core].mean())
    lab = cv2.cvtColor(box, cv2.COLOR_BGR2LAB).astype(np.float32)
    inside = lab[core]
    middle = np.median(inside, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(inside - middle), axis=0), [12.0, 2.5, 2.5])
    # Shading moves lightness within a sphere much more than its colour.
    mask = np.all(np.abs(lab - middle) < spread * [4.0, 3.5, 3.5], axis=2)
    colour = np.median(box[core], axis=0)
    loss = float((whole & ~mask).sum()) / float(whole.sum())
    azimuth = np.linspace(0.0, 2 * np.pi, len(edgeless), endpoint=False)
    leaks = edgeless.copy()
    for part in (0.86, 1.13):
        at = camera.project(cone.rays(azimuth, np.full(len(azimuth), part * cone.half_angle_rad))) - low
        x, y = np.rint(at).astype(int).T
        here = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        leaks &= here
        leaks[here] &= mask[y[here], x[here]]
    return interior, loss, float(leaks.mean()), (float(colour[0]), float(colour[1]), float(colour[2]))


def _within(direction: Array, cone: Cone) -> bool:
    return float(direction @ cone.axis) > float(np.linalg.norm(direction)) * float(np.cos(0.8 * cone.half_angle_rad))


def _on(inner: Cone, outer: Cone) -> bool:
    """Whether a disc lies on a clearly larger one."""
    small = inner.half_angle_rad < 0.65 * outer.half_angle_rad
    return small and _within(inner.axis, outer)


def _without_overlaps(roughs: list[RoughSphere]) -> list[RoughSphere]:
    # Stains and highlights are discs too, but on a sphere.
    whole = [r for r in roughs if r.coverage > 0.6 and r.mask_loss < 0.4]
    roughs = [r for r in roughs if not any(_on(r.cone, w.cone) for w in whole)]
    kept: list[RoughSphere] = []
    for rough in roughs:
        for other in kept:
            between = float(np.arccos(np.clip(rough.cone.axis @ other.cone.axis, -1, 1)))
            if between < 0.6 * max(rough.cone.half_angle_rad, other.cone.half_angle_rad):
                break
        else:
            kept.append(rough)
    return kept


def _consistent(roughs: list[RoughSphere]) -> list[RoughSphere]:
    """Doubtful discs must have the colour of the clearest ones: all markers come from one batch."""
    clear = [r for r in roughs if r.score > 0.7]
    if len(clear) < 3:
        return roughs
    tones = _chromaticity([r.colour_bgr for r in clear])
    middle = np.median(tones, axis=0)
    spread = max(6.0, 2 * float(np.median(np.abs(tones - middle))))
    own = _chromaticity([r.colour_bgr for r in roughs])
    far = np.linalg.norm(own - middle, axis=1) > 3.5 * spread
    return [r for r, off in zip(roughs, far, strict=True) if r.score > 0.7 or not off]


def _chromaticity(colours: list[tuple[float, float, float]]) -> Array:
    pixels = np.array(colours, dtype=np.float32).reshape(1, -1, 3) / 255
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2LAB)[0, :, 1:].astype(np.float64)


def _distinct(a: SphereOutline, b: SphereOutline) -> bool:
    between = float(np.arccos(np.clip(a.cone.axis @ b.cone.axis, -1, 1)))
    return between > 0.6 * max(a.cone.half_angle_rad, b.cone.half_angle_rad)
