"""Completes a fused surface where it is open and steep, by moving a closed guess until the photographs are alike."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu

from service.compute.images.render import RayMesh
from service.compute.stereo.matching import StereoView
from service.compute.surfaces.surface import PointIndex, Surface
from service.core.geometry import Array, apply, inverse

# What follows is in pixels of the images, at the object.
_OPEN_PX = 2.5  # from the surface that is known: farther vertices of the guess are moved
_SEARCHES = ((16.0, 1.0, 2.5), (12.0, 1.0, 2.0))  # reach to both sides, step, spacing of a patch's samples
_SMOOTH_PX, _SLIP_PX = 6.0, 1.0  # length over which the moved surface is made even, and change that evidence permits
_RING = 3  # edges: vertices of the known surface around an opening, which stay
_EVEN = 8  # means of normals with their neighbours'
_PER_STEP, _MOST = 0.06, 0.48  # cost of neighbours that move differently, by a step and by many
_THROUGH, _MOST_THROUGH = 0.15, 6  # cost of each view that sees through a place, up to so many
_STAYS, _MOST_STAYS = 0.5, 3.0  # cost of a known vertex that moves, by a step and by many
_NO_HOLD, _FULL_HOLD = 0.4, 0.8  # evidence up to which a vertex is not held in place then, and from which it is fully
_LEAST_EVIDENCE = 0.2  # of a place that is accepted
_STEEP = 0.6  # cosine at the second view: what two views see less steeply, rectified matching would have found
_FEW_THROUGH = 2  # views that see through a place that is not accepted
_FIELD = 0.5  # of the views, that have a place in their image: the object, not the room

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Opening:
    """The part of the guess that is moved: vertices by index, edges between them, and which of them stay."""

    vertices: Ints = field(repr=False)
    edges: Ints = field(repr=False)
    stays: NDArray[np.bool_] = field(repr=False)


def completed(known: Surface, views: Sequence[StereoView], footprint_m: float) -> Surface:
    """Complete a surface where it is steep, by further faces that do not share its vertices.

    Args:
        known: the fused surface.
        views: the views from which it was made.
        footprint_m: width that a pixel of them covers at the object.
    """
    guess = closed(known)
    seen = RayMesh(known.vertices_m, known.faces)
    photographs = [photograph(view, seen) for view in views]
    edges = edges_of(guess.faces)
    part = _opening(known, guess, edges, photographs, _OPEN_PX * footprint_m)
    if part.stays.all():
        return known
    vertices, places, normals, found = guess.vertices_m.copy(), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    for reach, step, spacing in _SEARCHES:
        even = averaged(Surface(vertices, guess.faces).vertex_normals, edges, _EVEN)
        normals = even[part.vertices] / np.maximum(np.linalg.norm(even[part.vertices], axis=1, keepdims=True), 1e-9)
        moves = np.arange(-reach, reach + step / 2, step) * footprint_m
        moved, found = _best_moves(photographs, vertices[part.vertices], normals, part, moves, spacing * footprint_m)
        places = vertices[part.vertices] + moved[:, None] * normals
        held = ((found - _NO_HOLD) / (_FULL_HOLD - _NO_HOLD)).clip(0, 1) ** 2
        even_m, slip_m = _SMOOTH_PX * footprint_m, _SLIP_PX * footprint_m
        vertices[part.vertices] = relaxed(places, held, part.stays, part.edges, even_m, slip_m)
    kept = _supported(photographs, places, normals, found) & ~part.stays
    return _with(known, vertices, guess.faces, part, kept)


def _opening(
    known: Surface, guess: Surface, edges: Ints, photographs: Sequence[Photograph], far_m: float
) -> _Opening:
    """Return the vertices of the guess far from the known surface, and a ring of others around them."""
    is_open = ~np.isfinite(PointIndex(known.vertices_m).nearest(guess.vertices_m, far_m)[0])
    within = np.sum([one.seen(guess.vertices_m)[3] for one in photographs], axis=0)
    is_open &= within >= _FIELD * len(photographs)
    taken = is_open.copy()
    for _ in range(_RING):
        touched = taken[edges].any(axis=1)
        taken[edges[touched].ravel()] = True
    vertices = np.flatnonzero(taken)
    compact = np.full(len(taken), -1, dtype=np.int64)
    compact[vertices] = np.arange(len(vertices))
    return _Opening(vertices, compact[edges[taken[edges].all(axis=1)]], ~is_open[vertices])


def _best_moves(
    photographs: Sequence[Photograph],
    points_m: Array,
    normals: Array,
    part: _Opening,
    moves_m: Array,
    spacing_m: float,
) -> tuple[Array, Array]:
    """Return (N,) metres that each vertex is to move along its normal, and the evidence for it."""
    alike = averaged(evidence(photographs, points_m, normals, moves_m, spacing_m)[0], part.edges, 1)
    places = points_m[:, None] + moves_m[:, None] * normals[:, None]
    costs = 1 - alike + _THROUGH * np.minimum(seen_through(photographs, places), _MOST_THROUGH)
    steps = np.abs(np.arange(len(moves_m)) - len(moves_m) // 2)
    costs[part.stays] = np.minimum(_STAYS * steps, _MOST_STAYS)
    belief = beliefs(costs.astype(np.float32), part.edges, _PER_STEP, _MOST)
    best = belief.argmin(axis=1)
    moved = np.where(part.stays, 0.0, _lowest(belief, best, moves_m))
    moved = np.where(part.stays, 0.0, averaged(moved, part.edges, 1))
    return moved, alike[np.arange(len(best)), best]


def _lowest(belief: NDArray[np.float32], best: Ints, moves_m: Array) -> Array:
    """Return (N,) the move at the minimum of the parabola through the best label and its neighbours."""
    row, inner = np.arange(len(best)), best.clip(1, len(moves_m) - 2)
    before, at, after = (belief[row, inner + k].astype(np.float64) for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    shift = np.where(curvature > 1e-5, 0.5 * (before - after) / np.maximum(curvature, 1e-5), 0.0)
    shift = np.where(best == inner, shift.clip(-1, 1), 0.0)
    return moves_m[best] + shift * (moves_m[1] - moves_m[0])


def _supported(photographs: Sequence[Photograph], points_m: Array, normals: Array, found: Array) -> NDArray[np.bool_]:
    """Return which vertices are steep, have evidence, and are not seen through."""
    second = best_views(photographs, points_m, normals)[1][:, 1]
    return (
        (second > 0)
        & (second < _STEEP)
        & (found > _LEAST_EVIDENCE)
        & (seen_through(photographs, points_m) < _FEW_THROUGH)
    )


def _with(known: Surface, vertices_m: Array, faces: Ints, part: _Opening, kept: NDArray[np.bool_]) -> Surface:
    """Return the known surface with the faces that have a vertex in `kept`, and else only known ones."""
    is_kept, usable = (np.zeros(len(vertices_m), dtype=np.bool_) for _ in range(2))
    is_kept[part.vertices[kept]] = True
    usable[part.vertices[kept | part.stays]] = True
    added = faces[is_kept[faces].any(axis=1) & usable[faces].all(axis=1)]
    used, compact = np.unique(added, return_inverse=True)
    return Surface(
        np.concatenate([known.vertices_m, vertices_m[used]]),
        np.concatenate([known.faces, compact.reshape(-1, 3) + len(known.vertices_m)]).astype(np.int64),
    )


# A first surface, closed where nothing was matched, as a guess for the second search: Poisson reconstruction.
#
# Source: Kazhdan and Hoppe, "Screened Poisson Surface Reconstruction", ACM Transactions on Graphics 2013; in
# COLMAP.


_DEPTH = 9  # of the octree: cells of a 512th of the scene; a guess needs no more


def closed(surface: Surface) -> Surface:
    """Return a surface without holes near the given one; what it adds is a guess and never a result."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-") as name:
        points, mesh = Path(name) / "points.ply", Path(name) / "mesh.ply"
        _write_points(points, surface.vertices_m, surface.vertex_normals)
        options = pycolmap.PoissonMeshingOptions(depth=_DEPTH, trim=0.0, num_threads=1)
        pycolmap.poisson_meshing(points, mesh, options)
        found = trimesh.load_mesh(mesh, process=False)
    return Surface(np.asarray(found.vertices, dtype=np.float64), np.asarray(found.faces, dtype=np.int64))


