"""Reconstructs a mesh from posed images: depth maps of pairs, their fusion, again finely, then steep parts."""

from __future__ import annotations

import dataclasses
import pickle
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
from service.compute.stereo.matching import (
    DepthMap,
    StereoView,
    depth_of_pair,
    guided_depth,
    looked_at_m,
    rectified,
    stereo_pairs,
)
from service.compute.stereo.steep import closed, completed
from service.compute.surfaces.surface import Surface
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse
from service.machine.executors import mapping
from service.machine.resources import return_freed_memory

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class StoredView:
    """A view whose image is in a file, so that it can travel."""

    file: Path
    camera: CameraModel
    T_world_camera: Transform

    def read(self) -> StereoView:
        """Return the view with its image."""
        return StereoView(np.load(self.file), self.camera, self.T_world_camera)


@dataclass(frozen=True, slots=True)
class _PairTask:
    """The task of matching two views of an object at `centre_m`; `near` is the file of a guessed surface, if any."""

    one: StoredView
    two: StoredView
    centre_m: Array
    near: Path | None


@contextmanager
def stored_views(views: Sequence[StereoView]) -> Generator[list[StoredView]]:
    """Provide the views with their images in temporary files."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-stereo-") as scratch:
        stored: list[StoredView] = []
        for k, view in enumerate(views):
            stored.append(StoredView(Path(scratch) / f"{k}.npy", view.camera, view.T_world_camera))
            np.save(stored[-1].file, view.image)
        yield stored


def depth_maps(
    views: Sequence[StoredView],
    pairs: Sequence[Pair],
    centre_m: Array,
    report: Callable[[int], None],
    *,
    guess: RayMesh | None = None,
    processes: int = 1,
) -> list[DepthMap]:
    """Return the depth maps of those pairs that show the same, in their order.

    Args:
        views: the views.
        pairs: pairs of them by index.
        centre_m: (3,) the place of the object.
        report: a function that is called with the number of pairs matched.
        guess: the surface near which depth is searched; None: it is searched everywhere.
        processes: number of processes of this machine; 1: this one, unless a cluster was chosen.
    """
    with tempfile.TemporaryDirectory(prefix="orthocapture-stereo-") as scratch:
        near: Path | None = None
        if guess is not None:
            near = Path(scratch) / "guess"
            near.write_bytes(pickle.dumps(guess, protocol=pickle.HIGHEST_PROTOCOL))
        tasks = [_PairTask(views[one], views[two], centre_m, near) for one, two in pairs]
        found: list[DepthMap] = []
        report(0)
        with mapping(processes, len(tasks)) as map_over:
            for done, depth in enumerate(map_over(_depth_map, tasks), 1):
                found += [] if depth is None else [depth]
                report(done)
    _read_guess.cache_clear()
    return found


def _depth_map(task: _PairTask) -> DepthMap | None:
    one, two = task.one.read(), task.two.read()
    distance_m = float(np.linalg.norm(0.5 * (one.eye_m + two.eye_m) - task.centre_m))
    pair = rectified(one, two, task.centre_m)
    if task.near is None:
        return depth_of_pair(pair, distance_m)
    return guided_depth(pair, _read_guess(task.near), distance_m)


@lru_cache(maxsize=1)
def _read_guess(near: Path) -> RayMesh:
    """Return the surface of a file, whose path never recurs; it is held, so that its tree for rays is built once."""
    guess: RayMesh = pickle.loads(near.read_bytes())
    return guess


SIDE = 8  # voxels of a block's edge
TRUNCATION = 4.0  # voxels
_STEP = 2  # every so many pixels of a map say where blocks are needed
_AT_ONCE = 4000  # blocks
_MOST_BLOCKS = 400_000
_MOST_COLUMNS = 4096  # of the rectangle that lists are folded into for cv2.remap, which takes 32767 at most
_OFFSET = 1 << 20  # makes the numbers of blocks positive

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Field:
    """Signed distances in blocks of SIDE³ voxels, positive before the surface.

    Attributes:
        blocks: (B, 3) integer place of each block; voxel (i, j, k) of it is at (SIDE block + (i, j, k)) voxel_m.
        distance: (B, SIDE³) distances in voxels, within ±TRUNCATION.
        weight: (B, SIDE³) weights.
        maps: (B, SIDE³) number of depth maps that contributed.
        voxel_m: edge of a voxel.
    """

    blocks: Ints = field(repr=False)
    distance: NDArray[np.float32] = field(repr=False)
    weight: NDArray[np.float32] = field(repr=False)
    maps: NDArray[np.uint16] = field(repr=False)
    voxel_m: float


def fused(maps: Sequence[DepthMap], voxel_m: float, least_maps: int) -> Field:
    """Fuse depth maps.

    Args:
        maps: depth maps of one scene.
        voxel_m: edge of a voxel.
        least_maps: blocks that fewer maps have a point in are left out.

    Raises:
        ComputeError: no surface is seen by so many maps, or the field would need too much memory.
    """
    blocks = _blocks(maps, voxel_m, least_maps)
    if len(blocks) == 0:
        raise ComputeError(
            f"no place is seen by {least_maps} pairs of images", remedy="Use more images, at smaller angles"
        )
    if len(blocks) > _MOST_BLOCKS:
        raise ComputeError("the scene is too large for this size of voxels", remedy="Use larger voxels")
    shape = (len(blocks), SIDE**3)
    out = Field(blocks, np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint16), voxel_m)
    for one in maps:
        _integrate(out, one)
    return out


def _blocks(maps: Sequence[DepthMap], voxel_m: float, least_maps: int) -> Ints:
    """Return (B, 3) blocks within the truncation of points of enough maps."""
    edge = SIDE * voxel_m
    reach = TRUNCATION * voxel_m
    found: list[Ints] = []
    for one in maps:
        points = one.points_m(_STEP)
        toward = points - one.T_world_camera[:3, 3]
        toward *= reach / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
        keys = [_key(np.floor((points + k * toward) / edge).astype(np.int64)) for k in (-1.0, 0.0, 1.0)]
        found.append(np.unique(np.concatenate(keys)))
    if not found:
        return np.empty((0, 3), dtype=np.int64)
    key, count = np.unique(np.concatenate(found), return_counts=True)
    return _place(key[count >= least_maps])


def _key(place: Ints) -> Ints:
    shifted = place + _OFFSET
    return (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]


def _place(key: Ints) -> Ints:
    mask = (1 << 21) - 1
    return np.stack([key >> 42, (key >> 21) & mask, key & mask], axis=1) - _OFFSET


def _integrate(out: Field, one: DepthMap) -> None:
    """Add what one depth map says about the voxels before and shortly behind its surface."""
    T = inverse(one.T_world_camera)
    edge = SIDE * out.voxel_m
    middle = (out.blocks + 0.5) * edge @ T[:3, :3].T + T[:3, 3]
    pixels, z = _pixels(one, middle)
    radius = np.sqrt(3) / 2 * edge
    margin = one.camera.fx * radius / np.maximum(z, 1e-6)
    height, width = one.depth_m.shape
    inside = (z > radius) & (pixels[:, 0] > -margin) & (pixels[:, 0] < width + margin)
    inside &= (pixels[:, 1] > -margin) & (pixels[:, 1] < height + margin)
    chosen = np.flatnonzero(inside)
    grid = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = (grid * out.voxel_m) @ T[:3, :3].T
    for begin in range(0, len(chosen), _AT_ONCE):
        part = chosen[begin : begin + _AT_ONCE]
        corner = out.blocks[part] * edge @ T[:3, :3].T + T[:3, 3]
        _add(out, one, part, (corner[:, None, :] + local[None]).astype(np.float32))


def _add(out: Field, one: DepthMap, part: Ints, camera: NDArray[np.float32]) -> None:
    """Add a map to some blocks, whose voxels (P, SIDE³, 3) are in the map's frame."""
    flat = camera.reshape(-1, 3)
    z = flat[:, 2]
    u = flat[:, 0] / z * np.float32(one.camera.fx) + np.float32(one.camera.cx)
    v = flat[:, 1] / z * np.float32(one.camera.fy) + np.float32(one.camera.cy)
    distance = (_sampled(one.depth_m, u, v) - z) / np.float32(out.voxel_m)
    said = (distance > -TRUNCATION).reshape(len(part), -1)
    value = np.minimum(distance, np.float32(TRUNCATION)).reshape(len(part), -1)
    weight = np.where(said, np.float32(one.weight), np.float32(0))
    before = out.weight[part]
    after = before + weight
    mean = out.distance[part]
    mean += np.where(said, weight / np.maximum(after, np.float32(1e-12)) * (value - mean), np.float32(0))
    out.distance[part], out.weight[part] = mean, after
    out.maps[part] += said


