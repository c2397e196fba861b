"""Sub-pixel edges of a sphere's outline, by fitting a forward model of the limb to profiles across the outline.

Shading, blur and JPEG each shift the apparent edge, so all are modelled (`limb_model`), not corrected afterwards.

The outlines of an image are fitted in parallel, each with its own blur. They do not affect one another; batching only
reduces the overhead of small arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from service.compute.markers.outlines.limb_model import (
    ALL,
    LIMB,
    OFFSET,
    OUTER,
    OWN,
    SLOPE,
    TO_YCC,
    Array32,
    LimbModel,
    LimbProfiles,
    Mask,
    evaluate,
    to_light,
)
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class LimbFit:
    """Edges of K profiles for each of G outlines, lengths in the unit of the profiles' offsets.

    Offset, formal sigma, usable, and contrast (largest step of a linear channel over full scale) are (G, K); blur and
    the extra blur of the colour differences are (G,).
    """

    offset: Array
    sigma: Array
    ok: Mask
    contrast: Array
    blur: Array
    chroma_blur: Array


def masked_median(values: Array | Array32, mask: Mask) -> Array:
    """Medians along the last axis of the values selected by the mask; infinite if there are none."""
    ordered = np.sort(np.where(mask, values, np.inf), axis=-1)
    count = np.broadcast_to(mask, values.shape).sum(axis=-1, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=-1)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[-1] - 1), axis=-1)
    return np.asarray(0.5 * (low + high)[..., 0], dtype=np.float64)


def fit_limb(
    profiles: LimbProfiles, *, blur: Array, chroma_blur: Array, iterations: int = 4, reach: float = 2.0
) -> LimbFit:
    """Edges by Gauss–Newton on the forward model, with one blur for all profiles of an outline.

    Lengths are in one unit: the image's pixel, or the step over which samples were averaged. The loop is its own and
    has a fixed number of steps: before each, noise, selection of profiles and priors are estimated again, so there is
    no fixed cost to descend.

    Args:
        profiles: the values.
        blur: (G,) initial standard deviation of lens and pixel.
        chroma_blur: (G,) initial extra standard deviation of the colour differences; about 1.1 for 4:2:0.
        iterations: number of Gauss–Newton steps.
        reach: largest offset.
    """
    inside = profiles.inside
    usable = np.where(inside.any(axis=1, keepdims=True), inside, True)
    p = _start(profiles)
    model = LimbModel.of(profiles, _albedo(profiles, usable))
    G, K, J = profiles.coded_bgr.shape[:3]
    blur, chroma_blur = blur.astype(np.float64), chroma_blur.astype(np.float64)
    shading = _Shading(np.zeros((G, K)), np.full((G, 1), 1.0), np.zeros((G, K)), np.full((G, 1), 5.0))
    spread = np.full((G, 3), 0.01), np.full((G, 3), 0.03)
    variance, misfit, typical = np.ones((G, K)), np.ones((G, K)), np.ones((G, 1))
    for it in range(iterations):
        rows, share = evaluate(p, blur, chroma_blur, model)
        if it > 0:
            spread = _scales(rows[:, ALL], share, usable)
        normal = _products(rows, share, *spread)
        misfit = normal[..., ALL, ALL] / (3 * J)
        typical = masked_median(misfit, usable)[:, None]
        good = usable & (misfit < 4 * typical)
        delta, change, variance = _gauss_newton(normal, p, shading.priors(), good)
        blur = np.clip(blur + change[:, 0], 0.3, 5.0)
        chroma_blur = np.clip(chroma_blur + change[:, 1], 0.3, 2.5)
        p = _moved(p, delta, reach)
        if 1 <= it < iterations - 1:
            shading = shading.renewed(p, good)
    sigma = np.sqrt(variance * np.maximum(misfit, 0.3 * typical))
    contrast = np.abs(p[..., :3] - p[..., 5:8]).max(axis=2)
    ok = usable & (np.abs(p[..., OFFSET]) < reach - 1e-3) & (sigma < 0.6) & (misfit < 9 * typical)
    # Blur also acts along the curved outline, which shifts the edge of a disc inwards.
    offset = p[..., OFFSET] + (blur**2 / (2 * profiles.radius))[:, None]
    return LimbFit(offset, sigma, ok, contrast, blur, chroma_blur)


@dataclass(frozen=True, slots=True)
class _Shading:
    """What is known about the profiles' shading: the limb's rise is similar all around, and slopes are small.

    Values are (G, K), and how far a profile may deviate is (G, 1).
    """

    limb: Array
    limb_sigma: Array
    slope: Array
    slope_sigma: Array

    def priors(self) -> tuple[tuple[int, Array | float, Array | float], ...]:
        """(index, value, sigma) of these and of the profiles' other parameters with a prior."""
        return (
            (LIMB, self.limb, self.limb_sigma),
            (SLOPE, self.slope, self.slope_sigma),
            (OUTER, 0.0, 0.04),
            (OFFSET, 0.0, 1.5),
        )

    def renewed(self, p: Array, good: Mask) -> _Shading:
        """The shading seen in the profiles' parameters; the former one for outlines with few good profiles."""
        enough = good.sum(axis=1, keepdims=True) > 16
        seen = (*_around(p[..., LIMB], good, 0.02), *_around(p[..., SLOPE], good, 0.1))
        before = (self.limb, self.limb_sigma, self.slope, self.slope_sigma)
        return _Shading(*(np.where(enough, a, b) for a, b in zip(seen, before, strict=True)))


