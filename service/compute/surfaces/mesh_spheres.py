"""Finds spheres of known radius in a scan or CT mesh without initial guesses, and measures their centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.core.errors import ComputeError, DataError
from service.core.geometry import Array

IntArray = NDArray[np.int64]

_SURFEL = 1 / 8  # surface cell over which normals are averaged, in radii
_VOTE = 1 / 6  # cell of the voting grid, in radii
_MIN_VOTE = 0.04  # votes a candidate needs, as a fraction of the whole sphere
_MAX_CANDIDATES = 200
_MIN_NORMAL_COSINE = 0.7  # between vertex normal and radius; below it a vertex is not the sphere's
_MIN_VERTICES = 12
_SIEVE_VERTICES = 1500  # enough to tell whether a candidate is a sphere


@dataclass(frozen=True, slots=True)
class MeshSphere:
    """A sphere of known radius, located in a mesh.

    Attributes:
        centre_m: (3,) in the mesh's frame.
        covariance: (3, 3) of the centre, m²; accounts for errors that neighbouring vertices share.
        rms_m: area-weighted root mean square distance of the inlying vertices from the surface.
        radius_residual_m: radius of a free sphere fit to the same vertices, minus the known radius.
        coverage: solid angle of the inlying surface, as a fraction of the whole sphere.
        n: number of inlying vertices.
    """

    centre_m: Array
    covariance: Array
    rms_m: float
    radius_residual_m: float
    coverage: float
    n: int


@dataclass(frozen=True, slots=True)
class SphereLimits:
    """What a sphere must satisfy to be accepted; lengths as fractions of the radius.

    A cap of 60° half angle covers 0.25 of its sphere, one of 45° covers 0.15.
    """

    min_coverage: float = 0.14
    max_rms: float = 0.025
    max_radius_residual: float = 0.05


@dataclass(frozen=True, slots=True)
class _Surface:
    """A mesh with the per-vertex quantities that the fits need."""

    vertices: Array  # (V, 3)
    faces: IntArray  # (F, 3)
    area_normals: Array  # (F, 3), length = face area, outward if the mesh is
    vertex_area_normals: Array  # (V, 3), sums over the adjacent faces
    vertex_area: Array  # (V,), a third of the adjacent faces
    faces_by_vertex: IntArray  # (F,) faces ordered by their first vertex
    first_face: IntArray  # (V + 1,) where a vertex's faces begin in that order
    tree: cKDTree


def locate_spheres(
    vertices_m: Array,
    faces: NDArray[np.integer],
    radius_m: float,
    expected: int | None = None,
    limits: SphereLimits | None = None,
) -> tuple[MeshSphere, ...]:
    """Locate every sphere of radius `radius_m` in the mesh, best covered first.

    Patches of surface vote for a centre one radius behind them; each peak of votes is fitted by a robust
    known-radius fit and accepted by its coverage, its residual and the radius of a free fit. A mesh whose faces
    are turned inside out is handled; dents of the same radius are not taken for spheres.

    Args:
        vertices_m: (V, 3).
        faces: (F, 3) vertex indices.
        radius_m: the spheres' radius.
        expected: how many there must be; None accepts any number from one on.
        limits: what an accepted sphere must satisfy.

    Raises:
        DataError: no faces, indices out of range or vertices that are not finite.
        ComputeError: no sphere, or another number than expected.
    """
    bounds = limits or SphereLimits()
    surface = _prepare(vertices_m, faces)
    found: list[MeshSphere] = []
    near: list[MeshSphere] = []
    # Outward faces by convention; an inside-out mesh shows its spheres only under the other sign.
    for sign in (1.0, -1.0):
        accepted, rejected = _locate(surface, radius_m, sign, bounds)
        if len(accepted) > len(found):
            found, near = accepted, rejected
        elif not found:
            near += rejected
        if found and (expected is None or len(found) >= expected):
            break
    if not found or (expected is not None and len(found) != expected):
        wanted = "any" if expected is None else str(expected)
        listing = "; ".join(_describe(s) for s in found) or "none"
        almost = "; ".join(_describe(s) for s in near[:6])
        raise ComputeError(
            f"found {len(found)} spheres of radius {radius_m * 1e3:.2f} mm in the mesh, expected {wanted}: {listing}"
            + (f". Refused candidates: {almost}" if almost else ""),
            remedy="check the mesh's unit and the radius, and that every sphere was scanned on at least a third",
        )
    return tuple(found)


def _describe(sphere: MeshSphere) -> str:
    x, y, z = sphere.centre_m * 1e3
    return (
        f"({x:.1f}, {y:.1f}, {z:.1f}) mm coverage {sphere.coverage:.2f} rms {sphere.rms_m * 1e3:.2f} mm "
        f"radius {sphere.radius_residual_m * 1e3:+.2f} mm"
    )


def _prepare(vertices_m: Array, faces: NDArray[np.integer]) -> _Surface:
    vertices = np.ascontiguousarray(vertices_m, dtype=np.float64)
    triangles = np.ascontiguousarray(faces, dtype=np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise DataError(
            f"vertices {vertices.shape} and faces {triangles.shape} are not a triangle mesh",
            remedy="export triangles, with vertices (V, 3) and faces (F, 3)",
        )
    if len(triangles) == 0:
        raise DataError("the mesh has no faces", remedy="export a surface mesh, not a point cloud")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise DataError("the mesh's faces refer to vertices that it does not have", remedy="export it again")
    if not np.isfinite(vertices).all():
        raise DataError("the mesh has vertices that are not finite", remedy="export it again")
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area_normals = np.cross(b - a, c - a) / 2
    area = np.linalg.norm(area_normals, axis=1)
    flat = triangles.ravel()
    count = len(vertices)
    vertex_area: Array = np.bincount(flat, np.repeat(area / 3, 3), count).astype(np.float64)
    vertex_normals: Array = np.stack(
        [np.bincount(flat, np.repeat(area_normals[:, k], 3), count).astype(np.float64) for k in range(3)], axis=1
    )
    # Unbalanced and uncompacted: builds three times faster, and scans are no adversaries.
    tree = cKDTree(vertices, balanced_tree=False, compact_nodes=False)
    order = np.argsort(triangles[:, 0], kind="stable")
    first = np.searchsorted(triangles[order, 0], np.arange(count + 1))
    return _Surface(vertices, triangles, area_normals, vertex_normals, vertex_area, order, first, tree)


def _locate(
    surface: _Surface, radius: float, sign: float, limits: SphereLimits
) -> tuple[list[MeshSphere], list[MeshSphere]]:
    """Accepted spheres and near misses for one orientation of the faces."""
    candidates = _vote(surface, radius, sign)
    if len(candidates) == 0:
        return [], []
    neighbourhoods = surface.tree.query_ball_point(candidates, 1.3 * radius)
    spheres: list[MeshSphere] = []
    for candidate, neighbours in zip(candidates, neighbourhoods, strict=True):
        hood = np.asarray(neighbours, dtype=np.int64)
        # A thinned fit sieves the candidates and starts the full one close by.
        thinned = hood[:: max(1, len(hood) // _SIEVE_VERTICES)]
        rough = _fit(surface, thinned, candidate, radius, sign=sign, band=0.25 * radius)
        if rough is None or any(np.linalg.norm(rough.centre - s.centre_m) < 1e-3 * radius for s in spheres):
            continue
        fit = _fit(surface, hood, rough.centre, radius, sign=sign, band=2 * rough.band)
        if fit is not None:
            spheres.append(_measure(surface, hood, fit, radius, sign))
    spheres.sort(key=lambda s: s.coverage, reverse=True)
    accepted: list[MeshSphere] = []
    rejected: list[MeshSphere] = []
    for sphere in spheres:
        good = (
            sphere.coverage >= limits.min_coverage
            and sphere.rms_m <= limits.max_rms * radius
            and abs(sphere.radius_residual_m) <= limits.max_radius_residual * radius
        )
        bucket = accepted if good else rejected
        # Two solid spheres are two radii apart; several candidates may have run into the same one.
        if all(np.linalg.norm(sphere.centre_m - s.centre_m) > radius for s in (*accepted, *bucket)):
            bucket.append(sphere)
    return accepted, [s for s in rejected if s.coverage > 0.5 * limits.min_coverage]


def _vote(surface: _Surface, radius: float, sign: float) -> Array:
    """Candidate centres (K, 3), strongest first."""
    corners = surface.vertices[surface.faces]
    centroid = corners.mean(axis=1)
    normal = surface.area_normals * sign
    area = np.linalg.norm(normal, axis=1)
    # Surfels: a cell of space and the main direction of the normal, so that the two sides of a sheet stay apart
    # and noise in single faces averages out whatever the density of the mesh.
    axis = np.abs(normal).argmax(axis=1)
    side = axis * 2 + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    key, _ = _cells(centroid, _SURFEL * radius)
    _, group = np.unique(key * 6 + side, return_inverse=True)
    n = int(group.max()) + 1
    weight = np.bincount(group, area, n)
    keep = weight > 0
    position = np.stack([np.bincount(group, centroid[:, k] * area, n) for k in range(3)], axis=1)[keep]
    direction = np.stack([np.bincount(group, normal[:, k], n) for k in range(3)], axis=1)[keep]
    weight = weight[keep]
    length = np.linalg.norm(direction, axis=1)
    steady = length > 0.5 * weight
    position, direction, weight = position[steady], direction[steady], weight[steady]
    if len(weight) == 0:
        return np.empty((0, 3))
    votes = position / weight[:, None] - radius * direction / length[steady, None]

    key, size = _cells(votes, _VOTE * radius)
    cells, group = np.unique(key, return_inverse=True)
    mass = np.bincount(group, weight, len(cells))
    moment = np.stack([np.bincount(group, votes[:, k] * weight, len(cells)) for k in range(3)], axis=1)
    total, centre = mass.copy(), moment.copy()
    for offset in _neighbour_offsets(size):
        at = np.searchsorted(cells, cells + offset)
        at[at == len(cells)] = 0
        hit = cells[at] == cells + offset
        total[hit] += mass[at[hit]]
        centre[hit] += moment[at[hit]]
    strong = np.flatnonzero(total > _MIN_VOTE * 4 * np.pi * radius**2)
    strong = strong[np.argsort(-total[strong])]
    peaks = centre[strong] / total[strong, None]
    picked: list[Array] = []
    free = np.ones(len(peaks), dtype=bool)
    for k, peak in enumerate(peaks):
        if not free[k]:
            continue
        picked.append(peak)
        free &= np.linalg.norm(peaks - peak, axis=1) > 0.4 * radius
        if len(picked) == _MAX_CANDIDATES:
            break
    return np.asarray(picked).reshape(-1, 3)


def _cells(points: Array, cell: float) -> tuple[IntArray, IntArray]:
    """Keys of the cubic cells of points (N, 3), and the grid's size (3,) that neighbour offsets need."""
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64) + 1
    size = index.max(axis=0) + 2
    return (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2], size