def _write_points(path: Path, points_m: Array, normals: Array) -> None:
    """Write points with normals as COLMAP reads them, which needs a colour as well."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    colours = ("red", "green", "blue")
    rows = np.zeros(len(points_m), dtype=[(name, "<f4") for name in names] + [(name, "u1") for name in colours])
    for k, name in enumerate(names):
        rows[name] = np.concatenate([points_m, normals], axis=1)[:, k]
    fields = [f"property float {name}" for name in names] + [f"property uchar {name}" for name in colours]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *fields, "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


# One of several labels for each vertex of a mesh, so that neighbours have nearly the same: belief propagation.
#
# Source: Felzenszwalb and Huttenlocher, "Efficient Belief Propagation for Early Vision", IJCV 2006, with min-sum
# messages and a truncated linear difference.


Floats = NDArray[np.float32]

_MESSAGE_ROUNDS = 15


def edges_of(faces: Ints) -> Ints:
    """Return (E, 2) each edge of a triangle mesh once, the smaller index first."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    ends = np.unique(ends, axis=0)
    return ends[ends[:, 0] != ends[:, 1]]


def neighbours(edges: Ints, count: int) -> csr_matrix:
    """Return (V, V) 1 for each two of V vertices that share one of the edges (E, 2), else 0."""
    return _incidence(np.concatenate([edges, edges[:, ::-1]]), (count, count))


