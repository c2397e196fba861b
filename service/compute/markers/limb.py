"""Sub-pixel places of a sphere's outline: a forward model of the limb, from light to JPEG, fitted to profiles.

The model of one profile, in linear light: inside a shaded sphere, outside a surface with a slope, both blurred by the
lens and the pixel; then the transfer curve, luma and colour differences, and the loss of resolution that the colour
differences suffer in JPEG. Because every one of these moves the apparent edge, none of them is taken off afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import ndtr

from service.compute.markers.edges import Profiles
from service.core.geometry import Array

# Rows: Y, Cb, Cr of B, G, R (ITU-R BT.601, which JPEG uses).
TO_YCC = np.array([[0.114, 0.587, 0.299], [0.5, -0.331264, -0.168736], [-0.081312, -0.418688, 0.5]])
# Of a profile: A (3), limb, inner slope, D (3), outer slope, offset. Common: blur, blur of the colour differences.
_N = 12
_OFFSET, _OWN = 9, 10
_TABLE = np.linspace(-12.0, 12.0, 1201)


@dataclass(frozen=True, slots=True)
class LimbFit:
    """Edges of K profiles: offset and formal sigma (px), usable, misfit (1 is typical), and what they share."""

    offset_px: Array
    sigma_px: Array
    ok: NDArray[np.bool_]
    misfit: Array
    contrast: Array  # (K,) largest step of a linear channel over full scale
    blur_px: float
    chroma_blur_px: float
    cost: float


@lru_cache(maxsize=1)
def _limb_table() -> tuple[Array, Array]:
    """E[sqrt(max(0, -(x + z)))] for z ~ N(0, 1), and its derivative, at _TABLE."""
    z = np.linspace(-6, 6, 2401)
    weight = np.exp(-0.5 * z**2)
    weight /= weight.sum()
    value = np.sqrt(np.maximum(0.0, -(_TABLE[:, None] + z))) @ weight
    return value.astype(np.float32), np.gradient(value, _TABLE).astype(np.float32)


def _coded(linear: Array, *, srgb: bool) -> tuple[Array, Array]:
    """Values as coded in the image, and their derivative."""
    if not srgb:
        return linear, np.ones_like(linear)
    x = np.maximum(linear, np.float32(1e-5))
    root = x ** np.float32(1 / 2.4)
    low = x <= 0.0031308
    value = np.where(low, np.float32(12.92) * linear, np.float32(1.055) * root - np.float32(0.055))
    return value, np.where(low, np.float32(12.92), np.float32(1.055 / 2.4) * root / x)


def _smoothing(t: Array, wide: Array, blur_px: float) -> tuple[Array, Array]:
    """(J, J') what takes values at `wide` to values at `t` blurred by a Gaussian, and its derivative by the blur."""
    square = (t[:, None] - wide) ** 2
    weight = np.exp(-0.5 * square / blur_px**2)
    total = weight.sum(axis=1, keepdims=True)
    weight /= total
    slope = weight * square / blur_px**3
    slope -= weight * slope.sum(axis=1, keepdims=True)
    return weight.astype(np.float32), slope.astype(np.float32)


def _interpolation(t: Array, wide: Array) -> NDArray[np.float32]:
    """(J, J') what Lanczos interpolation of the pixels does to a profile on the average over the pixels' places.

    The kernel is stretched to the mean of the directions: across the pixels' diagonal it is narrower.
    """
    d = 1.1 * (t[:, None] - wide)
    weight = np.where(np.abs(d) < 4, np.sinc(d) * np.sinc(d / 4), 0.0)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True), dtype=np.float32)


