"""Spheres in one image: box, mask, rough ellipse, edge points in an envelope, RANSAC, equidistant outline points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.candidates import Candidate, colour_gradient, edges, find_candidates
from service.compute.markers.colours import ColourModel, given_colour, learn_colour
from service.compute.markers.cones import Cone, ransac_cone
from service.compute.markers.edges import envelope_edges, profiles, sample
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.compute.markers.refine import refine_outlines
from service.core.errors import DataError
from service.core.geometry import Array

# A disc with wires, stains or highlights on it, or on ground of its own colour, counts if it has the spheres' colour.
_DOUBTFUL_INTERIOR, _DOUBTFUL_LEAK = 0.3, 0.36
_LEAST_SHARE, _DOUBTFUL_SHARE = 0.35, 0.55  # of a disc's pixels that must have the spheres' colour
_POSSIBLE_SHARE = 0.2  # below it a circle is not looked at, once the colour is known
_CLEAR, _CLEAR_SPHERES = 0.6, 4  # score of discs, and how many of them, from which it is known
_SIZES = (0.4, 2.5)  # of a sphere in the image, over the median of the clear ones
_CLEAN_SHARE, _CLEAN_INTERIOR = 0.85, 0.03
_AROUND, _MOST_AROUND = (1.1, 1.35), 0.35  # the ring beside a disc, in radii, and how much of it may have the colour
_DOUBTFUL_COVERAGE = 0.58
_ALTERNATIVES = 3  # rough outlines of one place that are tried until one holds
_WHOLE = 0.8  # coverage of an outline that needs no second look
_OTHER_STARTS = (0.95, 1.06)  # of the radius, for the second look
_LEAST_UNAIDED = 0.5  # coverage below which only a prediction can tell what is outline
_STARTS = (1.0, 1.08, 1.2)  # of the rough radius, tried until one holds
_TRIALS = 200  # of RANSAC, on a coarse outline
_SAME_PX = 0.5
_DISTINCT = 0.85  # of the larger radius: of a sphere nearer behind another too little is seen


@dataclass(frozen=True, slots=True)
class RoughSphere:
    """An outline found on the coarse copy."""

    cone: Cone
    coverage: float  # of the outline by edges, weighted by their strength
    interior_edges: float  # edge pixels inside over area
    mask_loss: float  # false positives and negatives of the ellipse against the mask, over the ellipse's area
    leak: float  # part of the outline across which the disc's colour goes on without an edge
    colour_bgr: tuple[float, float, float]
    plain: bool  # passes every test by itself

    @property
    def score(self) -> float:
        """0..1: a whole, clean disc has about 0.9."""
        clean = max(0.0, 1.0 - 6.0 * self.interior_edges) if self.plain else 0.3
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
    todo = find_rough(image_bgr, camera, options)
    found: list[SphereOutline] = []
    while todo:
        # One rough outline of each place at a time, the best first; all places side by side.
        now: list[RoughSphere] = []
        for rough in todo:
            if all(_apart_rad(rough.cone, n.cone) > 0.6 * n.cone.half_angle_rad for n in now):
                now.append(rough)
        for outline in _refined(image_bgr, camera, now, options):
            if all(_distinct(outline, other) for other in found):
                found.append(outline)
        todo = [
            r for r in todo
            if all(r is not n for n in now)
            and all(_apart_rad(r.cone, o.cone) > 0.6 * o.cone.half_angle_rad for o in found)
        ]  # fmt: skip
    return tuple(sorted(found, key=lambda o: -o.score))


def _refined(
    image: NDArray[np.uint8], camera: CameraModel, roughs: list[RoughSphere], options: DetectionOptions
) -> list[SphereOutline]:
    """The outlines of those that hold at full resolution."""
    kept: list[SphereOutline] = []
    # Shading within a blurred outline can hold the rough one too far inside.
    for factor in _STARTS:
        starts = [Cone(r.cone.axis, factor * r.cone.half_angle_rad) for r in roughs]
        outlines = refine_outlines(image, camera, starts, options, scores=[r.score for r in roughs])
        lost: list[RoughSphere] = []
        for rough, outline in zip(roughs, outlines, strict=True):
            sure = outline
            if outline is not None and outline.coverage < _WHOLE:
                sure = _confirmed(image, camera, outline, options)
            if sure is not None and (rough.plain or sure.coverage > _LEAST_UNAIDED):
                kept.append(sure)
            elif rough.coverage > _LEAST_UNAIDED:
                lost.append(rough)
        roughs = lost
    return kept


def _confirmed(
    image: NDArray[np.uint8], camera: CameraModel, outline: SphereOutline, options: DetectionOptions
) -> SphereOutline | None:
    """The outline, or a better one near it; None where what is seen agrees with two outlines.

    Where only parts of an outline are seen, shading or a border beside it can be taken for the rest.
    """
    if outline.coverage < _LEAST_UNAIDED:
        return None
    starts = [Cone(outline.cone.axis, factor * outline.cone.half_angle_rad) for factor in _OTHER_STARTS]
    again = refine_outlines(image, camera, starts, options, scores=[outline.score] * len(starts))
    others = [o for o in again if o is not None]
    best = max([outline, *others], key=lambda o: o.coverage)
    if any(_contradict(best, other, camera) for other in [outline, *others]):
        return None
    return best


def _contradict(best: SphereOutline, other: SphereOutline, camera: CameraModel) -> bool:
    """Whether two outlines of one place are nearly as good and differ by more than both admit."""
    tilt = best.cone.frame()[:, :2].T @ (other.cone.axis - best.cone.axis)
    d = np.append(tilt, other.cone.half_angle_rad - best.cone.half_angle_rad)
    chi2 = float(d @ np.linalg.solve(best.cone_covariance + other.cone_covariance, d)) / 3
    return float(np.linalg.norm(d)) * camera.fx > _SAME_PX and chi2 > 9.0 and other.coverage > 0.85 * best.coverage


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
    model = None
    if options.colour_bgr is not None:
        model = given_colour(options.colour_bgr, options.colour_tolerance, srgb=options.srgb)
    for candidate in candidates:
        middle = np.append(coarse_camera.normalise(np.array([[candidate.x, candidate.y]]))[0], 1.0)
        angle = float(np.arctan(candidate.radius / coarse_camera.fx))
        if any(_within(middle, k.cone) and angle < 1.4 * k.cone.half_angle_rad for k in kept if k.score > 0.6):
            continue  # a highlight or a shadow on a sphere that is already known
        here = Cone(middle / float(np.linalg.norm(middle)), angle)
        if model is not None and _share(coarse, coarse_camera, here, model) < _POSSIBLE_SHARE:
            continue
        rough = _examine(coarse, edge_map, coarse_camera, candidate, options, rng)
        if rough is not None:
            kept.append(rough)
            if rough.score > _CLEAR and sum(k.score > _CLEAR for k in kept) >= _CLEAR_SPHERES:
                model = _learnt(kept, options) or model
    kept.sort(key=lambda r: -r.score)
    return _without_overlaps(_of_one_size(_of_one_colour(coarse, coarse_camera, kept, options)))


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
        fit = ransac_cone(rays, points.strength, points.slot, bounds, tolerance, rng, _TRIALS)
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
    bad = loss > 0.6 or coverage < 0.8 * options.min_coverage
    if bad or leak > _DOUBTFUL_LEAK or interior > _DOUBTFUL_INTERIOR:
        return None
    plain = leak <= options.max_leak and interior <= options.max_interior_edges
    rough = RoughSphere(cone, coverage, interior, loss, leak, colour, plain)
    if plain and rough.score < options.min_score:
        rough = replace(rough, plain=False)
    least = _LEAST_UNAIDED if interior < _CLEAN_INTERIOR else _DOUBTFUL_COVERAGE
    return rough if rough.plain or coverage > least else None


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
    """Without what lies on larger discs, and not too many for one place."""
    # Stains and highlights are discs too, but on a sphere.
    whole = [r for r in roughs if r.coverage > 0.6 and r.mask_loss < 0.4]
    roughs = [r for r in roughs if not any(_on(r.cone, w.cone) for w in whole)]
    kept: list[RoughSphere] = []
    for rough in roughs:
        same = [
            k for k in kept
            if _apart_rad(rough.cone, k.cone) < 0.6 * max(rough.cone.half_angle_rad, k.cone.half_angle_rad)
        ]  # fmt: skip
        if len(same) < _ALTERNATIVES:
            kept.append(rough)
    return kept


def _of_one_colour(
    coarse: NDArray[np.uint8], camera: CameraModel, roughs: list[RoughSphere], options: DetectionOptions
) -> list[RoughSphere]:
    """The discs that have the spheres' colour; doubtful ones only when it is known, from clear ones or in advance."""
    given = None
    if options.colour_bgr is not None:
        given = given_colour(options.colour_bgr, options.colour_tolerance, srgb=options.srgb)
        roughs = [r for r in roughs if _share(coarse, camera, r.cone, given) >= _LEAST_SHARE]
    model = _learnt(roughs, options) or given
    if model is None:
        return [r for r in roughs if r.plain]
    kept: list[RoughSphere] = []
    for rough in roughs:
        share = _share(coarse, camera, rough.cone, model)
        if rough.plain:
            good = share >= _LEAST_SHARE
        else:
            # Something lies across the disc, whose surroundings are of another colour; or, on ground of the spheres'
            # colour, what stands before it is smooth.
            across = share >= _DOUBTFUL_SHARE and _share(coarse, camera, rough.cone, model, _AROUND) < _MOST_AROUND
            good = across or (share >= _CLEAN_SHARE and rough.interior_edges < _CLEAN_INTERIOR)
        if good:
            kept.append(rough)
    return kept