def averaged(values: NDArray[np.floating], edges: Ints, rounds: int) -> Array:
    """Return the values (V, ...) after so many means of each vertex with its neighbours."""
    out, count = np.asarray(values, dtype=np.float64), len(values)
    mean = neighbours(edges, count) + identity(count, format="csr")
    mean = diags(1 / np.asarray(mean.sum(axis=1)).ravel()) @ mean
    for _ in range(rounds):
        out = np.asarray(mean @ out, dtype=np.float64)
    return out


def beliefs(costs: Floats, edges: Ints, per_step: float, most: float) -> Floats:
    """Return (V, L) the cost of each label at each vertex, when all others choose as suits them.

    Args:
        costs: (V, L) cost of a label at a vertex alone.
        edges: (E, 2) pairs of neighbours.
        per_step: cost of neighbours whose labels differ by one.
        most: cost of neighbours whose labels differ by much.
    """
    count, labels = costs.shape
    pairs = np.concatenate([edges, edges[:, ::-1]])  # of sender and receiver
    back = np.concatenate([np.arange(len(edges)) + len(edges), np.arange(len(edges))])
    received = _incidence(np.stack([pairs[:, 1], np.arange(len(pairs))], axis=1), (count, len(pairs)))
    messages = np.zeros((len(pairs), labels), dtype=np.float32)
    belief = costs.astype(np.float32)
    for _ in range(_MESSAGE_ROUNDS):
        said = belief[pairs[:, 0]] - messages[back]
        found = said.copy()
        for k in range(1, labels):
            np.minimum(found[:, k], found[:, k - 1] + np.float32(per_step), out=found[:, k])
        for k in range(labels - 2, -1, -1):
            np.minimum(found[:, k], found[:, k + 1] + np.float32(per_step), out=found[:, k])
        np.minimum(found, said.min(axis=1, keepdims=True) + np.float32(most), out=found)
        found -= found.min(axis=1, keepdims=True)
        messages = np.float32(0.5) * (messages + found)  # damped: meshes have cycles
        belief = costs + received @ messages
    return np.asarray(belief, dtype=np.float32)


def _incidence(places: Ints, shape: tuple[int, int]) -> csr_matrix:
    return coo_matrix((np.ones(len(places), dtype=np.float32), places.T), shape).tocsr()


# How much alike the photographs are in patches that lie in a surface, when the surface is moved along its normal.
#
# A patch is turned with the surface, so that all photographs foreshorten it alike; what is steep is compared as
# well as what is seen from the front.


VIEWS = 4  # compared at each place
_HALF = 4  # of a patch's edge, in samples
_LEAST_COSINE = 0.13  # between the normal and the ray
_LEAST_PARALLAX = 0.2  # of two views, in the surface: metres for a metre along the normal
_LEAST_STRETCH = 0.3  # a patch is longer along the steep direction by 1/cosine, up to this
_NOISE = 1.0  # grey values
_FINE, _COARSE = 0.75, 4.5  # pixels: details between these sizes are compared, shading is not
_STEP = 4  # pixels between the rays of the known surface
_SLACK_M = 2e-3  # of the known surface
_AT_ONCE = 1500  # places whose patches are in memory
_LISTED = 10_000  # places that are held against all views at a time
_COLUMNS = 4096  # of the rectangle that lists are folded into for cv2.remap
_ROWS = 30_000