def fit_limb(
    coded_bgr: NDArray[np.float32],
    where: Profiles,
    radius_px: float,
    *,
    srgb: bool,
    blur_px: float,
    chroma_blur_px: float,
    iterations: int = 4,
    reach_px: float = 2.0,
) -> LimbFit:
    """Edges by Gauss–Newton of the forward model, the blur common to all profiles.

    Args:
        coded_bgr: (K, J, 3) values 0..255 along the profiles.
        where: the profiles, their offsets evenly spaced.
        radius_px: of the outline.
        srgb: values carry the sRGB curve.
        blur_px: standard deviation of lens and pixel, to start from.
        chroma_blur_px: further standard deviation of the colour differences, to start from; about 1.1 for 4:2:0.
        iterations: of Gauss–Newton.
        reach_px: greatest offset.
    """
    t = where.offsets_px
    step = float(t[1] - t[0])
    margin = int(np.ceil(3.6 / step)) if step < 0.8 else 3
    wide = t[0] - margin * step + step * np.arange(len(t) + 2 * margin)
    data = np.asarray(coded_bgr @ (TO_YCC.T / 255), dtype=np.float32)  # (K, J, 3)
    K, J = data.shape[:2]
    usable = np.all(where.inside, axis=1)
    if not usable.any():
        usable = np.ones(K, dtype=bool)
    p = _start(coded_bgr, t, srgb=srgb)
    common = np.array([blur_px, chroma_blur_px])
    limb, limb_sigma = np.zeros(K), 1.0
    slope, slope_sigma = np.zeros(K), 5.0
    sd_in, sd_out = np.full(3, 0.01), np.full(3, 0.03)
    own = np.zeros((K, _OWN, _OWN))
    misfit, typical = np.ones(K), 1.0
    albedo = _albedo(coded_bgr[usable], t, srgb=srgb)
    for it in range(iterations):
        model, jacobian, S = _evaluate(p, common, t, wide, radius_px, albedo, srgb=srgb)
        r = data - model  # (K, J, 3)
        if it > 0:
            sd_in, sd_out = _scales(r[usable], S[usable])
        share = S[..., None]
        w = (1.0 / (sd_in**2 * share + sd_out**2 * (1 - share))).astype(np.float32)
        misfit = np.sum(r * r * w, axis=(1, 2)) / (3 * J)
        typical = float(np.median(misfit[usable]))
        # The limb's rise is alike all around, slopes are small, the offset is near.
        priors = ((3, limb, limb_sigma), (4, slope, slope_sigma), (8, 0.0, 0.04), (_OFFSET, 0.0, 1.5))
        good = usable & (misfit < 4 * typical)
        delta, change, own = _gauss_newton(jacobian, r, w, p, priors, good)
        common = np.clip(common + change, [0.3, 0.3], [5.0, 2.5])
        delta[:, _OFFSET] = np.clip(delta[:, _OFFSET], -0.7, 0.7)
        p = p + delta
        p[:, _OFFSET] = np.clip(p[:, _OFFSET], -reach_px, reach_px)
        p[:, [0, 1, 2, 5, 6, 7]] = np.clip(p[:, [0, 1, 2, 5, 6, 7]], 1e-4, 1.5)
        if 1 <= it < iterations - 1 and good.sum() > 16:
            limb, limb_sigma = _around(p[:, 3], good, 0.02)
            slope, slope_sigma = _around(p[:, 4], good, 0.1)
    variance = np.linalg.inv(own)[:, _OFFSET, _OFFSET]
    sigma = np.sqrt(variance * np.maximum(misfit, 0.3 * typical))
    contrast = np.abs(p[:, :3] - p[:, 5:8]).max(axis=1)
    ok = usable & (np.abs(p[:, _OFFSET]) < reach_px - 1e-3) & (sigma < 0.6) & (misfit < 9 * typical)
    # The blur also works along the outline, which bends away: it pulls the edge of a disc inwards.
    offset = p[:, _OFFSET] + common[0] ** 2 / (2 * radius_px)
    return LimbFit(offset, sigma, ok, misfit / typical, contrast, float(common[0]), float(common[1]), typical)