def _of_one_size(roughs: list[RoughSphere]) -> list[RoughSphere]:
    """Without discs much smaller or larger than the clear ones: equal spheres stand at like distances."""
    clear = [r.cone.half_angle_rad for r in roughs if r.score > _CLEAR]
    if len(clear) < _CLEAR_SPHERES:
        return roughs
    middle = float(np.median(clear))
    return [r for r in roughs if _SIZES[0] < r.cone.half_angle_rad / middle < _SIZES[1]]


def _learnt(roughs: list[RoughSphere], options: DetectionOptions) -> ColourModel | None:
    firm = [r for r in roughs if r.coverage > 0.6]
    return learn_colour(
        np.array([r.colour_bgr for r in firm]).reshape(-1, 3),
        np.array([r.coverage * (1 - 0.5 * r.mask_loss) * (1.0 if r.plain else 0.5) for r in firm]),
        np.array([r.score > 0.3 for r in firm], dtype=np.bool_),
        srgb=options.srgb,
    )


def _share(
    coarse: NDArray[np.uint8],
    camera: CameraModel,
    cone: Cone,
    model: ColourModel,
    reach: tuple[float, float] = (0.0, 0.92),
) -> float:
    """The part of a disc, or of the ring between two shares of its radius, that has the spheres' colour."""
    low, high = reach
    rings = np.sqrt(low**2 + (high**2 - low**2) * (np.arange(8) + 0.5) / 8)
    azimuth = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    at = camera.project(cone.rays(azimuth[:, None], rings * cone.half_angle_rad).reshape(-1, 3))
    x, y = np.rint(at).astype(int).T
    here = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    if not here.any():
        return 0.0
    return float(np.mean(model.distance(coarse[y[here], x[here]].astype(np.float64)) < 1.0))


def _apart_rad(a: Cone, b: Cone) -> float:
    return float(np.arccos(np.clip(a.axis @ b.axis, -1, 1)))


def _distinct(a: SphereOutline, b: SphereOutline) -> bool:
    return _apart_rad(a.cone, b.cone) > _DISTINCT * max(a.cone.half_angle_rad, b.cone.half_angle_rad)