def _neighbour_offsets(size: IntArray) -> list[int]:
    steps = (-1, 0, 1)
    offsets = [int((i * size[1] + j) * size[2] + k) for i in steps for j in steps for k in steps]
    return [offset for offset in offsets if offset]


@dataclass(frozen=True, slots=True)
class _Fit:
    """A finished robust fit over a neighbourhood of n vertices."""

    centre: Array
    band: float  # residual beyond which a vertex has no weight
    weights: Array  # (n,) robust weight × area, m²


def _fit(surface: _Surface, hood: IntArray, start: Array, radius: float, *, sign: float, band: float) -> _Fit | None:
    """Known-radius Tukey fit from a candidate centre; None when the candidate dissolves."""
    points = surface.vertices[hood]
    normals = surface.vertex_area_normals[hood] * sign
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    area = surface.vertex_area[hood]
    centre = start.copy()
    weights = np.zeros(len(points))
    for _ in range(30):
        ray = points - centre
        distance = np.linalg.norm(ray, axis=1)
        unit = ray / np.maximum(distance, 1e-300)[:, None]
        residual = distance - radius
        eligible = (np.abs(residual) < band) & (np.sum(unit * normals, axis=1) > _MIN_NORMAL_COSINE)
        if np.count_nonzero(eligible) < _MIN_VERTICES:
            return None
        weights = np.where(eligible, (1 - (residual / band) ** 2) ** 2, 0.0) * area
        weighted = unit * weights[:, None]
        H = weighted.T @ unit
        if np.linalg.eigvalsh(H)[0] < 1e-3 * np.trace(H):
            return None
        step = np.linalg.solve(H, weighted.T @ residual)
        centre = centre + step
        if np.linalg.norm(centre - start) > 0.7 * radius:
            return None
        # Tukey's constant for 95 % efficiency; the floor keeps a perfect mesh from losing its vertices.
        spread = 1.4826 * float(np.median(np.abs(residual[eligible])))
        target = max(4.685 * spread, 5e-3 * radius)
        if np.linalg.norm(step) < 1e-7 * radius and target >= 0.95 * band:
            break
        band = float(np.clip(target, 0.5 * band, band))
    return _Fit(centre, band, weights)