_V, _U = (k.ravel().astype(np.float32) for k in np.mgrid[-_HALF : _HALF + 1, -_HALF : _HALF + 1])


@dataclass(frozen=True, slots=True)
class Photograph:
    """A view with what is compared of it, and the depth of the known surface in every _STEP-th pixel.

    Attributes:
        detail: (H, W) grey values without shading.
        farthest: greatest depth of what is known around a pixel; infinite where nothing is.
        nearest: least depth of what is known around a pixel; 0 where nothing is.
    """

    view: StereoView
    detail: Floats = field(repr=False)
    farthest: Floats = field(repr=False)
    nearest: Floats = field(repr=False)

    def seen(self, points_m: Array) -> tuple[Array, Array, Ints, NDArray[np.bool_]]:
        """Project points (..., 3): pixels (..., 2), depth, place in the known depths (..., 2), if in the image."""
        camera = apply(inverse(self.view.T_world_camera), points_m.reshape(-1, 3)).reshape(points_m.shape)
        of = self.view.camera
        z = np.maximum(camera[..., 2], 1e-9)
        pixels = camera[..., :2] / z[..., None] * [of.fx, of.fy] + [of.cx, of.cy]
        place = np.floor((pixels + 0.5) / _STEP)
        height, width = self.farthest.shape
        inside = (place >= 0).all(axis=-1) & (place < [width, height]).all(axis=-1) & (camera[..., 2] > 0)
        return pixels, z, np.where(inside[..., None], place, 0).astype(np.int64), inside