def _gauss_newton(
    jacobian: NDArray[np.float32],
    residual: NDArray[np.float32],
    w: NDArray[np.float32],
    p: Array,
    priors: tuple[tuple[int, Array | float, float], ...],
    good: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """Steps of the profiles' own (K, 10) and of the common (2,) parameters, and the normal matrices of the own.

    The own parameters are eliminated profile by profile; `priors` are (index, value, sigma), `good` the profiles that
    may tell of what is common.
    """
    K = len(p)
    flat = jacobian.reshape(K, _N, -1)
    weighted = flat * w.reshape(K, 1, -1)
    full = (weighted @ flat.transpose(0, 2, 1)).astype(np.float64)
    g = (weighted @ residual.reshape(K, -1, 1))[..., 0].astype(np.float64)
    for index, middle, sigma in priors:
        full[:, index, index] += sigma**-2
        g[:, index] += (middle - p[:, index]) * sigma**-2
    diagonal = np.einsum("kii->ki", full)
    diagonal *= 1 + 1e-6
    diagonal += 1e-9
    own, cross = full[:, :_OWN, :_OWN], full[:, :_OWN, _OWN:]
    solved = np.linalg.solve(own, np.concatenate([g[:, :_OWN, None], cross], axis=2))
    seen = cross.transpose(0, 2, 1) @ solved
    reduced = (full[:, _OWN:, _OWN:] - seen[:, :, 1:])[good].sum(axis=0)
    pull = (g[:, _OWN:] - seen[:, :, 0])[good].sum(axis=0)
    change = np.clip(np.linalg.solve(reduced + 1e-6 * np.eye(2), pull), -0.3, 0.6)
    return solved[:, :, 0] - solved[:, :, 1:] @ change, change, own


def _around(values: Array, good: NDArray[np.bool_], least: float) -> tuple[Array, float]:
    """A term of the shading as it is in the neighbourhood (K,), and how far single profiles may depart from it.

    A running median over a twelfth of the outline keeps the jump where the light's terminator meets the limb.
    """
    half = max(2, len(values) // 24)
    kept = np.where(good, values, np.nan)
    padded = np.concatenate([kept[-half:], kept, kept[:half]])
    windows = np.sort(sliding_window_view(padded, 2 * half + 1), axis=1)  # NaN sorts last
    count = np.isfinite(windows).sum(axis=1)
    smooth = windows[np.arange(len(values)), np.maximum(count - 1, 0) // 2]
    smooth = np.where(count > 0, smooth, float(np.median(values[good])))
    spread = 1.4826 * float(np.median(np.abs(values - smooth)[good]))
    return smooth, max(least, 0.5 * spread)


def _albedo(coded_bgr: NDArray[np.float32], t: Array, *, srgb: bool) -> Array:
    """(3,) the sphere's colour in linear light, of unit luma, from where no edge reaches."""
    colour = np.median(_linear(coded_bgr[:, t < t[0] + 2.1], srgb=srgb), axis=(0, 1))
    return colour / max(float(TO_YCC[0] @ colour), 1e-4)


def _linear(coded_bgr: NDArray[np.float32], *, srgb: bool) -> Array:
    x = np.asarray(coded_bgr / np.float32(255), dtype=np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4) if srgb else x


def _start(coded_bgr: NDArray[np.float32], t: Array, *, srgb: bool) -> Array:
    linear = _linear(coded_bgr, srgb=srgb)
    inside, outside = (t < -1.2) & (t > -4), (t > 1.2) & (t < 4)
    p = np.zeros((len(linear), _OWN))
    p[:, :3] = np.maximum(linear[:, inside].mean(axis=1), 1e-4)
    p[:, 5:8] = np.maximum(linear[:, outside].mean(axis=1), 1e-4)
    return p


def _scales(r: NDArray[np.float32], S: NDArray[np.float32]) -> tuple[Array, Array]:
    """Robust standard deviations (3,) of residuals inside and outside."""
    out: list[Array] = []
    for side in (S > 0.9, S < 0.1):
        values = np.abs(r[side])
        out.append(np.maximum(1.4826 * np.median(values, axis=0), 0.0025) if len(values) else np.full(3, 0.02))
    return out[0], out[1]


def _evaluate(
    p: Array, common: Array, t: Array, wide: Array, radius_px: float, albedo: Array, *, srgb: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Model (K, J, 3) in Y, Cb, Cr, its Jacobian (K, P, J, 3), and the sphere's share (K, J)."""
    s = np.float32(common[0])
    q = p.astype(np.float32)
    radius = np.float32(radius_px)
    tone = albedo.astype(np.float32)
    u = wide.astype(np.float32) - q[:, _OFFSET, None]  # (K, J')
    x = np.clip(u / s, -12, 12)
    S = ndtr(-x)
    density = np.exp(-0.5 * x * x) * (np.float32(0.3989422804) / s)
    table, d_table = _limb_table()
    # sqrt(1 - rho^2) = sqrt(d (2 - d)) at the depth d in radii; the second factor is smooth.
    deep = np.sqrt(np.maximum(0.2, 1 - 0.5 * np.maximum(-u, 0) / radius)) * np.sqrt(2 * s / radius)
    place = (x + 12) * np.float32(50)
    low = np.minimum(place.astype(np.int32), len(_TABLE) - 2)
    part = place - low
    limb = (table[low] * (1 - part) + table[low + 1] * part) * deep
    d_limb = d_table[low] * deep / s
    outer = u * (1 - S) + s * s * density  # E max(0, u + s z)
    inner = (outer - u) / radius
    outer_near = np.minimum(outer, 8)
    b, c, e = q[:, 3, None], q[:, 4, None], q[:, 8, None]
    A, D = q[:, None, :3], q[:, None, 5:8]
    L = A * S[..., None] + (b * limb + c * inner)[..., None] * tone + D * (1 + e * outer_near - S)[..., None]
    value, slope = _coded(L, srgb=srgb)
    K, wider = u.shape
    columns = np.zeros((K, _N - 1, wider, 3), dtype=np.float32)
    # A colour's own columns have only that channel.
    for channel in range(3):
        columns[:, channel, :, channel] = S
        columns[:, 5 + channel, :, channel] = 1 - S
    columns[:, 3] = limb[..., None] * tone
    columns[:, 4] = inner[..., None] * tone
    columns[:, 8] = D * outer_near[..., None]
    jump = A - D
    columns[:, _OFFSET] = (
        jump * density[..., None] - (b * d_limb - c * S / radius)[..., None] * tone - D * (e * (1 - S))[..., None]
    )
    columns[:, _OWN] = (
        jump * (x * density)[..., None]
        + (b * (0.5 * limb / s - x * d_limb) + c * s * density / radius)[..., None] * tone
        + D * (e * s * density)[..., None]
    )
    columns *= slope[:, None]
    to_ycc = TO_YCC.T.astype(np.float32)
    columns = columns @ to_ycc  # (K, P, J', 3)
    smooth, d_smooth = _smoothing(t, wide, float(common[1]))
    sharp = _interpolation(t, wide)
    first = (wider - len(t)) // 2
    jacobian = np.empty((K, _N, len(t), 3), dtype=np.float32)
    jacobian[:, :-1, :, 0] = columns[..., 0] @ sharp.T
    jacobian[:, :-1, :, 1:] = smooth @ columns[..., 1:]
    ycc = value @ to_ycc
    jacobian[:, -1, :, 0] = 0
    jacobian[:, -1, :, 1:] = d_smooth @ ycc[..., 1:]
    model = np.empty((K, len(t), 3), dtype=np.float32)
    model[..., 0] = ycc[..., 0] @ sharp.T
    model[..., 1:] = smooth @ ycc[..., 1:]
    return model, jacobian, S[:, first : first + len(t)]
