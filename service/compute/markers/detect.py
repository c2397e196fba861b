"""Detects spheres in one image, by the detector of a name: candidates, rough outlines, colour, full resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.compute.markers.paper import detect_by_masks
from service.compute.markers.records import (
    DEFAULTS,
    ColourModel,
    DetectionOptions,
    SphereOutline,
    colour_of,
    given_colour,
    learn_colour,
)
from service.compute.markers.refine import refine_outlines
from service.compute.markers.rough import (
    CLEAN_INTERIOR,
    CLEAR,
    LEAST_UNAIDED,
    CircleCandidate,
    RoughSphere,
    apart_rad,
    colour_gradient,
    edges,
    examine,
    find_candidates,
    outermost,
    share,
)
from service.core.errors import DataError
from service.core.geometry import Array

_LEAST_SHARE, _DOUBTFUL_SHARE = 0.35, 0.55  # of a disc's pixels that must have the spheres' colour
_POSSIBLE_SHARE = 0.2  # a circle with less is skipped, once the colour is known
_CLEAR_SPHERES = 4  # clear discs needed to learn it
_SIZES = (0.4, 2.5)  # of a sphere in the image, over the median of the clear ones
_CLEAN_SHARE = 0.85
_AROUND, _MOST_AROUND = (1.1, 1.35), 0.35  # ring around a disc, in radii, and its largest share of the colour
_ALTERNATIVES = 3  # rough outlines of one place that are tried until one is confirmed
_WHOLE = 0.8  # coverage of an outline that needs no second check
_OTHER_STARTS = (0.95, 1.06)  # of the radius, for the second check
_STARTS = (1.0, 1.08, 1.2)  # of the rough radius, tried until one is confirmed
_SAME_PX = 0.5
_DISTINCT = 0.85  # of the larger radius: a sphere closer behind another is too hidden to be measured


def detect_spheres(
    image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions = DEFAULTS
) -> tuple[SphereOutline, ...]:
    """Find the outlines of all spheres in an image (H, W, 3), the most certain first; empty if there are none.

    Everything that looks like a sphere is returned; identity and registration decide which are markers.

    Raises:
        DataError: the image does not have the camera's size.
    """
    if image_bgr.shape[:2] != (camera.height, camera.width) or image_bgr.ndim != 3:
        raise DataError(
            f"the image has {image_bgr.shape[1]}×{image_bgr.shape[0]} pixels, "
            f"the camera model is for {camera.width}×{camera.height}",
            remedy="Use the calibration made at this image size, and images that no program has rotated or resized",
        )
    return confirmed_outlines(image_bgr, camera, find_rough(image_bgr, camera, options), options)


def confirmed_outlines(
    image_bgr: NDArray[np.uint8], camera: CameraModel, roughs: Sequence[RoughSphere], options: DetectionOptions
) -> tuple[SphereOutline, ...]:
    """Return the outlines near rough ones that the edges at full resolution confirm, the most certain first.

    Args:
        image_bgr: (H, W, 3), of the camera's size.
        camera: intrinsics.
        roughs: rough spheres, the best first; of those in one place, the first that is confirmed counts.
        options: the detector's options.
    """
    todo = list(roughs)
    found: list[SphereOutline] = []
    while todo:
        # One rough outline of each place at a time, the best first; all places in parallel.
        now: list[RoughSphere] = []
        for rough in todo:
            if all(apart_rad(rough.cone, n.cone) > 0.6 * n.cone.half_angle_rad for n in now):
                now.append(rough)
        for outline in _refined(image_bgr, camera, now, options):
            if all(_distinct(outline, other) for other in found):
                found.append(outline)
        todo = [
            r for r in todo
            if all(r is not n for n in now)
            and all(apart_rad(r.cone, o.cone) > 0.6 * o.cone.half_angle_rad for o in found)
        ]  # fmt: skip
    return tuple(sorted(found, key=lambda o: -o.score))


def _refined(
    image: NDArray[np.uint8], camera: CameraModel, roughs: list[RoughSphere], options: DetectionOptions
) -> list[SphereOutline]:
    """Return the outlines that are confirmed at full resolution."""
    kept: list[SphereOutline] = []
    # In a blurred outline, shading can place the rough outline too far inside.
    for factor in _STARTS:
        starts = [Cone(r.cone.axis, factor * r.cone.half_angle_rad) for r in roughs]
        outlines = refine_outlines(image, camera, starts, options, scores=[r.score for r in roughs])
        lost: list[RoughSphere] = []
        for rough, outline in zip(roughs, outlines, strict=True):
            sure = outline
            if outline is not None and outline.coverage < _WHOLE:
                sure = _confirmed(image, camera, outline, options)
            if sure is not None and (rough.plain or sure.coverage > LEAST_UNAIDED):
                kept.append(sure)
            elif rough.coverage > LEAST_UNAIDED:
                lost.append(rough)
        roughs = lost
    return kept


def _confirmed(
    image: NDArray[np.uint8], camera: CameraModel, outline: SphereOutline, options: DetectionOptions
) -> SphereOutline | None:
    """Return the outline, or a better one near it; None if two different outlines explain the edges.

    If only parts of an outline are visible, shading or a border beside it can be mistaken for the rest.
    """
    if outline.coverage < LEAST_UNAIDED:
        return None
    starts = [Cone(outline.cone.axis, factor * outline.cone.half_angle_rad) for factor in _OTHER_STARTS]
    again = refine_outlines(image, camera, starts, options, scores=[outline.score] * len(starts))
    others = [o for o in again if o is not None]
    best = max([outline, *others], key=lambda o: o.coverage)
    if any(_contradict(best, other, camera) for other in [outline, *others]):
        return None
    return best


def _contradict(best: SphereOutline, other: SphereOutline, camera: CameraModel) -> bool:
    """Return whether two outlines of one place are nearly as good but differ by more than their uncertainty."""
    tilt = best.cone.frame()[:, :2].T @ (other.cone.axis - best.cone.axis)
    d = np.append(tilt, other.cone.half_angle_rad - best.cone.half_angle_rad)
    chi2 = float(d @ np.linalg.solve(best.cone_covariance + other.cone_covariance, d)) / 3
    return float(np.linalg.norm(d)) * camera.fx > _SAME_PX and chi2 > 9.0 and other.coverage > 0.85 * best.coverage


def find_rough(image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions) -> list[RoughSphere]:
    """Find the discs in the reduced image that pass the tests of coverage, interior and mask, without overlaps."""
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
    if options.colour_bgr is None:
        return _searched(coarse, coarse_camera, candidates, None, options)
    given = given_colour(options.colour_bgr, options.colour_tolerance, srgb=options.srgb)
    found = _searched(coarse, coarse_camera, candidates, given, options)
    paler = given.paler()
    return found if found or paler is None else _searched(coarse, coarse_camera, candidates, paler, options)


def _searched(
    coarse: NDArray[np.uint8],
    camera: CameraModel,
    candidates: list[CircleCandidate],
    given: ColourModel | None,
    options: DetectionOptions,
) -> list[RoughSphere]:
    """Return the discs among the candidates, of the given colour if any."""
    edge_map = edges(*colour_gradient(coarse))
    rng = np.random.default_rng(options.seed)
    kept: list[RoughSphere] = []
    model = given
    for candidate in candidates:
        middle = np.append(camera.normalise(np.array([[candidate.x, candidate.y]]))[0], 1.0)
        angle = float(np.arctan(candidate.radius / camera.fx))
        if any(_within(middle, k.cone) and angle < 1.4 * k.cone.half_angle_rad for k in kept if k.score > 0.6):
            continue  # a highlight or a shadow on a sphere already found
        here = Cone(middle / float(np.linalg.norm(middle)), angle)
        if model is not None and share(coarse, camera, here, model) < _POSSIBLE_SHARE:
            continue
        rough = examine(coarse, edge_map, camera, candidate, options, rng)
        if rough is not None:
            rough = outermost(coarse, edge_map, camera, rough, options, rng)
            kept.append(rough)
            if rough.score > CLEAR and sum(k.score > CLEAR for k in kept) >= _CLEAR_SPHERES:
                model = _learnt(kept, options) or model
    kept.sort(key=lambda r: -r.score)
    return _without_overlaps(_of_one_size(_of_one_colour(coarse, camera, kept, given, options)))


def _within(direction: Array, cone: Cone) -> bool:
    return float(direction @ cone.axis) > float(np.linalg.norm(direction)) * float(np.cos(0.8 * cone.half_angle_rad))


def _on(inner: Cone, outer: Cone) -> bool:
    """Return whether a disc lies on a clearly larger one."""
    small = inner.half_angle_rad < 0.65 * outer.half_angle_rad
    return small and _within(inner.axis, outer)


def _without_overlaps(roughs: list[RoughSphere]) -> list[RoughSphere]:
    """Drop discs on larger discs, and those that are too many for one place."""
    # Stains and highlights are discs too, but lie on a sphere.
    whole = [r for r in roughs if r.coverage > 0.6 and r.mask_loss < 0.4]
    roughs = [r for r in roughs if not any(_on(r.cone, w.cone) for w in whole)]
    kept: list[RoughSphere] = []
    for rough in roughs:
        same = [
            k for k in kept
            if apart_rad(rough.cone, k.cone) < 0.6 * max(rough.cone.half_angle_rad, k.cone.half_angle_rad)
        ]  # fmt: skip
        if len(same) < _ALTERNATIVES:
            kept.append(rough)
    return kept


def _of_one_colour(
    coarse: NDArray[np.uint8],
    camera: CameraModel,
    roughs: list[RoughSphere],
    given: ColourModel | None,
    options: DetectionOptions,
) -> list[RoughSphere]:
    """Select the discs of the spheres' colour; doubtful ones only if it is given or learnt from clear discs."""
    if given is not None:
        roughs = [r for r in roughs if share(coarse, camera, r.cone, given) >= _LEAST_SHARE]
    model = _learnt(roughs, options) or given
    if model is None:
        return [r for r in roughs if r.plain]
    kept: list[RoughSphere] = []
    for rough in roughs:
        part = share(coarse, camera, rough.cone, model)
        if rough.plain:
            good = part >= _LEAST_SHARE
        else:
            # Either something crosses the disc, and its surroundings have another colour; or the background has the
            # spheres' colour, and what lies in front is smooth.
            across = part >= _DOUBTFUL_SHARE and share(coarse, camera, rough.cone, model, _AROUND) < _MOST_AROUND
            good = across or (part >= _CLEAN_SHARE and rough.interior_edges < CLEAN_INTERIOR)
        if good:
            kept.append(rough)
    return kept