def photograph(view: StereoView, known: RayMesh) -> Photograph:
    """Return a view beside the surface that is known already."""
    grey = view.image.astype(np.float32)
    detail = cv2.GaussianBlur(grey, (0, 0), _FINE) - cv2.GaussianBlur(grey, (0, 0), _COARSE)
    camera = view.camera
    v, u = (k * _STEP + (_STEP - 1) / 2 for k in np.mgrid[: camera.height // _STEP, : camera.width // _STEP])
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    depth = known.depths(view.T_world_camera, rays.reshape(-1, 3)).reshape(u.shape).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(np.nan_to_num(depth, nan=1e9), kernel)
    nearest = cv2.erode(np.nan_to_num(depth, nan=0.0), kernel)
    return Photograph(
        view, np.asarray(detail, np.float32), np.asarray(farthest, np.float32), np.asarray(nearest, np.float32)
    )


def seen_through(photographs: Sequence[Photograph], points_m: Array) -> Ints:
    """Return (N, ...) how many photographs show a known surface behind each point (N, ..., 3)."""
    out = np.zeros(points_m.shape[:-1], dtype=np.int64)
    for begin in range(0, len(points_m), _LISTED):
        part = slice(begin, begin + _LISTED)
        for one in photographs:
            _, z, place, inside = one.seen(points_m[part])
            nearest = one.nearest[place[..., 1], place[..., 0]]
            out[part] += inside & (nearest > 0) & (z < nearest - _SLACK_M)
    return out


def best_views(photographs: Sequence[Photograph], points_m: Array, normals: Array) -> tuple[Ints, Array]:
    """Return (N, VIEWS) the views that face each place most, with parallax between them, and their cosines.

    -1 and 0 where there are no more. What lies behind the known surface is not seen. The memory that this takes does
    not grow with the places times the views.
    """
    chosen, found = np.full((len(points_m), VIEWS), -1, dtype=np.int64), np.zeros((len(points_m), VIEWS))
    for begin in range(0, len(points_m), _LISTED):
        part = slice(begin, begin + _LISTED)
        chosen[part], found[part] = _best_views_at_once(photographs, points_m[part], normals[part])
    return chosen, found


def _best_views_at_once(photographs: Sequence[Photograph], points_m: Array, normals: Array) -> tuple[Ints, Array]:
    count = len(points_m)
    cosines = np.zeros((count, len(photographs)))
    slants = np.zeros((count, len(photographs), 3))
    for k, one in enumerate(photographs):
        _, z, place, inside = one.seen(points_m)
        ray = one.view.eye_m - points_m
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        cosine = np.einsum("ij,ij->i", ray, normals)
        inside &= z < one.farthest[place[:, 1], place[:, 0]] + _SLACK_M
        cosines[:, k] = np.where(inside & (cosine > _LEAST_COSINE), cosine, 0)
        slants[:, k] = (ray - cosine[:, None] * normals) / np.maximum(cosine, _LEAST_COSINE)[:, None]
    chosen, found = np.full((count, VIEWS), -1, dtype=np.int64), np.zeros((count, VIEWS))
    left, row = cosines.copy(), np.arange(count)
    for j in range(VIEWS):
        k = left.argmax(axis=1)
        any_left = left[row, k] > 0
        chosen[any_left, j], found[any_left, j] = k[any_left], cosines[row, k][any_left]
        left[_parallax(slants, slants[row, k], np.minimum(cosines, cosines[row, k][:, None])) < _LEAST_PARALLAX] = 0
    return chosen, found


def _parallax(slants: Array, one: Array, cosines: Array) -> Array:
    """Return (N, K) how far apart two views see a place, in lengths on the surface as they show it, per unit move."""
    apart = slants - one[:, None]
    steep = one / np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-9)
    along = np.einsum("nki,ni->nk", apart, steep)
    across2 = np.maximum(np.einsum("nki,nki->nk", apart, apart) - along**2, 0)
    return np.sqrt(across2 + (along * cosines) ** 2)


def evidence(
    photographs: Sequence[Photograph], points_m: Array, normals: Array, moves_m: Array, spacing_m: float
) -> tuple[Floats, Array]:
    """Return how alike the photographs are, 0 to 1 (N, L), with places moved along normals; and the views' cosines.

    It is the correlation of patches, averaged over pairs of views. A noise is added to each variance, so that patches
    without texture correlate little. It is 0 where fewer than two views see a place.
    """
    out = np.zeros((len(points_m), len(moves_m)), dtype=np.float32)
    views, cosines = best_views(photographs, points_m, normals)
    usable = np.flatnonzero((views >= 0).sum(axis=1) >= 2)
    eyes = np.stack([one.view.eye_m for one in photographs])
    for begin in range(0, len(usable), _AT_ONCE):
        part = usable[begin : begin + _AT_ONCE]
        chosen, seen = views[part], views[part] >= 0
        eye = np.einsum("nv,nvi->ni", seen / seen.sum(axis=1, keepdims=True), eyes[chosen])
        stretch = np.maximum(cosines[part].sum(axis=1) / seen.sum(axis=1), _LEAST_STRETCH)
        steep, level = _axes(points_m[part], normals[part], eye)
        axes = np.stack([normals[part], spacing_m * steep / stretch[:, None], spacing_m * level], axis=1)
        out[part] = _likeness(_patches(photographs, points_m[part], axes, chosen, moves_m), seen)
    return out, cosines


def _axes(points_m: Array, normals: Array, eye_m: Array) -> tuple[Array, Array]:
    """Return the unit vectors in the surface: towards the eye, which is foreshortened, and across."""
    toward = eye_m - points_m + 1e-9  # never exactly along the normal
    steep = toward - np.einsum("ij,ij->i", toward, normals)[:, None] * normals
    steep /= np.maximum(np.linalg.norm(steep, axis=1, keepdims=True), 1e-12)
    return steep, np.cross(normals, steep).astype(np.float64)


def _likeness(patches: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Return (N, L) mean correlation of pairs of patches (N, VIEWS, L, samples)."""
    variance = np.mean(patches**2, axis=-1) + np.float32(_NOISE**2)
    total, count = np.zeros((patches.shape[0], patches.shape[2]), dtype=np.float32), np.zeros(len(patches))
    for i in range(VIEWS):
        for j in range(i):
            both = seen[:, i] & seen[:, j]
            together = np.mean(patches[:, i] * patches[:, j], axis=-1) / np.sqrt(variance[:, i] * variance[:, j])
            total += np.where(both[:, None], np.maximum(together, 0), 0)
            count += both
    return np.asarray(total / np.maximum(count, 1)[:, None], dtype=np.float32)


def _patches(photographs: Sequence[Photograph], points_m: Array, axes: Array, chosen: Ints, moves_m: Array) -> Floats:
    """Return (N, VIEWS, L, samples) what each view shows of each moved patch, less its mean.

    The patch is projected with the derivative at its middle, since it is small compared with its distance.
    """
    out = np.zeros((*chosen.shape, len(moves_m), len(_U)), dtype=np.float32)
    for k in np.unique(chosen[chosen >= 0]):
        place, slot = np.nonzero(chosen == k)
        view = photographs[k].view
        R = view.T_world_camera[:3, :3]
        focal, principal = (np.array(x) for x in ((view.camera.fx, view.camera.fy), (view.camera.cx, view.camera.cy)))
        normal, steep, level = np.moveaxis(axes[place] @ R, 1, 0)
        middle = ((points_m[place] - view.eye_m) @ R)[:, None] + moves_m[:, None] * normal[:, None]
        ray, z = middle[..., :2] / middle[..., 2:], middle[..., 2:]
        pixel = ray * focal + principal
        along, across = ((x[:, None, :2] - ray * x[:, None, 2:]) / z * focal for x in (steep, level))
        u, v = (
            (pixel[..., i, None] + along[..., i, None] * _V + across[..., i, None] * _U).astype(np.float32)
            for i in (0, 1)
        )
        grey = _sampled(photographs[k].detail, u, v)
        out[place, slot] = grey - grey.mean(axis=-1, keepdims=True)
    return out


def _sampled(image: Floats, u: Floats, v: Floats) -> Floats:
    """Return the image at pixels (...), which cv2.remap takes as rectangles only."""
    rows = -(-u.size // _COLUMNS)
    x, y = (np.pad(k.ravel(), (0, rows * _COLUMNS - u.size), mode="edge").reshape(rows, _COLUMNS) for k in (u, v))
    out = np.empty((rows, _COLUMNS), dtype=np.float32)
    for begin in range(0, rows, _ROWS):
        part = slice(begin, begin + _ROWS)
        out[part] = cv2.remap(image, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.ravel()[: u.size].reshape(u.shape)


# A moved surface made even, also where nothing holds it: the equilibrium of a thin plate on springs.
#
# Source of the plate on a mesh: Kobbelt et al., "Interactive Multi-Resolution Modeling on Arbitrary Meshes",
# SIGGRAPH 1998. Its bending at a vertex is the distance to the mean of the neighbours.


_LEAST_SPRING = 1e-6  # keeps in place what has no path to a vertex that is held
_SPRING_ROUNDS = 3  # solutions; each after the first with weaker springs where the one before is far from them


def relaxed(
    points_m: Array, held: Array, fixed: NDArray[np.bool_], edges: NDArray[np.int64], even_m: float, slip_m: float
) -> Array:
    """Return (V, 3) vertices for which the energy of springs and bending together is least.

    Args:
        points_m: (V, 3) vertices, at which the springs have no force.
        held: (V,) stiffness of the springs, 0 to 1.
        fixed: (V,) vertices that do not move.
        edges: (E, 2) pairs of neighbours.
        even_m: length over which the plate evens out what springs of stiffness 1 hold.
        slip_m: extension that halves the stiffness of a spring, so that single errors do not hold the plate.
    """
    if fixed.all():
        return points_m.copy()
    free, rest = np.flatnonzero(~fixed), np.flatnonzero(fixed)
    edge_m = np.median(np.linalg.norm(points_m[edges[:, 0]] - points_m[edges[:, 1]], axis=1))
    bending = _bending(edges, len(points_m))
    plate = (even_m / edge_m) ** 4 * (bending.T @ bending).tocsr()[free]
    inner, outer = plate[:, free], plate[:, rest] @ points_m[rest]
    out = points_m.copy()
    for _ in range(_SPRING_ROUNDS):
        extension = np.linalg.norm(out[free] - points_m[free], axis=1)
        spring = np.maximum(held[free] / (1 + (extension / slip_m) ** 2), _LEAST_SPRING)
        out[free] = splu((inner + diags(spring)).tocsc()).solve(spring[:, None] * points_m[free] - outer)
    return out


def _bending(edges: NDArray[np.int64], count: int) -> csr_matrix:
    """Return (V, V) takes vertices to what separates each from the mean of its neighbours."""
    beside = neighbours(edges, count)
    mean = diags(1 / np.maximum(np.asarray(beside.sum(axis=1), dtype=np.float64).ravel(), 1)) @ beside
    return (identity(count, format="csr") - mean).tocsr()