def _products(rows: Array32, share: Array32, inside: Array, outside: Array) -> Array:
    """Products (G, K, 13, 13) of the rows, weighted by their standard deviations (G, 3) on both sides of the edge.

    `rows` (G, 13, 3, K, J) are weighted in place, and (G, K, J) is the sphere's `share` in each sample.
    """
    G, _, _, K, J = rows.shape
    inner, outer = ((sd[:, :, None, None] ** 2).astype(np.float32) for sd in (inside, outside))
    rows *= (1 / np.sqrt(outer + (inner - outer) * share[:, None]))[:, None]
    rows = np.ascontiguousarray(rows.transpose(0, 3, 1, 2, 4)).reshape(G, K, ALL + 1, 3 * J)
    return np.asarray(rows @ rows.transpose(0, 1, 3, 2), dtype=np.float64)


def _moved(p: Array, delta: Array, reach: float) -> Array:
    """The profiles' parameters after a step, within their limits."""
    delta[..., OFFSET] = np.clip(delta[..., OFFSET], -0.7, 0.7)
    p = p + delta
    p[..., OFFSET] = np.clip(p[..., OFFSET], -reach, reach)
    for colour in (slice(0, 3), slice(5, 8)):
        p[..., colour] = np.clip(p[..., colour], 1e-4, 1.5)
    return p


def _gauss_newton(
    normal: Array, p: Array, priors: tuple[tuple[int, Array | float, Array | float], ...], good: Mask
) -> tuple[Array, Array, Array]:
    """Steps of the profiles' own (G, K, 10) and of the outlines' (G, 2) parameters, and the offset's formal variance.

    `normal` (G, K, 13, 13) holds the weighted products of the Jacobian's columns and, last, the residual. The
    profiles' own parameters are eliminated; `priors` are (index, value, sigma); `good` selects the profiles used for
    the common parameters.
    """
    own, cross, g = normal[..., :OWN, :OWN], normal[..., :OWN, OWN:ALL], normal[..., :ALL, ALL]
    for index, middle, sigma in priors:
        weight = np.asarray(sigma, dtype=np.float64) ** -2
        own[..., index, index] += weight
        g[..., index] += (middle - p[..., index]) * weight
    diagonal = np.einsum("gkii->gki", normal[..., :ALL, :ALL])
    diagonal *= 1 + 1e-6
    diagonal += 1e-9
    unit = np.zeros((*g.shape[:2], OWN, 1))
    unit[..., OFFSET, 0] = 1
    solved = np.linalg.solve(own, np.concatenate([g[..., :OWN, None], cross, unit], axis=3))
    seen = cross.transpose(0, 1, 3, 2) @ solved[..., :3]
    mine = good[..., None, None]
    reduced = ((normal[..., OWN:ALL, OWN:ALL] - seen[..., 1:]) * mine).sum(axis=1)
    pull = ((g[..., OWN:] - seen[..., 0]) * mine[..., 0]).sum(axis=1)
    change = np.clip(np.linalg.solve(reduced + 1e-6 * np.eye(2), pull[..., None])[..., 0], -0.3, 0.6)
    steps = solved[..., 0] - (solved[..., 1:3] @ change[:, None, :, None])[..., 0]
    return steps, change, np.asarray(solved[..., OFFSET, 3], dtype=np.float64)


def _around(values: Array, good: Mask, least: float) -> tuple[Array, Array]:
    """A shading term averaged over the neighbourhood (G, K), and how far single profiles may deviate (G, 1).

    A running median over a twelfth of the outline preserves the jump where the light's terminator meets the limb.
    """
    half = max(2, values.shape[1] // 24)
    kept = np.where(good, values, np.nan)
    padded = np.concatenate([kept[:, -half:], kept, kept[:, :half]], axis=1)
    windows = np.sort(sliding_window_view(padded, 2 * half + 1, axis=1), axis=2)  # NaN sorts last
    count = np.isfinite(windows).sum(axis=2)
    smooth = np.take_along_axis(windows, (np.maximum(count - 1, 0) // 2)[..., None], axis=2)[..., 0]
    smooth = np.where(count > 0, smooth, masked_median(values, good)[:, None])
    spread = 1.4826 * masked_median(np.abs(values - smooth), good)
    return smooth, np.maximum(least, 0.5 * spread)[:, None]


def _albedo(profiles: LimbProfiles, usable: Mask) -> Array32:
    """(G, 3) the spheres' colour in linear light, of unit luma, measured away from the edges."""
    t = profiles.offsets
    inner = np.moveaxis(profiles.coded_bgr[:, :, t < t[0] + 2.1], 3, 1)  # (G, 3, K, n)
    mask = np.broadcast_to(usable[:, None, :, None], inner.shape)
    flat = (*inner.shape[:2], -1)
    colour = masked_median(to_light(inner, srgb=profiles.srgb).reshape(flat), mask.reshape(flat))
    return (colour / np.maximum(colour @ TO_YCC[0], 1e-4)[:, None]).astype(np.float32)


def _start(profiles: LimbProfiles) -> Array:
    coded, t = profiles.coded_bgr, profiles.offsets
    p = np.zeros((*coded.shape[:2], OWN))
    for first, side in ((0, (t < -1.2) & (t > -4)), (5, (t > 1.2) & (t < 4))):
        p[..., first : first + 3] = np.maximum(to_light(coded[:, :, side], srgb=profiles.srgb).mean(axis=2), 1e-4)
    return p


def _scales(r: Array32, share: Array32, usable: Mask) -> tuple[Array, Array]:
    """Robust standard deviations (G, 3) of the residuals inside and outside the sphere."""
    size = np.abs(r).reshape(*r.shape[:2], -1)
    out: list[Array] = []
    for side in (share > 0.9, share < 0.1):
        mask = (side & usable[..., None]).reshape(len(r), 1, -1)
        median = masked_median(size, np.broadcast_to(mask, size.shape))
        out.append(np.where(np.isfinite(median), np.maximum(1.4826 * median, 0.0025), 0.02))
    return out[0], out[1]