def _of_one_size(roughs: list[RoughSphere]) -> list[RoughSphere]:
    """Drop discs much smaller or larger than the clear ones: equal spheres are at similar distances."""
    clear = [r.cone.half_angle_rad for r in roughs if r.score > CLEAR]
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


def _distinct(a: SphereOutline, b: SphereOutline) -> bool:
    return apart_rad(a.cone, b.cone) > _DISTINCT * max(a.cone.half_angle_rad, b.cone.half_angle_rad)


class Detector(Protocol):
    """Finds the outlines of all spheres in an image (H, W, 3) of the camera's size."""

    def __call__(
        self, image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions = ...
    ) -> tuple[SphereOutline, ...]:
        """Return the outlines, the most certain first."""
        ...


def options_for(colour: str | None, largest: float | None = None) -> DetectionOptions:
    """Return default options with the spheres' colour, by name or as #rrggbb; None: it is learnt from each image.

    Args:
        colour: the spheres' colour.
        largest: largest radius searched for, over the image's width; None: the default.

    Raises:
        ConfigurationError: the colour is unknown.
    """
    options = DEFAULTS if largest is None else replace(DEFAULTS, max_radius=largest)
    if colour is None:
        return options
    colour_bgr, tolerance = colour_of(colour)
    return replace(options, colour_bgr=colour_bgr, colour_tolerance=tolerance)


DETECTORS: Mapping[str, Detector] = {"classical": detect_spheres, "paper": detect_by_masks}
