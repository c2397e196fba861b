"""Finds sub-pixel edges of a sphere's outline by fitting a forward model of its limb, from light to JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import ndtr

from service.core.geometry import Array

Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Coded = NDArray[np.uint8] | Array32  # 0 … 255; of a developed raw file not rounded

# Rows: Y, Cb, Cr of B, G, R (ITU-R BT.601, which JPEG uses).
TO_YCC = np.array([[0.114, 0.587, 0.299], [0.5, -0.331264, -0.168736], [-0.081312, -0.418688, 0.5]])
_MIX = TO_YCC.astype(np.float32)
# Of a profile: A (3), limb, inner slope, D (3), outer slope, offset; these are its OWN. Of an outline: blur, extra
# blur of the colours. ALL is their number, and the index of the residual.
LIMB, SLOPE, OUTER, OFFSET, OWN, ALL = 3, 4, 8, 9, 10, 12
_TABLE = np.linspace(-12.0, 12.0, 1201)


@dataclass(frozen=True, slots=True)
class LimbProfiles:
    """Values along K profiles across each of G outlines, lengths in the unit of the offsets.

    Attributes:
        coded_bgr: (G, K, J, 3) values along the profiles.
        offsets: (J,) positions across the outline, evenly spaced, positive outside.
        inside: (G, K) true if a profile lies in the image.
        radius: (G,) radius of the outlines.
        srgb: true if values are sRGB coded.
    """

    coded_bgr: Coded
    offsets: Array
    inside: Mask
    radius: Array
    srgb: bool


@dataclass(frozen=True, slots=True)
class LimbModel:
    """The data on which the forward model is evaluated.

    Attributes:
        data: (G, 3, K, J) Y, Cb, Cr of the profiles.
        t: (J,) offsets.
        wide: (J',) offsets with margins for the blur.
        sharp: (J', J) interpolation from `wide` to `t`.
        radius: (G,) radius of the outlines.
        tone: (G, 3) the spheres' colour in linear light.
        srgb: true if values are sRGB coded.
    """

    data: Array32
    t: Array
    wide: Array
    sharp: Array32
    radius: Array
    tone: Array32
    srgb: bool

    @classmethod
    def of(cls, profiles: LimbProfiles, tone: Array32) -> LimbModel:
        """Return the model of these profiles of spheres with these colours."""
        t = profiles.offsets
        step = float(t[1] - t[0])
        margin = int(np.ceil(3.6 / step)) if step < 0.8 else 3
        wide = t[0] - margin * step + step * np.arange(len(t) + 2 * margin)
        data = _mixed(np.moveaxis(profiles.coded_bgr, 3, 1).astype(np.float32) / np.float32(255))
        return cls(data, t, wide, _interpolation(t, wide), profiles.radius, tone, profiles.srgb)


@lru_cache(maxsize=1)
def _limb_table() -> tuple[Array32, Array32]:
    """Return E[sqrt(max(0, -(x + z)))] for z ~ N(0, 1), and its derivative, at _TABLE."""
    z = np.linspace(-6, 6, 2401)
    weight = np.exp(-0.5 * z**2)
    weight /= weight.sum()
    value = np.sqrt(np.maximum(0.0, -(_TABLE[:, None] + z))) @ weight
    return value.astype(np.float32), np.gradient(value, _TABLE).astype(np.float32)


@lru_cache(maxsize=2)
def light_of(*, srgb: bool) -> Array32:
    """Return (256,) linear light of each coded value."""
    x = np.arange(256) / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4) if srgb else x
    return linear.astype(np.float32)


def _to_light(coded: Coded, *, srgb: bool) -> Array32:
    """Return linear light of coded values."""
    if coded.dtype == np.uint8:
        return light_of(srgb=srgb)[coded.astype(np.uint8, copy=False)]
    x = coded / np.float32(255)
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4) if srgb else x
    return linear.astype(np.float32)


def _coded(linear: Array32, *, srgb: bool) -> tuple[Array32, Array32]:
    """Return the coded values of linear light, and their derivative."""
    if not srgb:
        return linear, np.ones_like(linear)
    x = np.maximum(linear, np.float32(1e-5))
    root = np.exp(np.log(x) * np.float32(1 / 2.4))  # twice as fast as a power
    low = x <= 0.0031308
    value = np.where(low, np.float32(12.92) * linear, np.float32(1.055) * root - np.float32(0.055))
    return value, np.where(low, np.float32(12.92), np.float32(1.055 / 2.4) * root / x)


def _smoothing(t: Array, wide: Array, blur: Array) -> tuple[Array32, Array32]:
    """Return matrices (G, J', J) that blur values at `wide` by Gaussians (G,) and sample at `t`, and derivatives."""
    s = blur[:, None, None]
    square = (t - wide[:, None]) ** 2
    weight = np.exp(-0.5 * square / s**2)
    weight /= weight.sum(axis=1, keepdims=True)
    slope = weight * square / s**3
    slope -= weight * slope.sum(axis=1, keepdims=True)
    return weight.astype(np.float32), slope.astype(np.float32)


def _interpolation(t: Array, wide: Array) -> Array32:
    """Return (J', J) mean effect of Lanczos interpolation on a profile, averaged over sub-pixel positions.

    The kernel is stretched to the mean over directions: along the pixels' diagonal it is narrower.
    """
    d = 1.1 * (t - wide[:, None])
    weight = np.where(np.abs(d) < 4, np.sinc(d) * np.sinc(d / 4), 0.0)
    return np.asarray(weight / weight.sum(axis=0), dtype=np.float32)


def _mixed(channels: Array32) -> Array32:
    """Return Y, Cb, Cr of channels (G, 3, K, J)."""
    return (_MIX @ channels.reshape(*channels.shape[:2], -1)).reshape(channels.shape)


@dataclass(frozen=True, slots=True)
class _BeforeBlur:
    """The model before interpolation and the colours' blur.

    Attributes:
        mixed: (G, 3, 6, K, J') Y, Cb, Cr: derivatives by limb, inner and outer slope, offset and blur; the value.
        slope: (G, 3, K, J') derivative of the coded values by linear light, for B, G, R.
        share: (G, K, J') share of the sphere in each sample.
    """

    mixed: Array32
    slope: Array32
    share: Array32


def _predict(p: Array, blur: Array, model: LimbModel) -> _BeforeBlur:
    """Predict grey values: the light of sphere and surroundings, blurred by lens and pixel, then gamma-encoded."""
    s = blur.astype(np.float32)[:, None, None]
    R = model.radius.astype(np.float32)[:, None, None]
    q = p.astype(np.float32)
    tones = model.tone[:, :, None, None]
    u = model.wide.astype(np.float32) - q[..., OFFSET, None]  # (G, K, J')
    x = np.clip(u / s, -12, 12)
    S = ndtr(-x)
    density = np.exp(-0.5 * x * x) * (np.float32(0.3989422804) / s)
    limb, d_limb = _limb_light(u, x, s, R)
    outer = u * (1 - S) + s * s * density  # E max(0, u + s z)
    inner = (outer - u) / R
    near = np.minimum(outer, 8)
    b, c, e = q[..., LIMB, None], q[..., SLOPE, None], q[..., OUTER, None]
    A, D = (np.ascontiguousarray(np.moveaxis(q[..., k : k + 3], 2, 1))[..., None] for k in (0, 5))  # (G, 3, K, 1)
    rest = 1 - S
    L = A * S[:, None] + tones * (b * limb + c * inner)[:, None] + D * (rest + e * near)[:, None]
    value, slope = _coded(np.asarray(L, dtype=np.float32), srgb=model.srgb)
    G, K, wider = u.shape
    by_tone, by_outer = _mixed(tones * slope), _mixed(D * slope)
    jump = _mixed(A * slope) - by_outer
    mixed = np.empty((G, 3, 6, K, wider), dtype=np.float32)
    mixed[:, :, 0] = limb[:, None] * by_tone
    mixed[:, :, 1] = inner[:, None] * by_tone
    mixed[:, :, 2] = near[:, None] * by_outer
    mixed[:, :, 3] = (
        density[:, None] * jump - (b * d_limb - c * S / R)[:, None] * by_tone - (e * rest)[:, None] * by_outer
    )
    mixed[:, :, 4] = (
        (x * density)[:, None] * jump
        + (b * (0.5 * limb / s - x * d_limb) + c * s * density / R)[:, None] * by_tone
        + (e * s * density)[:, None] * by_outer
    )
    mixed[:, :, 5] = _mixed(value)
    return _BeforeBlur(mixed, slope, S)


def _limb_light(u: Array32, x: Array32, s: Array32, R: Array32) -> tuple[Array32, Array32]:
    """Return the blurred light of a sphere towards its limb, and its derivative by the offset, without its sign.

    Args:
        u: (G, K, J') distances from the edge, positive outside.
        x: the distance in standard deviations of the blur, within ± 12.
        s: (G, 1, 1) standard deviations of the blur.
        R: (G, 1, 1) radii of the outlines.
    """
    table, d_table = _limb_table()
    # sqrt(1 - rho^2) = sqrt(d (2 - d)) at the depth d in radii; the second factor is smooth.
    deep = np.sqrt(np.maximum(0.2, 1 + np.minimum(u, 0) * (0.5 / R))) * np.sqrt(2 * s / R)
    place = (x + 12) * np.float32(50)
    low = np.minimum(place.astype(np.int32), len(_TABLE) - 2)
    part = place - low.astype(np.float32)
    value = (table[low] * (1 - part) + table[low + 1] * part) * deep
    slope = d_table[low] * deep / s
    return np.asarray(value, dtype=np.float32), np.asarray(slope, dtype=np.float32)


def evaluate(p: Array, blur: Array, chroma_blur: Array, model: LimbModel) -> tuple[Array32, Array32]:
    """Return the model's Jacobian and, last, residual (G, 13, 3, K, J) in Y, Cb, Cr; the sphere's share (G, K, J)."""
    shown = _predict(p, blur, model)
    mixed, S, sharp = shown.mixed, shown.share, model.sharp
    G, K, wider = S.shape
    J = len(model.t)
    smooth, d_smooth = _smoothing(model.t, model.wide, chroma_blur)
    rows = np.empty((G, ALL + 1, 3, K, J), dtype=np.float32)
    columns = [LIMB, SLOPE, OUTER, OFFSET, OWN, ALL]
    rows[:, columns, 0] = (mixed[:, 0].reshape(G, -1, wider) @ sharp).reshape(G, 6, K, J)
    colour = (mixed[:, 1:].reshape(G, -1, wider) @ smooth).reshape(G, 2, 6, K, J)
    rows[:, columns, 1], rows[:, columns, 2] = colour[:, 0], colour[:, 1]
    rows[:, ALL] = model.data - rows[:, ALL]
    rows[:, OWN + 1, 0] = 0
    rows[:, OWN + 1, 1:] = (mixed[:, 1:, 5].reshape(G, -1, wider) @ d_smooth).reshape(G, 2, K, J)
    # Columns of a colour's own parameters affect only its channel.
    for first, part_of in ((0, S), (5, 1 - S)):
        single = (shown.slope * part_of[:, None]).reshape(G, -1, wider)
        rows[:, first : first + 3, 0] = (single @ sharp).reshape(G, 3, K, J) * _MIX[0][:, None, None]
        blurred = (single @ smooth).reshape(G, 3, K, J)
        for k in (1, 2):
            rows[:, first : first + 3, k] = blurred * _MIX[k][:, None, None]
    first = (wider - J) // 2
    return rows, S[..., first : first + J]


# Sub-pixel edges of a sphere's outline, by fitting a forward model of the limb to profiles across the outline.
#
# Shading, blur and JPEG each shift the apparent edge, so all are modelled, not corrected afterwards.
#
# The outlines of an image are fitted in parallel, each with its own blur. They do not affect one another; batching
# only reduces the overhead of small arrays.


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
    """Return the medians along the last axis of the values selected by the mask; infinite if there are none."""
    ordered = np.sort(np.where(mask, values, np.inf), axis=-1)
    count = np.broadcast_to(mask, values.shape).sum(axis=-1, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=-1)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[-1] - 1), axis=-1)
    return np.asarray(0.5 * (low + high)[..., 0], dtype=np.float64)


def fit_limb(
    profiles: LimbProfiles, *, blur: Array, chroma_blur: Array, iterations: int = 4, reach: float = 2.0
) -> LimbFit:
    """Return the edges by Gauss–Newton on the forward model, with one blur for all profiles of an outline.

    Lengths are in one unit: the image's pixel, or the step over which samples were averaged. The loop is its own and
    has a fixed number of steps: before each, noise, selection of profiles and priors are estimated again, so there is
    no fixed cost to descend.

    Args:
        profiles: the values.
        blur: (G,) initial standard deviation of lens and pixel.
        chroma_blur: (G,) initial extra standard deviation of the colour differences; about 1.1 for 4:2:0.
        iterations: number of Gauss–Newton steps.
        reach: largest offset of an edge.
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
        p = _step(p, delta, reach)
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
    """The prior of the profiles' shading: the limb's rise is similar all around, and slopes are small.

    Values are (G, K), and how far a profile may deviate is (G, 1).
    """

    limb: Array
    limb_sigma: Array
    slope: Array
    slope_sigma: Array

    def priors(self) -> tuple[tuple[int, Array | float, Array | float], ...]:
        """Return (index, value, sigma) of these and of the profiles' other parameters with a prior."""
        return (
            (LIMB, self.limb, self.limb_sigma),
            (SLOPE, self.slope, self.slope_sigma),
            (OUTER, 0.0, 0.04),
            (OFFSET, 0.0, 1.5),
        )

    def renewed(self, p: Array, good: Mask) -> _Shading:
        """Return the shading seen in the profiles' parameters; the former one for outlines with few good profiles."""
        enough = good.sum(axis=1, keepdims=True) > 16
        seen = (*_around(p[..., LIMB], good, 0.02), *_around(p[..., SLOPE], good, 0.1))
        before = (self.limb, self.limb_sigma, self.slope, self.slope_sigma)
        return _Shading(*(np.where(enough, a, b) for a, b in zip(seen, before, strict=True)))


def _products(rows: Array32, share: Array32, inside: Array, outside: Array) -> Array:
    """Return products (G, K, 13, 13) of the rows, weighted by standard deviations (G, 3) on both sides of the edge.

    `rows` (G, 13, 3, K, J) are weighted in place, and (G, K, J) is the sphere's `share` in each sample.
    """
    G, _, _, K, J = rows.shape
    inner, outer = ((sd[:, :, None, None] ** 2).astype(np.float32) for sd in (inside, outside))
    rows *= (1 / np.sqrt(outer + (inner - outer) * share[:, None]))[:, None]
    rows = np.ascontiguousarray(rows.transpose(0, 3, 1, 2, 4)).reshape(G, K, ALL + 1, 3 * J)
    return np.asarray(rows @ rows.transpose(0, 1, 3, 2), dtype=np.float64)


def _step(p: Array, delta: Array, reach: float) -> Array:
    """Return the profiles' parameters after a step, within their limits."""
    delta[..., OFFSET] = np.clip(delta[..., OFFSET], -0.7, 0.7)
    p = p + delta
    p[..., OFFSET] = np.clip(p[..., OFFSET], -reach, reach)
    for colour in (slice(0, 3), slice(5, 8)):
        p[..., colour] = np.clip(p[..., colour], 1e-4, 1.5)
    return p


def _gauss_newton(
    normal: Array, p: Array, priors: tuple[tuple[int, Array | float, Array | float], ...], good: Mask
) -> tuple[Array, Array, Array]:
    """Return steps of the profiles' (G, K, 10) and outlines' (G, 2) parameters, and the offset's formal variance.

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
    """Return a shading term averaged over the neighbourhood (G, K), and how far single profiles may deviate (G, 1).

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
    """Return (G, 3) the spheres' colour in linear light, of unit luma, measured away from the edges."""
    t = profiles.offsets
    inner = np.moveaxis(profiles.coded_bgr[:, :, t < t[0] + 2.1], 3, 1)  # (G, 3, K, n)
    mask = np.broadcast_to(usable[:, None, :, None], inner.shape)
    flat = (*inner.shape[:2], -1)
    colour = masked_median(_to_light(inner, srgb=profiles.srgb).reshape(flat), mask.reshape(flat))
    return (colour / np.maximum(colour @ TO_YCC[0], 1e-4)[:, None]).astype(np.float32)


def _start(profiles: LimbProfiles) -> Array:
    coded, t = profiles.coded_bgr, profiles.offsets
    p = np.zeros((*coded.shape[:2], OWN))
    for first, side in ((0, (t < -1.2) & (t > -4)), (5, (t > 1.2) & (t < 4))):
        p[..., first : first + 3] = np.maximum(_to_light(coded[:, :, side], srgb=profiles.srgb).mean(axis=2), 1e-4)
    return p


def _scales(r: Array32, share: Array32, usable: Mask) -> tuple[Array, Array]:
    """Return the robust standard deviations (G, 3) of the residuals inside and outside the sphere."""
    size = np.abs(r).reshape(*r.shape[:2], -1)
    out: list[Array] = []
    for side in (share > 0.9, share < 0.1):
        mask = (side & usable[..., None]).reshape(len(r), 1, -1)
        median = masked_median(size, np.broadcast_to(mask, size.shape))
        out.append(np.where(np.isfinite(median), np.maximum(1.4826 * median, 0.0025), 0.02))
    return out[0], out[1]