def _pixels(one: DepthMap, points: Array) -> tuple[Array, Array]:
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    with np.errstate(invalid="ignore"):
        pixels = points[:, :2] / z[:, None] * np.diag(one.camera.matrix)[:2] + one.camera.matrix[:2, 2]
    return np.nan_to_num(pixels, nan=-1e9), np.nan_to_num(z, nan=-1.0)


def _sampled(depth: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the depth (N,) between pixels; NaN where one of the four around is unknown."""
    columns = min(len(u), _MOST_COLUMNS)
    rows = -(-len(u) // columns)
    places = np.full((2, rows * columns), -10.0, dtype=np.float32)
    places[0, : len(u)], places[1, : len(u)] = u, v
    np.nan_to_num(places, copy=False, nan=-10.0)
    x, y = places.reshape(2, rows, columns)
    found = cv2.remap(depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return np.asarray(found, dtype=np.float32).reshape(-1)[: len(u)]


_TILE = 8  # blocks of a tile's edge
_LEAST_PIECE = 0.002  # of the largest piece's area: smaller ones are noise
_ROUND = 1e-3  # voxels: vertices of neighbouring tiles closer than this are one


def surface_of(found: Field, least_maps: int) -> Surface:
    """Return the surface where the distance is zero, in metres, faces outward.

    Args:
        found: the field.
        least_maps: voxels that fewer maps spoke about are unknown.

    Raises:
        ComputeError: there is none.
    """
    tiles = np.floor_divide(found.blocks, _TILE)
    order = {tuple(int(x) for x in place): k for k, place in enumerate(found.blocks)}
    vertices: list[NDArray[np.float64]] = []
    faces: list[Ints] = []
    total = 0
    for tile in np.unique(tiles, axis=0):
        distance, known = _tile(found, order, tile * _TILE, least_maps)
        if not known.any() or distance[known].min() >= 0 or distance[known].max() <= 0:
            continue
        try:
            points, triangles, _, _ = marching_cubes(
                distance, 0.0, mask=_whole_cells(known), gradient_direction="descent"
            )
        except (ValueError, RuntimeError):  # the surface crosses no known cell of this tile
            continue
        vertices.append(points.astype(np.float64) + SIDE * _TILE * tile)
        faces.append(triangles.astype(np.int64) + total)
        total += len(points)
    if not vertices:
        raise ComputeError("the depth maps have no surface in common", remedy="Use more images, at smaller angles")
    merged = _merged(np.concatenate(vertices), np.concatenate(faces))
    return _without_crumbs(Surface(merged.vertices_m * found.voxel_m, merged.faces))


def _whole_cells(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find where all eight corners of a cell are known, at its last corner, which is where scikit-image looks."""
    cells = np.zeros_like(known)
    cells[1:, 1:, 1:] = True
    for i, j, k in np.ndindex(2, 2, 2):
        cells[1:, 1:, 1:] &= known[i : i + known.shape[0] - 1, j : j + known.shape[1] - 1, k : k + known.shape[2] - 1]
    return cells


def _tile(
    found: Field, order: dict[tuple[int, ...], int], first: Ints, least_maps: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the distances and known voxels of a tile, with one layer of its neighbours."""
    edge = SIDE * _TILE + 1
    distance = np.full((edge + SIDE,) * 3, 1.0, dtype=np.float32)
    known = np.zeros(distance.shape, dtype=np.bool_)
    for i in range(_TILE + 1):
        for j in range(_TILE + 1):
            for k in range(_TILE + 1):
                number = order.get((int(first[0]) + i, int(first[1]) + j, int(first[2]) + k))
                if number is None:
                    continue
                at = tuple(slice(SIDE * x, SIDE * (x + 1)) for x in (i, j, k))
                distance[at] = found.distance[number].reshape(SIDE, SIDE, SIDE)
                known[at] = (found.maps[number] >= least_maps).reshape(SIDE, SIDE, SIDE)
    return distance[:edge, :edge, :edge], known[:edge, :edge, :edge]


def _merged(vertices: NDArray[np.float64], faces: Ints) -> Surface:
    """Merge vertices at the same place."""
    keys = np.round(vertices / _ROUND).astype(np.int64)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Surface(vertices[first], faces[whole].astype(np.int64))


def _without_crumbs(surface: Surface) -> Surface:
    """Drop pieces that are much smaller than the largest."""
    n, faces = len(surface.vertices_m), surface.faces
    rows, columns = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    _, piece = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n)), directed=False)
    of_face = piece[faces[:, 0]]
    area = np.bincount(of_face, np.linalg.norm(surface.area_vectors_m2, axis=1))
    kept = faces[area[of_face] >= _LEAST_PIECE * area.max()]
    used, compact = np.unique(kept, return_inverse=True)
    return Surface(surface.vertices_m[used], compact.reshape(-1, 3).astype(np.int64))


COARSE_PX, FINE_PX = 960, 1920  # width of the images that are matched at first and then; larger ones are made smaller
VOXEL_PX = 1.5  # size of a voxel in pixels at the object
_MANY = 24  # depth maps; a surface that so many could see must be seen by several
_FEWEST_AT_FIRST, _FEWEST = 3, 2  # then

Progress = Callable[[str, int, int], None]


def reconstruct(views: Sequence[StereoView], progress: Progress, *, processes: int = 1) -> Surface:
    """Reconstruct the surface that posed images of pinhole cameras show, in the frame and unit of the poses.

    A first surface from small images, closed where nothing was matched, is the guess around which larger images are
    matched. The depth of both is fused: the first holds more of what is steep, the second is finer. If there are many
    images, the steep parts that the fused surface misses are searched for last.

    Args:
        views: the images and their poses.
        progress: called with what is done, how much is done, and the total.
        processes: number of processes of this machine that match pairs; 1: this one, unless a cluster was chosen.

    Raises:
        ComputeError: no two images can be matched, or no surface comes out.
    """
    small, large = ([_smaller(view, width) for view in views] for width in (COARSE_PX, FINE_PX))
    centre = looked_at_m(small)
    pairs = stereo_pairs(small)
    with stored_views(small) as stored:
        report = _pair_progress(progress, "matching pairs", pairs)
        coarse = depth_maps(stored, pairs, centre, report, processes=processes)
    if not coarse:
        raise ComputeError("no pair of images could be matched", remedy="Use more images, at smaller angles")
    many = len(coarse) >= _MANY
    progress("fusing depth maps", 0, 0)
    first = _surface(coarse, VOXEL_PX * _footprint_m(small, centre), _FEWEST_AT_FIRST if many else 1)
    guess = closed(first)
    near = RayMesh(guess.vertices_m, guess.faces)
    report = _pair_progress(progress, "matching pairs near the first surface", pairs)
    with stored_views(large) as stored:
        fine = depth_maps(stored, pairs, centre, report, guess=near, processes=processes)
    progress("fusing all depth maps", 0, 0)
    fused_all = _surface([*coarse, *fine], VOXEL_PX * _footprint_m(large, centre), _FEWEST if many else 1)
    if not many:
        return fused_all
    del coarse, fine
    return_freed_memory()
    progress("searching what is steep", 0, 0)
    return completed(fused_all, small, _footprint_m(small, centre))


def _surface(maps: Sequence[DepthMap], voxel_m: float, least: int) -> Surface:
    return surface_of(fused(maps, voxel_m, least), least)


def _pair_progress(progress: Progress, what: str, pairs: Sequence[Pair]) -> Callable[[int], None]:
    return lambda done: progress(what, done, len(pairs))


def _footprint_m(views: Sequence[StereoView], centre_m: Array) -> float:
    """Return the width, in metres, that a pixel covers at the object."""
    return float(np.median([np.linalg.norm(view.eye_m - centre_m) / view.camera.fx for view in views]))


def _smaller(view: StereoView, width_px: int) -> StereoView:
    camera = view.camera
    if camera.width <= width_px:
        return view
    size = (width_px, round(camera.height * width_px / camera.width))
    image = np.asarray(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return dataclasses.replace(view, image=image, camera=camera.scaled(*size))
