"""Finds spheres of known radius in a scan, a CT mesh or a cloud, and says what is wrong where there are none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.compute.surfaces.sphere_candidates import candidates, rough_centres, vote_peaks
from service.compute.surfaces.sphere_fit import (
    CHUNK,
    CentreUncertainty,
    IntArray,
    SphereFit,
    SphereSamples,
    Surfels,
    centre_uncertainties,
    fit_sphere,
    sample_weights,
    surfels,
)
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array
from service.core.units import MISTAKEN_LENGTHS, deg, mm

_SURFEL = 0.2  # surface cell over which normals are averaged, in radii
_HOOD = 1.3  # radius around a centre that contains its sphere's surface, in radii
_MOST_SAMPLES = 5000  # per sphere; further neighbours share their noise
_NEAR_MISSES = 6
_MIXED = 0.2  # |orientation| below which the normals are inconclusive
_MAX_RADIUS_SIGMA = 0.15  # in radii; a less certain radius does not prove a sphere
_FEWEST_PATCHES = 5  # cells of surface: enough for centre and radius, plus one for redundancy
_ROUGHER = 2.0  # times the rms of the best covered spheres; noise within one mesh varies less
_SEED_REACH = 1.6  # radii between a seed (a rough centre or a point on the surface) and the centre


@dataclass(frozen=True, slots=True)
class MeshSphere:
    """A sphere of known radius, located in a mesh.

    Attributes:
        centre_m: (3,) centre in the mesh's frame.
        covariance: (3, 3) covariance of the centre, m²; allows for errors that neighbouring vertices share.
        rms_m: weighted root mean square distance of the inliers from the surface.
        radius_residual_m: radius of a free sphere fit to the same vertices, minus the known radius.
        radius_sigma_m: standard deviation of `radius_residual_m`.
        coverage: solid angle of the inlier surface, as a fraction of the whole sphere.
        n: number of inlier vertices (for a dense mesh, of those sampled).
    """

    centre_m: Array
    covariance: Array
    rms_m: float
    radius_residual_m: float
    radius_sigma_m: float
    coverage: float
    n: int


@dataclass(frozen=True, slots=True)
class SphereLimits:
    """Acceptance limits for a sphere; lengths as fractions of the radius.

    A cap of half angle a covers (1 - cos a) / 2 of its sphere: 0.067 at 30°, 0.15 at 45°, 0.25 at 60°. The radius may
    also differ from the known one by three of its sigmas, up to `most_radius_residual`, because a small cap
    determines it poorly; a larger difference indicates a fillet or an edge.
    """

    min_coverage: float = 0.05
    min_cap_deg: float = (
        50.0  # opening of the visible cap in its narrow direction; a 60° cap with a ragged rim has this
    )
    min_vertices: int = 20
    max_rms: float = 0.025
    max_radius_residual: float = 0.04
    most_radius_residual: float = 0.10
    max_flank: float = 0.3
    max_form: float = 0.01


@dataclass(frozen=True, slots=True)
class _Candidate:
    fit: SphereFit
    reasons: tuple[str, ...]  # why it is refused; empty if accepted


def locate_spheres(
    vertices_m: Array,
    faces: NDArray[np.integer],
    radius_m: float,
    expected: int | None = None,
    limits: SphereLimits | None = None,
    *,
    normals: Array | None = None,
    seeds_m: Array | None = None,
) -> tuple[MeshSphere, ...]:
    """Locate every sphere of radius `radius_m` in a mesh or point cloud, best covered first.

    Cells of surface vote for a centre one radius away, and each peak of votes is refined by a robust known-radius
    fit. It is accepted by its coverage, its residuals (also relative to the other spheres'), the radius of a free
    fit, and by the surface ending with the sphere instead of continuing smoothly as on a cylinder or an ellipsoid.
    Caps of 30° half angle suffice if the noise is low. The winding may be inverted, as a whole or for single spheres;
    dents are recognised by the majority's winding, and not at all in a cloud without normals.

    Args:
        vertices_m: (V, 3); vertices may be repeated, as in STL.
        faces: (F, 3) vertex indices; (0, 3) for a point cloud, whose points are then measured.
        radius_m: the spheres' radius.
        expected: the required number of spheres; None accepts any number from one on.
        limits: acceptance limits; None: the defaults.
        normals: (V, 3) unit normals of a point cloud's points, if known.
        seeds_m: (K, 3) points at or near each sphere (a rough centre or a point picked on it): only these are
            searched, and the result is in their order.

    Raises:
        DataError: not a mesh, indices out of range, or vertices that are not finite.
        ComputeError: no sphere, not the expected number, or a seed without a sphere; the message lists the spheres
            found and the near misses with reasons.
    """
    bounds = limits or SphereLimits()
    vertices, triangles = _require_mesh(vertices_m, faces, normals)
    patches = surfels(vertices, triangles, normals, _SURFEL * radius_m)
    if len(patches.area) == 0:
        raise ComputeError("found 0 spheres: the mesh has no surface", remedy="Check the mesh's unit")
    tree = cKDTree(patches.position)
    if seeds_m is not None:
        return _at_seeds(np.atleast_2d(seeds_m), vertices, triangles, patches, tree, radius_m, bounds)
    starts = candidates(patches, tree, radius_m, bounds.min_coverage)
    fits = _fits(starts, vertices, triangles, patches, tree, radius_m)
    found, refused, uncertainties = _judge(fits, radius_m, bounds, expected)
    if not found or (expected is not None and len(found) != expected):
        raise _wrong_count(found, refused, radius_m, expected)
    spheres = [_sphere(fit, worth) for fit, worth in zip(found, uncertainties, strict=True)]
    return tuple(sorted(spheres, key=lambda s: -s.coverage))


def _require_mesh(vertices_m: Array, faces: NDArray[np.integer], normals: Array | None) -> tuple[Array, IntArray]:
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    triangles = cast(
        "IntArray", np.asarray(faces)
    )  # without a copy of other integer types: 20 million faces have half a gigabyte
    if triangles.size == 0:
        triangles = np.empty((0, 3), dtype=np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise DataError(
            f"vertices {vertices.shape} and faces {triangles.shape} are not a triangle mesh",
            remedy="Export triangles, with vertices (V, 3) and faces (F, 3)",
        )
    if len(vertices) < 3:
        raise DataError("the mesh has no surface", remedy="Export it again")
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise DataError("the mesh's faces refer to vertices that it does not have", remedy="Export it again")
    if not np.isfinite(vertices).all():
        raise DataError("the mesh has vertices that are not finite", remedy="Export it again")
    if normals is not None and np.shape(normals) != vertices.shape:
        raise DataError(f"normals {np.shape(normals)} for vertices {vertices.shape}", remedy="Export it again")
    return vertices, triangles


# --- samples --------------------------------------------------------------------------------------------


def _fits(
    starts: Array, vertices: Array, faces: IntArray, patches: Surfels, tree: cKDTree, radius: float
) -> list[SphereFit]:
    """Return the final fit from each coarse centre (K, 3), without those that fail."""
    if len(starts) == 0:
        return []
    points, weight = _surroundings(starts, vertices, faces, radius)
    order = np.argsort(points[:, 0], kind="stable")
    points, weight = points[order], weight[order]
    rng = np.random.default_rng(0)
    fits: list[SphereFit] = []
    for start in starts:
        a, b = np.searchsorted(points[:, 0], [start[0] - _HOOD * radius, start[0] + _HOOD * radius])
        near = np.flatnonzero(np.sum((points[a:b] - start) ** 2, axis=1) < (_HOOD * radius) ** 2) + a
        if len(near) > _MOST_SAMPLES:
            near = np.sort(rng.choice(near, _MOST_SAMPLES, replace=False))
        if len(near) == 0:
            continue
        own = weight[near] if len(faces) else sample_weights(points[near], 0.15 * radius)
        own = np.minimum(own, 2 * float(np.median(own)))  # a post's long facets have vertices near the sphere
        nearest = tree.query(points[near])[1]
        samples = SphereSamples(points[near], patches.normal[nearest], patches.outward[nearest], own)
        fit = fit_sphere(samples, start, radius, 0.1 * radius)
        if fit is not None:
            fits.append(fit)
    return fits


def _surroundings(starts: Array, vertices: Array, faces: IntArray, radius: float) -> tuple[Array, Array]:
    """Return the vertices (N, 3) near any of the centres, and the area each represents; one pass for all centres."""
    low, high = starts.min(axis=0) - 2 * radius, starts.max(axis=0) + 2 * radius
    cell = max(0.5 * radius, float(np.max(high - low)) / 300)
    size = np.ceil((high - low) / cell).astype(np.int64) + 1
    reach = _HOOD * radius + cell
    marked = np.zeros(tuple(size), dtype=np.bool_)
    for start in starts:
        a = np.maximum(np.floor((start - reach - low) / cell).astype(int), 0)
        b = np.floor((start + reach - low) / cell).astype(int) + 1
        marked[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = True
    near = np.zeros(len(vertices), dtype=np.bool_)
    for begin in range(0, len(vertices), CHUNK):
        part = vertices[begin : begin + CHUNK]
        inside = np.flatnonzero(np.all((part > low) & (part < high), axis=1))
        i, j, k = ((part[inside] - low) / cell).astype(np.int64).T
        near[begin + inside] = marked[i, j, k]
    if len(faces) == 0:
        points = vertices[near]
        return points, np.ones(len(points))
    area = np.zeros(len(vertices))
    for begin in range(0, len(faces), CHUNK):
        part = faces[begin : begin + CHUNK]
        part = part[near[part[:, 0]]]
        a, b, c = (vertices[part[:, k]] for k in range(3))
        third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
        for k in range(3):
            np.add.at(area, part[:, k], third)
    near &= area > 0
    return vertices[near], area[near]


# --- judgement ------------------------------------------------------------------------------------------


def _shape_reasons(fit: SphereFit, radius: float, limits: SphereLimits) -> list[str]:
    reasons: list[str] = []
    if fit.coverage < limits.min_coverage:
        reasons.append(f"covers {fit.coverage:.3f} of the sphere, {limits.min_coverage:g} is needed")
    if fit.n < limits.min_vertices or len(fit.patches.unit) < _FEWEST_PATCHES:
        reasons.append(f"only {fit.n} vertices lie on it, {limits.min_vertices} in several places are needed")
    elif (cap_deg := _cap_deg(fit)) < limits.min_cap_deg:
        reasons.append(f"its cap is {cap_deg:.0f}° wide, {limits.min_cap_deg:.0f}° are needed")
    if fit.rms > limits.max_rms * radius:
        reasons.append(f"rms {mm(fit.rms):.2f} mm, at most {mm(limits.max_rms * radius):.2f}")
    if fit.flank > limits.max_flank:
        reasons.append("the surface continues smoothly beyond it: not a sphere of this radius")
    if fit.form > limits.max_form * radius:
        reasons.append(f"deviates from a sphere's shape by {mm(fit.form):.2f} mm")
    return reasons


def _cap_deg(fit: SphereFit) -> float:
    """Return the opening in degrees of a cap with the same scatter as the inlier surface in its narrow direction."""
    unit, weight = fit.patches.unit, fit.patches.weight / fit.patches.weight.sum()
    middle = weight @ unit
    off = unit - middle
    # In the plane perpendicular to the middle direction, half the sine of the half angle is an even cap's deviation.
    plane = np.linalg.svd(middle[None])[2][1:]
    across = float(np.sqrt(max(float(np.linalg.eigvalsh(plane @ (off.T @ (off * weight[:, None])) @ plane.T)[0]), 0)))
    return 2 * deg(np.arcsin(min(1.0, 2 * across)))


def _radius_reasons(fit: SphereFit, sigma: float, radius: float, limits: SphereLimits) -> list[str]:
    if not np.isfinite(fit.radius_residual) or sigma > _MAX_RADIUS_SIGMA * radius:
        return ["the cap is too small for its noise to determine the radius"]
    most = max(limits.max_radius_residual, limits.most_radius_residual)
    if abs(fit.radius_residual) > max(limits.max_radius_residual * radius, min(3 * sigma, most * radius)):
        return [f"radius {mm(fit.radius_residual):+.2f} ± {mm(sigma):.2f} mm off"]
    return []


def _judge(
    fits: list[SphereFit], radius: float, limits: SphereLimits, expected: int | None
) -> tuple[list[SphereFit], list[_Candidate], tuple[CentreUncertainty, ...]]:
    """Return the accepted fits with their uncertainties, and the near misses, best covered first."""
    ranked = sorted(fits, key=lambda f: -f.coverage)
    refused: list[_Candidate] = []
    good: list[SphereFit] = []
    for fit in ranked:
        reasons = _shape_reasons(fit, radius, limits)
        if reasons:
            refused.append(_Candidate(fit, tuple(reasons)))
        elif all(_apart(fit, other, radius) for other in good):
            good.append(fit)
    if len(good) >= 4:
        usual = _ROUGHER * float(np.median([f.rms for f in good[: (len(good) + 1) // 2]])) + 3e-3 * radius
        refused += [
            _Candidate(f, (f"rms {mm(f.rms):.2f} mm, much rougher than the best covered spheres",))
            for f in good
            if f.rms > usual
        ]
        good = [f for f in good if f.rms <= usual]
    worth = _uncertainties(good, radius)
    sound: list[SphereFit] = []
    for fit, uncertainty in zip(good, worth, strict=True):
        reasons = _radius_reasons(fit, uncertainty.radius_sigma, radius, limits)
        if reasons:
            refused.append(_Candidate(fit, tuple(reasons)))
        else:
            sound.append(fit)
    accepted = _oriented(sound, expected)
    refused += [
        _Candidate(fit, ("concave: its normals point opposite to the other spheres'",))
        for fit in sound
        if all(fit is not other for other in accepted)
    ]
    misses: list[_Candidate] = []
    for candidate in sorted(refused, key=lambda c: (len(c.reasons), -c.fit.coverage)):
        others = (*accepted, *(m.fit for m in misses))
        if all(_apart(candidate.fit, other, radius) for other in others):
            misses.append(candidate)
    return accepted, misses, _uncertainties(accepted, radius)


def _apart(a: SphereFit, b: SphereFit, radius: float) -> bool:
    # Two solid spheres are two radii apart; several candidates may have converged to the same one.
    return float(np.linalg.norm(a.centre - b.centre)) > radius


def _oriented(fits: list[SphereFit], expected: int | None) -> list[SphereFit]:
    """Select spheres without dents: those with the majority's winding, unless only fits of either winding give the
    expected number."""
    outward = [f for f in fits if f.orientation > -_MIXED]
    inward = [f for f in fits if f.orientation < _MIXED]
    for choice in (outward, inward, fits):
        if len(choice) == expected:
            return choice
    return outward if len(outward) >= len(inward) else inward


def _uncertainties(fits: Sequence[SphereFit], radius: float) -> tuple[CentreUncertainty, ...]:
    if not fits:
        return ()
    return centre_uncertainties([f.patches for f in fits], [f.radius_residual for f in fits], radius)


def _sphere(fit: SphereFit, worth: CentreUncertainty) -> MeshSphere:
    return MeshSphere(
        fit.centre, worth.covariance, fit.rms, fit.radius_residual, worth.radius_sigma, fit.coverage, fit.n
    )


def _describe(fit: SphereFit) -> str:
    x, y, z = mm(fit.centre)
    return f"({x:.1f}, {y:.1f}, {z:.1f}) mm coverage {fit.coverage:.2f} rms {mm(fit.rms):.2f} mm"


def _wrong_count(
    found: Sequence[SphereFit], refused: Sequence[_Candidate], radius: float, expected: int | None
) -> ComputeError:
    wanted = "any" if expected is None else str(expected)
    listing = "; ".join(_describe(f) for f in found) or "none"
    almost = "; ".join(f"{_describe(c.fit)} ({', '.join(c.reasons)})" for c in refused[:_NEAR_MISSES])
    return ComputeError(
        f"found {len(found)} spheres of radius {mm(radius):.2f} mm in the mesh, expected {wanted}: {listing}"
        + (f". Refused candidates: {almost}" if almost else ""),
        remedy="Check the mesh's unit and the radius, and that every sphere was scanned over a cap of 60° at least; "
        "scan again what was refused, or give seeds",
    )


# --- seeds ----------------------------------------------------------------------------------------------


def _at_seeds(
    seeds: Array,
    vertices: Array,
    faces: IntArray,
    patches: Surfels,
    tree: cKDTree,
    radius: float,
    limits: SphereLimits,
) -> tuple[MeshSphere, ...]:
    """Return the sphere at each seed, in the seeds' order."""
    if seeds.ndim != 2 or seeds.shape[1] != 3 or not np.isfinite(seeds).all():
        raise DataError(f"seeds {seeds.shape} are not points (K, 3)", remedy="Give x, y, z of a point at each sphere")
    peaks = vote_peaks(patches, radius)
    chosen: list[SphereFit] = []
    for number, seed in enumerate(seeds):
        distance = np.linalg.norm(peaks - seed, axis=1)
        close = peaks[np.argsort(distance)][: int(np.sum(distance < _SEED_REACH * radius))]
        surfel = int(tree.query(seed)[1])
        beside = [seed + side * radius * patches.normal[surfel] for side in (1.0, -1.0)]
        starts = np.array([*close, seed, *beside])
        rough = rough_centres(patches, tree, starts, radius, limits.min_coverage)
        usable = np.array([centre for centre in rough if centre is not None]).reshape(-1, 3)
        fits = [
            f
            for f in _fits(usable, vertices, faces, patches, tree, radius)
            if np.linalg.norm(f.centre - seed) < _SEED_REACH * radius
        ]
        accepted, refused, _ = _judge(fits, radius, limits, None)
        if not accepted:
            why = f"; {_describe(refused[0].fit)}: {', '.join(refused[0].reasons)}" if refused else ""
            x, y, z = mm(seed)
            raise ComputeError(
                f"no sphere of radius {mm(radius):.2f} mm at seed {number} ({x:.1f}, {y:.1f}, {z:.1f}) mm{why}",
                remedy="Give a point on the sphere or near its centre, in the mesh's frame",
            )
        best = min(accepted, key=lambda f: abs(float(np.linalg.norm(f.centre - seed)) - 0.5 * radius))
        for other, fit in enumerate(chosen):
            if not _apart(best, fit, radius):
                raise ComputeError(f"seeds {other} and {number} are at the same sphere", remedy="Give one for each")
        chosen.append(best)
    worth = _uncertainties(chosen, radius)
    return tuple(_sphere(fit, w) for fit, w in zip(chosen, worth, strict=True))


# A search finds radii within 4 %. Half and twice: radius and diameter were confused.
_TRIED = (0.95, 1.05, 0.9, 1.1, 0.85, 1.15, 0.8, 1.2, 0.75, 1.25, 0.7, 1.3, 0.5, 2.0)
_LEAST_COVERAGE = 0.15  # of a sphere; smaller caps of any radius occur everywhere


@dataclass(frozen=True, slots=True)
class MeasuredRadius:
    """The radius of the spheres in a mesh, and those spheres."""

    radius_m: float
    spheres: tuple[MeshSphere, ...]


def seen_radius(
    vertices_m: Array,
    faces: NDArray[np.integer],
    radius_m: float,
    limits: SphereLimits | None = None,
    *,
    normals: Array | None = None,
) -> MeasuredRadius | None:
    """Find the radius with the most spheres in the mesh: from 0.7 to 1.3 times `radius_m`, half or twice it.

    Takes as long as a dozen searches. Arguments as for `locate_spheres`; None if there are no such spheres.

    Raises:
        DataError: not a mesh, indices out of range, or vertices that are not finite.
    """
    best: tuple[MeshSphere, ...] = ()
    nearest = radius_m
    for factor in _TRIED:
        found = _located(vertices_m, faces, factor * radius_m, limits, normals)
        if _worth(found) > _worth(best):
            best, nearest = found, factor * radius_m
    if not best:
        return None
    for _ in range(2):  # the residual at a nearly correct radius is nearly the whole difference
        nearest = nearest + float(np.median([sphere.radius_residual_m for sphere in best]))
        again = _located(vertices_m, faces, nearest, limits, normals)
        best = again if len(again) >= len(best) else best
    return MeasuredRadius(nearest, best)


def _located(
    vertices_m: Array, faces: NDArray[np.integer], radius_m: float, limits: SphereLimits | None, normals: Array | None
) -> tuple[MeshSphere, ...]:
    try:
        found = locate_spheres(vertices_m, faces, radius_m, None, limits, normals=normals)
    except ComputeError:
        return ()
    return tuple(sphere for sphere in found if sphere.coverage > _LEAST_COVERAGE)


def _worth(spheres: tuple[MeshSphere, ...]) -> tuple[int, float]:
    return len(spheres), sum(sphere.coverage for sphere in spheres)


_SCENE_M = (0.1, 3.0)  # diagonal of a scene with its spheres
_LEAST_SPHERES = 3


@dataclass(frozen=True, slots=True)
class WrongUnit:
    """A mistaken unit that makes the spheres have their radius, with the coordinates multiplied by `factor`."""

    factor: float
    words: str
    spheres: int


def wrong_unit(vertices_m: Array, faces: NDArray[np.integer], radius_m: float) -> WrongUnit | None:
    """Find the mistaken unit with the most spheres of the known radius.

    Only those are tried that give the mesh the size of a scene, so that a mesh of that size takes no time.

    Args:
        vertices_m: (V, 3) vertices as they were read.
        faces: (F, 3) indices of vertices.
        radius_m: radius of the spheres.

    Returns:
        the mistake, or None if no other unit shows three spheres.
    """
    diagonal_m = float(np.linalg.norm(np.ptp(vertices_m, axis=0)))
    low, high = _SCENE_M
    if low <= diagonal_m <= high:
        return None
    best: WrongUnit | None = None
    for words, factor in MISTAKEN_LENGTHS.items():
        if not low <= factor * diagonal_m <= high:
            continue
        try:
            found = locate_spheres(factor * vertices_m, faces, radius_m, None)
        except ComputeError:
            continue
        count = sum(sphere.coverage > _LEAST_COVERAGE for sphere in found)
        if count >= _LEAST_SPHERES and (best is None or count > best.spheres):
            best = WrongUnit(factor, words, count)
    return best