def _measure(surface: _Surface, hood: IntArray, fit: _Fit, radius: float, sign: float) -> MeshSphere:
    """Residual, coverage, covariance and free radius of a finished fit."""
    inlier = fit.weights > 0
    points, w = surface.vertices[hood[inlier]], fit.weights[inlier]
    ray = points - fit.centre
    distance = np.linalg.norm(ray, axis=1)
    u, r = ray / distance[:, None], distance - radius
    H_inverse = np.linalg.inv((u * w[:, None]).T @ u)
    # Scanner and voxel errors are shared by neighbours, so scores are summed over patches before they are
    # squared (a cluster-robust sandwich); single vertices would promise far too much.
    patch, _ = _cells(points, radius / 5)
    _, group = np.unique(patch, return_inverse=True)
    score = np.stack([np.bincount(group, w * r * u[:, k]) for k in range(3)], axis=1)
    # One linearised step in centre and radius is exact enough this close to the solution.
    J = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    free = np.linalg.lstsq(J * np.sqrt(w)[:, None], r * np.sqrt(w), rcond=None)[0]
    return MeshSphere(
        centre_m=fit.centre,
        covariance=H_inverse @ (score.T @ score) @ H_inverse,
        rms_m=float(np.sqrt(np.sum(w * r * r) / np.sum(w))),
        radius_residual_m=float(free[3]),
        coverage=_coverage(surface, hood[inlier], fit.centre, sign),
        n=int(np.count_nonzero(inlier)),
    )


def _coverage(surface: _Surface, inliers: IntArray, centre: Array, sign: float) -> float:
    """Solid angle of the faces whose vertices are all inliers, over 4π."""
    begin, end = surface.first_face[inliers], surface.first_face[inliers + 1]
    lengths = end - begin
    within = np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    faces = surface.faces_by_vertex[np.repeat(begin, lengths) + within]
    faces = faces[np.isin(surface.faces[faces, 1:], inliers).all(axis=1)]
    ray = surface.vertices[surface.faces[faces]].mean(axis=1) - centre
    distance = np.linalg.norm(ray, axis=1)
    angle = np.sum(ray * surface.area_normals[faces] * sign, axis=1) / np.maximum(distance, 1e-300) ** 3
    return float(min(np.sum(np.maximum(angle, 0.0)) / (4 * np.pi), 1.0))
