"""Finds discs in a reduced image by votes of edge pixels, and the edges on profiles across an outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, ransac_cone
from service.compute.markers.records import ColourModel, DetectionOptions, given_colour
from service.core.geometry import Array

Pixels = NDArray[np.uint8] | NDArray[np.uint16]  # 16 bits of a developed raw file: sRGB coded, 257 times as fine
FINER = 257  # values of 16 bits for each of 8 bits


@dataclass(frozen=True, slots=True)
class Profiles:
    """Sample positions across a cone's outline in the image.

    `pixels` (K, J, 2) for K azimuths and J offsets; `inside` (K, J) whether in the image; `per_pixel_rad` (K,) the
    angle that one pixel subtends across the outline. For G cones, these have a leading axis (G, ...).
    """

    azimuth_rad: Array
    offsets_px: Array
    pixels: Array
    inside: NDArray[np.bool_]
    per_pixel_rad: Array


def profiles(cone: Cone, camera: CameraModel, n_azimuths: int, offsets_px: Array) -> Profiles:
    """Sample positions across the outline, with the lens distortion applied, so that edges need no undistortion."""
    where = profiles_of([cone], camera, n_azimuths, offsets_px)
    return Profiles(where.azimuth_rad, offsets_px, where.pixels[0], where.inside[0], where.per_pixel_rad[0])


def profiles_of(cones: Sequence[Cone], camera: CameraModel, n_azimuths: int, offsets_px: Array) -> Profiles:
    """Sample positions across the outlines of G cones, as `profiles` does for one."""
    azimuth = np.linspace(0.0, 2 * np.pi, n_azimuths, endpoint=False).astype(np.float64)
    half = np.array([c.half_angle_rad for c in cones])[:, None]
    frames = np.array([c.frame() for c in cones])
    around = np.cos(azimuth)[:, None] * frames[:, None, :, 0] + np.sin(azimuth)[:, None] * frames[:, None, :, 1]
    axis = frames[:, None, None, :, 2]

    def projected(angles: Array) -> Array:
        rays = np.sin(angles)[..., None] * around[:, :, None] + np.cos(angles)[..., None] * axis
        return camera.project(rays.reshape(-1, 3)).reshape(*angles.shape, 2)

    delta = 0.5 / camera.fx
    ends = projected(np.broadcast_to(half[..., None] + [-delta, delta], (len(cones), n_azimuths, 2)))
    per_pixel = 2 * delta / np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=2)
    pixels = projected(half[..., None] + per_pixel[..., None] * offsets_px)
    inside = np.all((pixels >= 1) & (pixels <= [camera.width - 2, camera.height - 2]), axis=3)
    return Profiles(azimuth, offsets_px, pixels, inside, per_pixel)


def sample(image: NDArray[np.float32] | NDArray[np.uint8], pixels: Array) -> NDArray[np.float32]:
    """Return bilinear values (K, J[, C]) at exact pixels (K, J, 2); cv2.remap would round them to 1/32 px."""
    h, w = image.shape[:2]
    x = np.clip(pixels[..., 0], 0, w - 1.001)
    y = np.clip(pixels[..., 1], 0, h - 1.001)
    x0, y0 = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    if image.ndim == 3:
        fx, fy = fx[..., None], fy[..., None]
    top = image[y0, x0] * (1 - fx) + image[y0, x0 + 1] * fx
    bottom = image[y0 + 1, x0] * (1 - fx) + image[y0 + 1, x0 + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy, dtype=np.float32)


def sample_sharp(image: Pixels, pixels: Array) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Return the values (..., J, 3) at pixels (..., J, 2) by Lanczos interpolation, which does not blur.

    Bilinear interpolation averages coded values, which blurs after the transfer curve and moves high-contrast edges
    by a tenth of a pixel. Positions are rounded to 1/32 px, without bias. Values of 16 bits are given in units of
    those of 8 bits, not rounded.
    """
    values = _remapped(image, pixels, cv2.INTER_LANCZOS4)
    if values.dtype == np.uint8:
        return values.astype(np.uint8, copy=False)
    return (values / np.float32(FINER)).astype(np.float32)


