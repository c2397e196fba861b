"""One outline at full resolution: edges of an envelope, RANSAC, the forward model of the limb; its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, distance_gradient, ransac_cone
from service.compute.markers.edges import envelope_edges, profiles, sample, sample_sharp
from service.compute.markers.limb import LimbFit, fit_limb
from service.compute.markers.records import DEFAULTS, DetectionOptions, Evidence, SphereOutline, outline_from_cone
from service.core.geometry import Array

# Measured on rendered scenes with exact truth: what stays of an outline's error when its noise has averaged out.
# It comes from what the limb's fall and the blur can be taken for each other, so it grows with the blur.
SYSTEMATIC_PER_BLUR = 0.05
MOST_SIGMA_PX = 0.5  # of an edge point; where there is no outline, places within the search's reach scatter more
TEXTURE_FACTOR = 3.0  # sigma of an edge point over the one its own profile tells
_BLOCKS = 16  # of an outline, for the noise that neighbouring edge points share
_TRIALS = 150  # of RANSAC: the rough outline is near
_FIRST_PROFILES, _PROFILES = 48, 128
_START_BLUR_PX, _START_CHROMA_BLUR_PX = 0.7, 1.2


def refine_outline(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    rough: Cone,
    options: DetectionOptions = DEFAULTS,
    *,
    score: float = 1.0,
) -> SphereOutline | None:
    """The outline near `rough` at full resolution, touching only its region; None when there is none to be trusted.

    `rough` may come from the coarse search or from a prediction; it must be right to about a tenth of the radius.
    """
    cone = _by_envelope(image_bgr, camera, rough, options)
    if cone is None:
        return None
    blurs = (_START_BLUR_PX, _START_CHROMA_BLUR_PX)
    first = None
    for _ in range(3):
        first = _measure(image_bgr, camera, cone, _FIRST_PROFILES, 1.0, 2.5, 4, blurs, options)
        if first is None:
            return None
        cone = first.cone
        if first.limb.blur_px < 1.3 * max(1.0, blurs[0]):
            break
        # Out of focus: the profiles were too short for it.
        blurs = (first.limb.blur_px, first.limb.chroma_blur_px)
    assert first is not None
    blurs = (first.limb.blur_px, first.limb.chroma_blur_px)
    best = _measure(image_bgr, camera, first.cone, _PROFILES, 0.5, 1.6, 3, blurs, options)
    if (
        best is None
        or best.coverage < options.min_coverage
        or best.rms_px > options.max_rms_px
        or best.contrast < options.min_contrast
        or best.cone.axis[2] < 0.3
    ):
        return None
    middle = camera.project(best.cone.axis[None])[0]
    colour = _median_colour(image_bgr, middle, 0.5 * best.cone.half_angle_rad * camera.fx)
    evidence = Evidence(
        best.coverage, best.rms_px, best.sigma_px, best.n_edges, best.systematic_px, best.contrast, colour, score,
        best.covariance,
    )  # fmt: skip
    return outline_from_cone(best.cone, camera, options.n_points, evidence)


def _by_envelope(
    image: NDArray[np.uint8], camera: CameraModel, rough: Cone, options: DetectionOptions
) -> Cone | None:
    """The cone that most edges in an envelope of a tenth of the radius around `rough` agree with."""
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
class _Measured:
    """A cone by sub-pixel edges."""

    cone: Cone
    limb: LimbFit
    coverage: float
    sigma_px: float
    rms_px: float
    n_edges: int
    contrast: float
    systematic_px: float
    covariance: Array


def _measure(
    image: NDArray[np.uint8],
    camera: CameraModel,
    cone: Cone,
    n_profiles: int,
    step_px: float,
    reach_px: float,
    iterations: int,
    blurs_px: tuple[float, float],
    options: DetectionOptions,
) -> _Measured | None:
    radius_px = cone.half_angle_rad * camera.fx
    # Inside, as far as tells the limb's fall from the edge; outside, only what the blurred edge needs.
    blur = max(1.0, blurs_px[0])
    inner = float(np.clip(0.13 * radius_px, 4.0, 12.0)) + 2 * (blur - 1)
    inner = min(inner, 0.6 * radius_px)
    outer = 4.0 + 2.5 * (blur - 1)
    offsets = np.asarray(np.arange(-round(inner / step_px), round(outer / step_px) + 1) * step_px, dtype=np.float64)
    where = profiles(cone, camera, n_profiles, offsets)
    limb = fit_limb(
        sample_sharp(image, where.pixels), where, radius_px, srgb=options.srgb, blur_px=blurs_px[0],
        chroma_blur_px=blurs_px[1], iterations=iterations, reach_px=reach_px,
    )  # fmt: skip
    fit = _robust_cone(cone, where.azimuth_rad, limb, where.per_pixel_rad)
    if fit is None or fit[4] > max(MOST_SIGMA_PX, 0.3 * limb.blur_px):
        return None
    fitted, used, residual, weights, scale, coverage = fit
    covariance = _covariance(where.azimuth_rad, residual, weights, used, scale)
    systematic = SYSTEMATIC_PER_BLUR * limb.blur_px
    angle = float(np.median(where.per_pixel_rad))
    return _Measured(
        cone=fitted,
        limb=limb,
        coverage=coverage,
        sigma_px=scale,
        rms_px=float(np.sqrt(np.mean(residual[used] ** 2))),
        n_edges=int(used.sum()),
        contrast=float(np.median(limb.contrast[used])),
        systematic_px=systematic,
        covariance=(covariance + np.eye(3) * systematic**2) * angle**2,
    )


def _robust_cone(
    cone: Cone, azimuth: Array, limb: LimbFit, per_pixel: Array
) -> tuple[Cone, NDArray[np.bool_], Array, Array, float, float] | None:
    """Cone by Tukey's weights on the geometric distances, linear in the small step from the cone of the profiles.

    Returns the cone, the points used, residuals (px), weights, their robust scale (px) and the coverage.
    """
    ok = limb.ok
    if ok.sum() < 24:
        return None
    J = -distance_gradient(azimuth)
    scale_to = float(np.median(per_pixel))
    offset = limb.offset_px * per_pixel / scale_to
    # Texture beside the outline is no white noise, and no edge is known better than a few hundredths of a pixel.
    base = 1.0 / ((TEXTURE_FACTOR * limb.sigma_px) ** 2 + 0.05**2)
    weights = np.where(ok, base, 0.0)
    residual, scale = offset, 1.0
    step = np.zeros(3)
    for _ in range(6):
        w = J * weights[:, None]
        normal = w.T @ J
        if float(np.linalg.det(normal)) < 1e-9 * float(np.trace(normal)) ** 3:
            return None  # an arc too short to tell
        step = np.linalg.solve(normal, w.T @ offset)
        residual = offset - J @ step
        scale = max(0.03, 1.4826 * float(np.median(np.abs(residual[ok]))))
        u = residual / (4.0 * scale)
        weights = np.where(ok & (np.abs(u) < 1), base * (1 - u**2) ** 2, 0.0)
        if (weights > 0).sum() < 24:
            return None
    used = ok & (np.abs(residual) < 3.5 * scale)
    if used.sum() < 24:
        return None
    axis = cone.axis + cone.frame()[:, :2] @ step[:2] * scale_to
    fitted = Cone(axis / float(np.linalg.norm(axis)), cone.half_angle_rad + float(step[2]) * scale_to)
    coverage = float((ok & (np.abs(residual) < max(0.5, 3.5 * scale))).mean())
    return fitted, used, residual, weights, scale, coverage


def _covariance(azimuth: Array, residual: Array, weights: Array, used: NDArray[np.bool_], scale: float) -> Array:
    """(3, 3) of the cone's two directions and half angle in px², from the scatter of the edge points.

    Neighbouring edge points share pixels, texture and shading, so they err alike. Means over blocks of the outline
    show by how much more than independent points would: that factor multiplies the plain covariance.
    """
    J = -distance_gradient(azimuth)
    w = np.where(used, weights, 0.0)
    w = w / max(float(w.max()), 1e-12)
    normal_inverse = np.linalg.inv((J * w[:, None]).T @ J)
    noise = np.asarray(normal_inverse @ ((J * w[:, None] ** 2).T @ J) @ normal_inverse, dtype=np.float64) * scale**2
    block = (np.arange(len(azimuth)) * _BLOCKS) // len(azimuth)
    total = np.bincount(block, w, _BLOCKS)
    square = np.bincount(block, w * w, _BLOCKS)
    sums = np.bincount(block, w * np.where(used, residual, 0.0), _BLOCKS)
    filled = total > 0.25 * np.median(total)
    # Three parameters were fitted to these means.
    factor = float(np.sum(sums[filled] ** 2 / square[filled])) / max(int(filled.sum()) - 3, 3) / scale**2
    return noise * max(1.0, factor)


def _median_colour(image: NDArray[np.uint8], middle: Array, reach: float) -> tuple[float, float, float]:
    h, w = image.shape[:2]
    x0, x1 = (int(np.clip(middle[0] + s * reach, 0, w - 1)) for s in (-1, 1))
    y0, y1 = (int(np.clip(middle[1] + s * reach, 0, h - 1)) for s in (-1, 1))
    step = max(1, (x1 - x0) // 32)
    b, g, r = np.median(image[y0 : y1 + 1 : step, x0 : x1 + 1 : step].reshape(-1, 3), axis=0)
    return float(b), float(g), float(r)
