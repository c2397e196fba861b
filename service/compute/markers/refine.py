"""Measures outlines at full resolution, in photographs or developed raw files, with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.develop import coded, read_developed
from service.compute.markers.cones import Cone, distance_gradient, ransac_cone
from service.compute.markers.limb import LimbFit, LimbProfiles, fit_limb, masked_median
from service.compute.markers.records import (
    DEFAULTS,
    DetectionOptions,
    OutlineEvidence,
    SphereOutline,
    outline_from_cone,
)
from service.compute.markers.rough import (
    FINER,
    Pixels,
    envelope_edges,
    profiles,
    profiles_of,
    sample,
    sample_averaged,
    sample_sharp,
)
from service.core.errors import DataError
from service.core.geometry import Array

# Measured on rendered scenes with exact truth: an outline's remaining error after its noise has averaged out. It
# arises because the limb's falloff and the blur can be confused, so it grows with the blur.
SYSTEMATIC_PER_BLUR = 0.05
MOST_SIGMA_PX = 0.5  # of an edge point; without a real outline, edges within the search range scatter more
TEXTURE_FACTOR = 3.0  # sigma of an edge point over the one from its own profile
_BLOCKS = 16  # of an outline, for the noise that neighbouring edge points share
_TRIALS = 150  # of RANSAC; few, because the rough outline is near
_FIRST_PROFILES, _FIRST_OF_LARGE = 48, 32
_MOST_PROFILES, _FEWEST_PROFILES = 128, 48
_FINE_RADIUS_PX = 75.0  # up to here every profile counts; for larger outlines, fewer give the position as precisely
_UNIT_RADIUS_PX = 60.0  # radius in samples of the first approach, which averages the pixels of larger outlines
_LEAST_PART = 0.19  # of the profiles that must agree
_START_BLUR_PX, _START_CHROMA_BLUR_PX = 0.7, 1.2
_ALIKE = 1.5  # largest ratio of radii among outlines with profiles of one length
_LEAST_RADIUS = 3.0  # samples; smaller ones have no interior to compare with the outside
_MOST_CHANGE = 2.0  # of the radius in one fit of sub-pixel edges; more is extrapolation, even to negative radii
_FOCUS = 1.3  # ratio of blur to expected blur above which the profiles were too short


@dataclass(frozen=True, slots=True)
class AveragedCone:
    """A cone measured on averaged pixels, and the expected blurs (px)."""

    cone: Cone
    blur_px: float = _START_BLUR_PX
    chroma_blur_px: float = _START_CHROMA_BLUR_PX


def refine_outline(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    rough: Cone,
    options: DetectionOptions = DEFAULTS,
) -> SphereOutline | None:
    """Refine the outline near `rough` at full resolution, reading only its region; None if no reliable one is found.

    `rough` comes from the coarse search or from a prediction and must be good to about a tenth of the radius.
    """
    return refine_outlines(image_bgr, camera, [rough], options, scores=[1.0])[0]


def refine_outlines(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    roughs: Sequence[Cone],
    options: DetectionOptions = DEFAULTS,
    *,
    scores: Sequence[float],
) -> list[SphereOutline | None]:
    """Apply `refine_outline` to several cones; those of similar size are processed together."""
    out: list[SphereOutline | None] = [None] * len(roughs)
    found = {i: _by_envelope(image_bgr, camera, rough, options) for i, rough in enumerate(roughs)}
    cones = {i: cone for i, cone in found.items() if cone is not None}
    todo = sorted(cones, key=lambda i: cones[i].half_angle_rad)
    while todo:
        least = cones[todo[0]].half_angle_rad
        alike = [i for i in todo if cones[i].half_angle_rad < _ALIKE * least]
        todo = todo[len(alike) :]
        near = approach_outlines(image_bgr, camera, [cones[i] for i in alike], options)
        starts = {i: a for i, a in zip(alike, near, strict=True) if a is not None}
        given = [scores[i] for i in starts]
        for i, outline in zip(
            starts, measure_outlines(image_bgr, camera, list(starts.values()), options, scores=given), strict=True
        ):
            out[i] = outline
    return out


def approach_outlines(
    image_bgr: NDArray[np.uint8], camera: CameraModel, roughs: Sequence[Cone], options: DetectionOptions = DEFAULTS
) -> list[AveragedCone | None]:
    """Return the cones refined on pixels averaged across the outline; `roughs` must be good to 4 % of their radii."""
    if not roughs:
        return []
    radius_px = float(np.median([c.half_angle_rad for c in roughs])) * camera.fx
    unit = max(1, round(radius_px / _UNIT_RADIUS_PX))
    count = _FIRST_PROFILES if unit == 1 else _FIRST_OF_LARGE
    out: list[AveragedCone | None] = [None] * len(roughs)
    todo = [(i, AveragedCone(rough)) for i, rough in enumerate(roughs)]
    for _ in range(3):
        if not todo:
            break
        measured = _measure(image_bgr, camera, [a for _, a in todo], _Sampling(count, 1.0, 2.5, 4, unit), options)
        again: list[tuple[int, AveragedCone]] = []
        for (i, before), found in zip(todo, measured, strict=True):
            if found is None:
                continue
            if unit > 1:
                out[i] = AveragedCone(found.cone)  # the blur is finer than these samples and still unknown
                continue
            out[i] = AveragedCone(found.cone, found.blur_px, found.chroma_blur_px)
            if found.blur_px >= _FOCUS * max(1.0, before.blur_px):
                again.append((i, out[i] or before))  # out of focus
        todo = again
    return out


def measure_outlines(
    image_bgr: Pixels,
    camera: CameraModel,
    starts: Sequence[AveragedCone],
    options: DetectionOptions = DEFAULTS,
    *,
    scores: Sequence[float] = (),
) -> list[SphereOutline | None]:
    """Measure the outlines at full resolution from cones that are good to about a pixel; None as in `refine_outline`.

    The larger an outline, the more edge it has and the better it determines the sphere's position, so the number of
    profiles decreases with its size. An image of 16 bits is a developed raw file, sRGB coded.
    """
    if not starts:
        return []
    radius_px = float(np.median([s.cone.half_angle_rad for s in starts])) * camera.fx
    wanted = _MOST_PROFILES * min(1.0, _FINE_RADIUS_PX / radius_px)
    count = max(_FEWEST_PROFILES, _BLOCKS * round(wanted / _BLOCKS))
    fine = radius_px < _FINE_RADIUS_PX
    sampling = _Sampling(count, 0.5, 1.6, 3) if fine else _Sampling(count, 0.7, 2.5, 4)
    found = _measure(image_bgr, camera, starts, sampling, options)
    for i, best in enumerate(found):
        if best is not None and not fine and best.blur_px > _FOCUS * max(1.0, starts[i].blur_px):
            longer = AveragedCone(best.cone, best.blur_px, best.chroma_blur_px)
            found[i] = _measure(image_bgr, camera, [longer], sampling, options)[0]
    return [
        None if best is None else _outline(image_bgr, camera, best, options, score)
        for best, score in zip(found, scores or [1.0] * len(found), strict=True)
    ]


def _outline(
    image: Pixels, camera: CameraModel, best: _SubpixelCone, options: DetectionOptions, score: float
) -> SphereOutline | None:
    if (
        best.coverage < options.min_coverage
        or best.rms_px > options.max_rms_px
        or best.contrast < options.min_contrast
        or best.cone.axis[2] < 0.3
    ):
        return None
    middle = camera.project(best.cone.axis[None])[0]
    colour = _median_colour(image, middle, 0.5 * best.cone.half_angle_rad * camera.fx)
    evidence = OutlineEvidence(
        best.coverage, best.rms_px, best.sigma_px, best.n_edges, best.systematic_px, best.contrast, colour, score,
        best.covariance,
    )  # fmt: skip
    return outline_from_cone(best.cone, camera, options.n_points, evidence)


def _by_envelope(
    image: NDArray[np.uint8], camera: CameraModel, rough: Cone, options: DetectionOptions
) -> Cone | None:
    """Return the cone on which most edges agree, within a tenth of the radius around `rough`."""
    rng = np.random.default_rng(options.seed)
    radius_px = rough.half_angle_rad * camera.fx
    reach = max(4.0, 0.1 * radius_px)
    where = profiles(rough, camera, 96, np.arange(-reach, reach + 0.1, max(0.5, reach / 20)))
    points = envelope_edges(sample(image, where.pixels), where)
    if len(points.slot) < 16:
        return None
    per_pixel = where.per_pixel_rad[points.slot]
    rays = rough.rays(where.azimuth_rad[points.slot], rough.half_angle_rad + points.offset_px * per_pixel)
    tolerance = max(1.0, 0.012 * radius_px) * float(np.median(per_pixel))
    bounds = (0.8 * rough.half_angle_rad, 1.25 * rough.half_angle_rad)
    fit = ransac_cone(rays, points.strength, points.slot, bounds, tolerance, rng, _TRIALS)
    return None if fit is None else fit[0]


@dataclass(frozen=True, slots=True)
class _SubpixelCone:
    """A cone measured by sub-pixel edges."""

    cone: Cone
    blur_px: float
    chroma_blur_px: float
    coverage: float
    sigma_px: float
    rms_px: float
    n_edges: int
    contrast: float
    systematic_px: float
    covariance: Array


@dataclass(frozen=True, slots=True)
class _Sampling:
    """How outlines are sampled and fitted; lengths are in units of `unit` averaged pixels.

    Attributes:
        n_profiles: number of profiles across each outline.
        step: distance of samples along a profile.
        reach: largest distance of an edge from the outline expected.
        iterations: number of steps of the fit.
        unit: pixels averaged into one sample.
    """

    n_profiles: int
    step: float
    reach: float
    iterations: int
    unit: int = 1


def _measure(
    image: Pixels,
    camera: CameraModel,
    starts: Sequence[AveragedCone],
    sampling: _Sampling,
    options: DetectionOptions,
) -> list[_SubpixelCone | None]:
    """Measure the cones near `starts`."""
    unit, step = sampling.unit, sampling.step
    cones = [s.cone for s in starts]
    radius = np.array([c.half_angle_rad for c in cones]) * camera.fx / unit
    if not np.all(radius >= _LEAST_RADIUS):
        large = {i: s for i, s in enumerate(starts) if radius[i] >= _LEAST_RADIUS}
        found = iter(_measure(image, camera, list(large.values()), sampling, options) if large else ())
        return [next(found) if i in large else None for i in range(len(starts))]
    offsets = _offsets(radius, [s.blur_px for s in starts], step)
    finer = (offsets[:, None] * unit + np.arange(unit) - 0.5 * (unit - 1)).reshape(-1)
    where = profiles_of(cones, camera, sampling.n_profiles, finer)
    values = sample_sharp(image, where.pixels) if unit == 1 else sample_averaged(image, where.pixels, unit)
    limb = fit_limb(
        LimbProfiles(values, offsets, np.all(where.inside, axis=2), radius, options.srgb),
        blur=np.array([s.blur_px for s in starts]),
        chroma_blur=np.array([s.chroma_blur_px for s in starts]),
        iterations=sampling.iterations,
        reach=sampling.reach,
    )
    per_pixel = where.per_pixel_rad * unit
    angle = np.median(per_pixel, axis=1)
    fit = _robust_cones(where.azimuth_rad, limb.offset * per_pixel / angle[:, None], limb.sigma, limb.ok)
    covariance = _covariances(where.azimuth_rad, fit)
    contrast = masked_median(limb.contrast, fit.used)
    return [
        _subpixel_cone(i, cone, limb, fit, (float(angle[i]), covariance[i], float(contrast[i])), unit)
        for i, cone in enumerate(cones)
    ]


def _offsets(radius: Array, blurs: Sequence[float], step: float) -> Array:
    """Return (J,) positions along the profiles, for outlines of these radii and blurs."""
    typical = float(np.median(radius))
    # Inside, far enough to separate the limb's falloff from the edge; outside, only what the blurred edge needs.
    blur = max(1.0, float(np.median(blurs)))
    inner = min(float(np.clip(0.13 * typical, 4.0, 12.0)) + 2 * (blur - 1), 0.6 * typical)
    outer = 4.0 + 2.5 * (blur - 1)
    return np.asarray(np.arange(-round(inner / step), round(outer / step) + 1) * step, dtype=np.float64)


def _subpixel_cone(
    i: int, cone: Cone, limb: LimbFit, fit: _ConeFits, worth: tuple[float, Array, float], unit: int
) -> _SubpixelCone | None:
    """Return outline `i`, or None if unreliable; `worth`: radians per unit, covariance in squared units, contrast."""
    angle, covariance, contrast = worth
    blur_px = float(limb.blur[i]) * unit
    if not fit.good[i] or fit.scale[i] > max(MOST_SIGMA_PX, 0.3 * float(limb.blur[i])):
        return None
    half = cone.half_angle_rad + float(fit.step[i, 2] * angle)
    if not 1 / _MOST_CHANGE < half / cone.half_angle_rad < _MOST_CHANGE:  # a short arc gives no radius
        return None
    axis = cone.axis + cone.frame()[:, :2] @ fit.step[i, :2] * angle
    systematic = SYSTEMATIC_PER_BLUR * blur_px
    return _SubpixelCone(
        cone=Cone(axis / float(np.linalg.norm(axis)), half),
        blur_px=blur_px,
        chroma_blur_px=float(limb.chroma_blur[i]) * unit,
        coverage=float(fit.coverage[i]),
        sigma_px=float(fit.scale[i]) * unit,
        rms_px=float(np.sqrt(np.mean(fit.residual[i, fit.used[i]] ** 2))) * unit,
        n_edges=int(fit.used[i].sum()),
        contrast=contrast,
        systematic_px=systematic,
        covariance=(covariance + np.eye(3) * (systematic / unit) ** 2) * angle**2,
    )


@dataclass(frozen=True, slots=True)
class _ConeFits:
    """Fits of G cones: steps (G, 3), points used, residuals and weights (G, K), scale, coverage, success."""

    step: Array
    used: NDArray[np.bool_]
    residual: Array
    weights: Array
    scale: Array
    coverage: Array
    good: NDArray[np.bool_]


def _robust_cones(azimuth: Array, offset: Array, sigma: Array, ok: NDArray[np.bool_]) -> _ConeFits:
    """Return the cones by Tukey weights on the geometric distances (G, K), linearised around the given cones.

    The distances are linear in the steps, so each turn solves its weighted equations exactly: nothing is descended.
    """
    J = -distance_gradient(azimuth)
    least = max(12, round(_LEAST_PART * len(azimuth)))
    good = ok.sum(axis=1) >= least
    # Texture beside the outline is not white noise, and no edge is known better than a few hundredths of a pixel.
    base = np.where(ok, 1.0 / ((TEXTURE_FACTOR * sigma) ** 2 + 0.05**2), 0.0)
    weights, residual, scale = base, offset, np.ones(len(offset))
    step = np.zeros((len(offset), 3))
    for _ in range(6):
        weighted = J.T * weights[:, None, :]  # (G, 3, K)
        normal = weighted @ J
        trace = np.trace(normal, axis1=1, axis2=2)
        good = good & (np.linalg.det(normal) >= 1e-9 * trace**3) & (trace > 0)  # otherwise the arc is too short
        normal = np.where(good[:, None, None], normal, np.eye(3))
        step = np.asarray(np.linalg.solve(normal, weighted @ offset[..., None])[..., 0], dtype=np.float64)
        residual = offset - step @ J.T
        size = np.abs(residual)
        scale = np.maximum(0.03, 1.4826 * np.nan_to_num(masked_median(size, ok), posinf=1e3))
        u = residual / (4.0 * scale[:, None])
        weights = np.where(np.abs(u) < 1, base * (1 - u**2) ** 2, 0.0)
        good = good & ((weights > 0).sum(axis=1) >= least)
    size = np.abs(residual)
    used = ok & (size < 3.5 * scale[:, None])
    good = good & (used.sum(axis=1) >= least)
    coverage = (ok & (size < np.maximum(0.5, 3.5 * scale)[:, None])).mean(axis=1)
    return _ConeFits(step, used, residual, weights, scale, coverage, good)


def _covariances(azimuth: Array, fit: _ConeFits) -> Array:
    """Return (G, 3, 3) covariance of a cone's directions and half angle, in squared units, from edge points' scatter.

    Neighbouring edge points share pixels, texture and shading, so their errors are correlated. Means over blocks of
    the outline show by how much they exceed those of independent points; that factor multiplies the plain covariance.
    """
    J = -distance_gradient(azimuth)
    w = np.where(fit.used & fit.good[:, None], fit.weights, 0.0)
    w = np.where(fit.good[:, None], w / np.maximum(w.max(axis=1, keepdims=True), 1e-12), 1.0)
    inverse = np.linalg.inv((J.T * w[:, None]) @ J)
    noise = inverse @ ((J.T * w[:, None] ** 2) @ J) @ inverse * fit.scale[:, None, None] ** 2
    blocks = (len(w), _BLOCKS, -1)
    total = w.reshape(blocks).sum(axis=2)
    square = (w * w).reshape(blocks).sum(axis=2)
    sums = (w * np.where(fit.used, fit.residual, 0.0)).reshape(blocks).sum(axis=2)
    filled = total > 0.25 * np.median(total, axis=1, keepdims=True)
    # Subtract the three fitted parameters from the degrees of freedom.
    chi2 = np.where(filled, sums**2 / np.maximum(square, 1e-12), 0.0).sum(axis=1)
    factor = chi2 / np.maximum(filled.sum(axis=1) - 3, 3) / fit.scale**2
    return noise * np.maximum(1.0, factor)[:, None, None]


def _median_colour(image: Pixels, middle: Array, reach: float) -> tuple[float, float, float]:
    h, w = image.shape[:2]
    x0, x1 = (int(np.clip(middle[0] + s * reach, 0, w - 1)) for s in (-1, 1))
    y0, y1 = (int(np.clip(middle[1] + s * reach, 0, h - 1)) for s in (-1, 1))
    step = max(1, (x1 - x0) // 32)
    b, g, r = np.median(image[y0 : y1 + 1 : step, x0 : x1 + 1 : step].reshape(-1, 3), axis=0)
    unit = 1 if image.dtype == np.uint8 else FINER
    return float(b) / unit, float(g) / unit, float(r) / unit


def remeasure_file(
    path: Path, camera: CameraModel, outlines: Sequence[SphereOutline], options: DetectionOptions = DEFAULTS
) -> tuple[SphereOutline | None, ...]:
    """Apply `remeasure` to a TIFF that `develop` made.

    Raises:
        DataError: the file is none, or it is not of the camera's size.
    """
    linear = read_developed(path)
    if linear.shape[:2] != (camera.height, camera.width):
        raise DataError(
            f"the developed picture has {linear.shape[1]}×{linear.shape[0]} pixels, "
            f"the camera model is for {camera.width}×{camera.height}",
            where=str(path),
            remedy="Develop the raw file together with its JPEG, which gives it the JPEG's size",
        )
    return remeasure(coded(linear), camera, outlines, options)


def remeasure(
    coded_bgr: Pixels, camera: CameraModel, outlines: Sequence[SphereOutline], options: DetectionOptions = DEFAULTS
) -> tuple[SphereOutline | None, ...]:
    """Measure the outlines that the JPEG showed in another picture of the same exposure.

    Args:
        coded_bgr: (H, W, 3), sRGB coded: the noise is then about the same in shadows and lights, as the fit assumes.
        camera: intrinsics.
        outlines: found in the JPEG.
        options: the detector's options.

    Returns:
        One for each outline; None where this picture shows none there.
    """
    starts = [AveragedCone(outline.cone) for outline in outlines]
    scores = [outline.score for outline in outlines]
    return tuple(measure_outlines(coded_bgr, camera, starts, options, scores=scores))