def sample_averaged(image: Pixels, pixels: Array, count: int) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Return the means (..., J, 3) of every `count` neighbouring values along profiles (..., J * count, 2)."""
    values = _remapped(image, pixels, cv2.INTER_LINEAR)
    means = values.reshape(*values.shape[:-2], -1, count, 3).mean(axis=-2, dtype=np.float32)
    if values.dtype != np.uint8:
        return (means / np.float32(FINER)).astype(np.float32)
    return np.rint(means).astype(np.uint8)


def _remapped(image: Pixels, pixels: Array, how: int) -> Pixels:
    at = pixels.reshape(-1, *pixels.shape[-2:]).astype(np.float32)
    values = cv2.remap(image, at[..., 0], at[..., 1], how, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(*pixels.shape[:-1], 3)  # pyright: ignore[reportReturnType] - cv2 keeps the image's type


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """Edge points across an outline: azimuth index `slot` (N,), `offset_px` (N,) and `strength` (N,) 0..1."""

    slot: NDArray[np.int64]
    offset_px: Array
    strength: Array


def envelope_edges(values: NDArray[np.float32], where: Profiles, peaks_per_ray: int = 3) -> EdgePoints:
    """Return the strongest edges of each profile: maxima of any channel's derivative along it.

    `values` (K, J, C) are of an 8-bit image. Strength is relative to the strongest edge of the profile, so a faint
    outline counts fully unless something stronger is beside it.
    """
    step = where.offsets_px[1] - where.offsets_px[0]
    smooth = cv2.GaussianBlur(values, (5, 1), 0.9 / max(step, 0.3), borderType=cv2.BORDER_REPLICATE)
    smooth = smooth.reshape(values.shape)
    change = np.abs(smooth[:, 2:] - smooth[:, :-2]).max(axis=2) / (2 * step)  # grey levels per pixel
    change[~(where.inside[:, 2:] & where.inside[:, :-2])] = 0
    middle = change[:, 1:-1]
    peak = (middle >= change[:, :-2]) & (middle > change[:, 2:]) & (middle > 2.0)
    height = np.where(peak, middle, 0)
    order = np.argsort(-height, axis=1)[:, :peaks_per_ray]
    rows = np.repeat(np.arange(len(height)), peaks_per_ray)
    columns = order.reshape(-1)
    top = height[rows, columns]
    ok = top > 0
    rows, columns, top = rows[ok], columns[ok], top[ok]
    a, b, c = change[rows, columns], change[rows, columns + 1], change[rows, columns + 2]
    bend = a - 2 * b + c
    shift = np.where(bend < 0, 0.5 * (a - c) / np.where(bend < 0, bend, 1), 0)
    offset = where.offsets_px[columns + 2] + np.clip(shift, -0.5, 0.5) * step
    strongest = height.max(axis=1)
    # From 12 grey levels per pixel an edge is certain; below, its strength is reduced.
    belief = np.minimum(1.0, 0.4 + top / 20.0)
    return EdgePoints(rows.astype(np.int64), offset, top / strongest[rows] * belief)


_LEAST_RADIUS = 11  # pixels at the scale of a search: small enough to be fast, large enough to be distinct
_OCTAVE = 2.0


@dataclass(frozen=True, slots=True)
class CircleCandidate:
    """A circle in pixels of the reduced image, which serves as bounding box and as initial outline."""

    x: float
    y: float
    radius: float
    vote: float  # share of the circumference that votes for it


def colour_gradient(image: NDArray[np.uint8]) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Return Sobel derivatives (H, W) in x and y of each pixel's channel with the largest change; `image` is BGR."""
    smooth = cv2.GaussianBlur(image, (5, 5), 1.1)
    dx = cv2.Sobel(smooth, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(smooth, cv2.CV_16S, 0, 1)
    best = np.abs(dx[..., 0]) + np.abs(dy[..., 0])
    gx, gy = dx[..., 0].copy(), dy[..., 0].copy()
    for channel in (1, 2):
        size = np.abs(dx[..., channel]) + np.abs(dy[..., channel])
        more = size > best
        np.copyto(best, size, where=more)
        np.copyto(gx, dx[..., channel], where=more)
        np.copyto(gy, dy[..., channel], where=more)
    return gx.astype(np.int16), gy.astype(np.int16)


def edges(gx: NDArray[np.int16], gy: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Find thin edge pixels (H, W), with thresholds from the image's median gradient, not from its maximum."""
    size = np.abs(gx[::3, ::3].astype(np.int32)) + np.abs(gy[::3, ::3])
    low = float(np.clip(2.5 * np.median(size), 24, 80))
    return np.asarray(cv2.Canny(gx, gy, low, 2.2 * low) > 0)


def find_candidates(
    image: NDArray[np.uint8], least_radius: float, greatest_radius: float, min_vote: float, limit: int
) -> list[CircleCandidate]:
    """Find circles with radii in a range (pixels of this image), the most votes first, one per place and size.

    Each octave of radii is searched in a copy where its smallest radius is about eleven pixels.
    """
    found: list[CircleCandidate] = []
    radius = least_radius
    while radius < greatest_radius:
        scale = min(1.0, _LEAST_RADIUS / radius)
        top = min(radius * _OCTAVE, greatest_radius)
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        level = image if scale == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        found += _search(np.asarray(level, dtype=np.uint8), radius * scale, top * scale, min_vote, 1 / scale)
        radius = top
    found.sort(key=lambda c: -c.vote)
    kept: list[CircleCandidate] = []
    for c in found:
        if all(_apart(c, k) for k in kept):
            kept.append(c)
            if len(kept) == limit:
                break
    return kept


def _apart(a: CircleCandidate, b: CircleCandidate) -> bool:
    near = 0.35 * min(a.radius, b.radius)
    return abs(a.x - b.x) > near or abs(a.y - b.y) > near or not 0.72 < a.radius / b.radius < 1.39


@dataclass(frozen=True, slots=True)
class _EdgePixels:
    """Edge pixels and their unit gradients; `margin` pixels are added around the image for centres outside it."""

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    dx: NDArray[np.floating]
    dy: NDArray[np.floating]
    margin: int
    shape: tuple[int, int]  # with the margins

    def votes(self, radius: np.int64) -> NDArray[np.float32]:
        """Return for each pixel the share of a circle of this radius around it that votes for it."""
        rows, columns = self.shape
        flat = np.concatenate(
            [
                np.rint(self.y + sign * radius * self.dy + self.margin).astype(np.int32) * columns
                + np.rint(self.x + sign * radius * self.dx + self.margin).astype(np.int32)
                for sign in (1, -1)
            ]
        )
        plane = np.bincount(flat, minlength=rows * columns).reshape(rows, columns).astype(np.float32)
        plane *= np.float32(1 / (2 * np.pi * float(radius)))
        return np.asarray(cv2.boxFilter(plane, -1, (5, 5), normalize=False), dtype=np.float32)


def _best_radii(pixels: _EdgePixels, radii: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the most votes for any radius at each pixel, and that radius's index.

    A circle's votes spread over neighbouring radii, so each radius has the sum of its own and those beside it.
    """
    best = np.zeros(pixels.shape, dtype=np.float32)
    best_index = np.zeros(pixels.shape, dtype=np.uint8)
    planes: list[NDArray[np.float32]] = []
    for i, radius in enumerate(radii):
        planes = [*planes[-2:], pixels.votes(radius)]
        if i > 0:
            _keep_best(best, best_index, i - 1, planes)
    _keep_best(best, best_index, len(radii) - 1, planes[-2:])
    return best, best_index


def _keep_best(
    best: NDArray[np.float32], best_index: NDArray[np.uint8], index: int, planes: list[NDArray[np.float32]]
) -> None:
    """Raise `best` to the sum of the planes where that is larger, and store the radius index there."""
    total = planes[0]
    for plane in planes[1:]:
        total = cv2.add(total, plane)
    more = total > best
    np.copyto(best, total, where=more)
    best_index[more] = index


def _search(
    image: NDArray[np.uint8], least: float, greatest: float, min_vote: float, to_input: float
) -> list[CircleCandidate]:
    gx, gy = colour_gradient(image)
    ys, xs = np.nonzero(edges(gx, gy))
    if len(xs) == 0:
        return []
    dx, dy = gx[ys, xs].astype(np.float32), gy[ys, xs].astype(np.float32)
    norm = np.hypot(dx, dy)
    radii = np.arange(max(3, int(least) - 1), int(np.ceil(greatest)) + 2)
    margin = int(radii[-1])  # a centre may lie outside the image
    shape = image.shape[0] + 2 * margin, image.shape[1] + 2 * margin
    best, best_index = _best_radii(_EdgePixels(xs, ys, dx / norm, dy / norm, margin, shape), radii)
    peak = (best >= cv2.dilate(best, np.ones((7, 7), np.uint8))) & (best > min_vote)
    py, px = np.nonzero(peak)
    strongest = np.argsort(-best[py, px])[:150]
    return [
        CircleCandidate(
            (float(px[k]) - margin + 0.5) * to_input - 0.5,
            (float(py[k]) - margin + 0.5) * to_input - 0.5,
            float(radii[best_index[py[k], px[k]]]) * to_input,
            float(best[py[k], px[k]]),
        )
        for k in strongest
    ]


# A disc crossed by wires, stains or highlights, or on a background of its colour, counts if it has the spheres'
# colour.
_DOUBTFUL_INTERIOR, _DOUBTFUL_LEAK = 0.3, 0.36
_DOUBTFUL_COVERAGE = 0.58
_DARK = 0.3  # L* over that of the disc's middle; darker pixels are not counted as the same colour
_OUTWARD = (1.07, 1.65)  # of the radius: where a larger outline around a disc is searched for
_LEAST_AROUND = 0.7  # share of it that must be visible
_LEAST_RINGED_PX = 30.0  # radius of the disc; around smaller ones, edges of any texture agree by chance
_TRIALS = 200  # of RANSAC on a coarse outline
LEAST_UNAIDED = 0.5  # coverage below which an outline can be recognised only with a prediction
_LEAST_RING = 0.55  # share of the ring between two outlines that must have the inner disc's colour
CLEAN_INTERIOR = 0.03
CLEAR = 0.6  # score from which discs are certainly spheres


@dataclass(frozen=True, slots=True)
class RoughSphere:
    """An outline found in the reduced image."""

    cone: Cone
    coverage: float  # share of the outline with edges, weighted by their strength
    interior_edges: float  # edge pixels inside over area
    mask_loss: float  # false positives and negatives of the ellipse against the mask, over the ellipse's area
    colour_bgr: tuple[float, float, float]
    plain: bool  # passes every test by itself

    @property
    def score(self) -> float:
        """0..1: a whole, clean disc has about 0.9."""
        clean = max(0.0, 1.0 - 6.0 * self.interior_edges) if self.plain else 0.3
        return float(self.coverage * clean * (1.0 - 0.5 * min(1.0, self.mask_loss)))


def examine(
    coarse: NDArray[np.uint8],
    edge_map: NDArray[np.bool_],
    camera: CameraModel,
    candidate: CircleCandidate,
    options: DetectionOptions,
    rng: np.random.Generator,
) -> RoughSphere | None:
    """Return the disc at a candidate, if its outline is visible and it can be a sphere."""
    axis = np.append(camera.normalise(np.array([[candidate.x, candidate.y]]))[0], 1.0)
    length = float(np.linalg.norm(axis))
    cone = Cone(axis / length, float(np.arctan(candidate.radius / camera.fx / length)))
    coverage = 0.0
    votes = np.zeros(96)
    for envelope in (0.3, 0.14):
        reach = max(4.0, envelope * candidate.radius)
        fit = _fitted(coarse, camera, cone, (-reach, reach), candidate.radius, rng)
        if fit is None:
            return None
        cone, votes = fit
        coverage = float(votes.mean())
        if coverage < 0.8 * options.min_coverage * 0.8:
            return None
    return _judge(coarse, edge_map, camera, cone, votes, options)


def _fitted(
    coarse: NDArray[np.uint8],
    camera: CameraModel,
    near: Cone,
    reach_px: tuple[float, float],
    radius_px: float,
    rng: np.random.Generator,
) -> tuple[Cone, Array] | None:
    """Return the cone on which most edges within reach of `near` agree, and the agreement at each of 96 azimuths."""
    step = max(0.5, (reach_px[1] - reach_px[0]) / 48)
    where = profiles(near, camera, 96, np.arange(reach_px[0], reach_px[1] + 0.1, step))
    points = envelope_edges(sample(coarse, where.pixels), where)
    if len(points.slot) < 16:
        return None
    per_pixel = where.per_pixel_rad[points.slot]
    rays = near.rays(where.azimuth_rad[points.slot], near.half_angle_rad + points.offset_px * per_pixel)
    bounds = (0.6 * near.half_angle_rad, 1.5 * near.half_angle_rad)
    tolerance = max(0.9, 0.02 * radius_px) * float(np.median(per_pixel))
    fit = ransac_cone(rays, points.strength, points.slot, bounds, tolerance, rng, _TRIALS)
    if fit is None:
        return None
    votes = np.zeros(96)
    np.maximum.at(votes, points.slot[fit[1]], points.strength[fit[1]])
    return fit[0], votes


def outermost(
    coarse: NDArray[np.uint8],
    edge_map: NDArray[np.bool_],
    camera: CameraModel,
    rough: RoughSphere,
    options: DetectionOptions,
    rng: np.random.Generator,
) -> RoughSphere:
    """Return the disc, or a larger one of its colour whose outline surrounds it.

    A glossy ball reflects the horizon as a ring on itself, which is often sharper than its limb.
    """
    inner, radius_px = rough.cone, rough.cone.half_angle_rad * camera.fx
    if rough.score < CLEAR or radius_px < _LEAST_RINGED_PX:
        return rough
    low, high = _OUTWARD
    middle = 0.5 * (low + high)
    cone = Cone(inner.axis, middle * inner.half_angle_rad)
    reach = (high - middle) * radius_px
    votes = np.zeros(96)
    for envelope in (reach, 0.14 * radius_px):
        fit = _fitted(coarse, camera, cone, (-envelope, envelope), radius_px, rng)
        if fit is None or float((fit[1] > 0).mean()) < _LEAST_AROUND:
            return rough
        cone, votes = fit
    around = apart_rad(inner, cone) + inner.half_angle_rad < cone.half_angle_rad
    if not around or cone.half_angle_rad < low * inner.half_angle_rad:
        return rough
    colour = given_colour(rough.colour_bgr, options.colour_tolerance, srgb=options.srgb)
    part = inner.half_angle_rad / cone.half_angle_rad
    if share(coarse, camera, cone, colour, (part, 0.95)) < _LEAST_RING:
        return rough
    outer = _judge(coarse, edge_map, camera, cone, votes, options)
    return outer if outer is not None and outer.plain else rough


def _judge(
    coarse: NDArray[np.uint8],
    edge_map: NDArray[np.bool_],
    camera: CameraModel,
    cone: Cone,
    votes: Array,
    options: DetectionOptions,
) -> RoughSphere | None:
    """Return the disc of an outline with these votes, if it can be a sphere; otherwise None."""
    coverage = float(votes.mean())
    if cone.axis[2] < 0.3:
        return None
    interior, loss, leak, colour = _interior(coarse, edge_map, cone, camera, votes < 0.3)
    bad = loss > 0.6 or coverage < 0.8 * options.min_coverage
    if bad or leak > _DOUBTFUL_LEAK or interior > _DOUBTFUL_INTERIOR:
        return None
    plain = leak <= options.max_leak and interior <= options.max_interior_edges
    rough = RoughSphere(cone, coverage, interior, loss, colour, plain)
    if plain and rough.score < options.min_score:
        rough = replace(rough, plain=False)
    least = LEAST_UNAIDED if interior < CLEAN_INTERIOR else _DOUBTFUL_COVERAGE
    return rough if rough.plain or coverage > least else None


def _interior(
    coarse: NDArray[np.uint8],
    edge_map: NDArray[np.bool_],
    cone: Cone,
    camera: CameraModel,
    edgeless: NDArray[np.bool_],
) -> tuple[float, float, float, tuple[float, float, float]]:
    """Return the edge density inside, loss of the ellipse against the colour mask, leak, and median colour.

    The mask holds the pixels with the chromaticity of the disc's middle; the loss is the paper's FP + FN over the
    area. The leak is the share of the outline without an edge (`edgeless`, one for each of K azimuths) across which
    the mask continues: the circle is then only part of a differently shaped object.
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
    # Shading changes lightness within a sphere much more than its colour.
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
        # Where sphere and background are both in shadow, the boundary is invisible.
        leaks[here] &= mask[y[here], x[here]] & (lab[y[here], x[here], 0] > _DARK * middle[0])
    return interior, loss, float(leaks.mean()), (float(colour[0]), float(colour[1]), float(colour[2]))


def share(
    coarse: NDArray[np.uint8],
    camera: CameraModel,
    cone: Cone,
    model: ColourModel,
    reach: tuple[float, float] = (0.0, 0.92),
) -> float:
    """Return the share of a disc, or of the ring between two fractions of its radius, with the spheres' colour."""
    low, high = reach
    rings = np.sqrt(low**2 + (high**2 - low**2) * (np.arange(8) + 0.5) / 8)
    azimuth = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    at = camera.project(cone.rays(azimuth[:, None], rings * cone.half_angle_rad).reshape(-1, 3))
    x, y = np.rint(at).astype(int).T
    here = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    if not here.any():
        return 0.0
    return float(np.mean(model.distance(coarse[y[here], x[here]].astype(np.float64)) < 1.0))


def apart_rad(a: Cone, b: Cone) -> float:
    """Return the angle between the axes of two cones, radians."""
    return float(np.arccos(np.clip(a.axis @ b.axis, -1, 1)))
