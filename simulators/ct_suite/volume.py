"""Hounsfield volumes of the scene, from rays cast through its closed solids, which gives correct partial volumes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from simulators.geometry import Array, Array32, apply, inverse
from simulators.scene.parts import Part
from simulators.scene.world import RADIUS_M, Scene
from simulators.serve import SimulatorError

AIR, WOOD, TISSUE, BONE, PLASTIC, STEEL = -1000.0, -480.0, 50.0, 650.0, 150.0, 3000.0
HOUNSFIELD = {"specimen": TISSUE, "board": WOOD, "post": WOOD, "steel": STEEL}
NOISE_HU = 15.0
BLUR_VOXELS = 0.55  # Gaussian sigma of the scanner's point spread
MARGIN_VOXELS = 8
_SUBRAY_PITCH_M = 0.27e-3  # lateral antialiasing; along the ray the coverage is exact
_MOST_SUBRAYS = 3  # per side; more would not be visible above the noise
_ROWS = 24  # rows J computed at a time
_HALO = 3  # additional rows on each side that the blur needs
_RESTART_M = 1e-7  # offset past a hit when searching for the next one: the surface may fold closely
_PAST_M = 2e-6  # the same, when the face that was left is met again
_BELOW_M = 1e-3  # of a solid, where the rays start
_ASIDE_M = 2e-6  # displacement in the first attempt of a ray that lost a crossing
_MOST_ATTEMPTS = 9  # in the last one, the displacement is half a millimetre, about a voxel
_GOLDEN_ANGLE_RAD = 2.399963


Box = tuple[slice, slice, slice]


@dataclass(frozen=True, slots=True)
class Grid:
    """A grid of voxel centres p_world = T_world_grid @ (voxel_m * (i, j, k)); rays run along k."""

    T_world_grid: Array
    voxel_m: float
    shape: tuple[int, int, int]  # K, J, I


def grid_around(scene: Scene, T_world_gantry: Array, voxel_m: float, *, control_spheres: bool) -> Grid:
    """Return the smallest grid along the gantry's axes that contains the scene with a margin of air."""
    vertices, _ = scene.solid_mesh(control_spheres)
    p = apply(inverse(T_world_gantry), vertices)
    low = p.min(axis=0) - MARGIN_VOXELS * voxel_m
    size = np.ceil((np.ptp(p, axis=0) + 2 * MARGIN_VOXELS * voxel_m) / voxel_m).astype(int)
    T_world_grid = T_world_gantry.copy()
    T_world_grid[:3, 3] = apply(T_world_gantry, low)
    return Grid(T_world_grid, voxel_m, (int(size[2]), int(size[1]), int(size[0])))


class _Solid:
    """One closed part in an embree scene, in the frame of the grid."""

    def __init__(self, part: Part, grid: Grid) -> None:
        self.name, self.hounsfield = part.name, HOUNSFIELD[part.material]
        p = apply(inverse(grid.T_world_grid), part.vertices_m)[part.faces]
        self.low, self.high = p.reshape(-1, 3).min(axis=0), p.reshape(-1, 3).max(axis=0)
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, p.astype(np.float32))
        self._entering = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] < 0  # outward normal against the ray
        self._vertices = p

    def coverage(self, grid: Grid, first_row: int, rows: int) -> tuple[Box, Array32] | None:
        """Box of voxels (slices k, j, i) of these rows that the solid can touch, and each one's fraction inside."""
        h = grid.voxel_m
        low = np.maximum(np.floor(self.low / h).astype(int) - 1 - [0, first_row, 0], 0)
        high = np.ceil(self.high / h).astype(int) + 2 - [0, first_row, 0]
        high = np.minimum(high, [grid.shape[2], rows, grid.shape[0]])
        if np.any(high <= low):
            return None
        n_i, n_j, n_k = (int(n) for n in high - low)
        side = min(max(2, round(h / _SUBRAY_PITCH_M)), _MOST_SUBRAYS)
        sub = (np.arange(side) + 0.5) / side - 0.5
        x = ((np.arange(low[0], high[0])[:, None] + sub) * h).ravel()
        y = ((np.arange(low[1], high[1])[:, None] + first_row + sub) * h).ravel()
        gy, gx = np.meshgrid(y, x, indexing="ij")
        cell = (np.repeat(np.arange(n_j), side)[:, None] * n_i + np.repeat(np.arange(n_i), side)[None]).ravel()
        ray, z, sign = self._crossings(gx.ravel(), gy.ravel())
        # Voxel k spans k - 0.5 to k + 0.5: the voxel of entry gets the rest of its length, later ones are full.
        u = np.clip(z / h + 0.5 - low[2], 0.0, n_k)
        k = u.astype(np.int64)
        at = k * (n_j * n_i) + cell[ray]
        voxels = np.concatenate([at, at + n_j * n_i])
        shares = np.concatenate([sign * (1.0 - u + k), sign * (u - k)])
        change = np.bincount(voxels, shares, (n_k + 2) * n_j * n_i)
        inside = np.cumsum(change.reshape(n_k + 2, n_j, n_i)[:n_k].astype(np.float32), axis=0)
        inside *= np.float32(1.0 / side**2)
        box = (slice(low[2], high[2]), slice(low[1], high[1]), slice(low[0], high[0]))
        return box, np.clip(inside, 0.0, 1.0, out=inside)

    def _crossings(self, x: Array, y: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Where vertical lines at x, y (N,) cross the surface: each one's line, z, and 1 (into the solid) or -1.

        A line through an edge may miss a face there. It then enters more or less often than it leaves, and would fill
        all voxels above. Such a line is moved aside, twice as far each time, until it leaves as often as it enters.
        """
        out: list[tuple[NDArray[np.int64], Array, Array]] = []
        lines = np.arange(len(x))
        for attempt in range(_MOST_ATTEMPTS):
            angle, aside = _GOLDEN_ANGLE_RAD * attempt, _ASIDE_M * (2**attempt - 1)
            number, z, sign = self._cast(x[lines] + aside * np.cos(angle), y[lines] + aside * np.sin(angle))
            whole = np.bincount(number, sign, len(lines)) == 0
            kept = whole[number]
            out.append((lines[number[kept]], z[kept], sign[kept]))
            lines = lines[~whole]
            if len(lines) == 0:
                break
        else:
            raise SimulatorError(
                f"{len(lines)} rays leave the part {self.name} more or less often than they enter it"
            )
        number, z, sign = (np.concatenate(parts) for parts in zip(*out, strict=True))
        return number, z, sign

    def _cast(self, x: Array, y: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """The crossings, as `_crossings` gives them, that embree finds; on edges it may miss some."""
        origins = np.stack([x, y, np.full(len(x), self.low[2] - _BELOW_M)], axis=1).astype(np.float32)
        up = np.zeros_like(origins)
        up[:, 2] = 1.0
        number, left = np.arange(len(x)), np.full(len(x), -1)
        found: list[tuple[NDArray[np.int64], Array, Array]] = []
        while len(origins):
            face = np.asarray(self._scene.run(origins, up[: len(origins)]))
            hit = face >= 0
            origins, number, again, face = origins[hit], number[hit], (face == left)[hit], face[hit]
            z = self._depth(origins, face)
            found.append((number[~again], z[~again], np.where(self._entering[face[~again]], 1.0, -1.0)))
            beyond = np.where(again, origins[:, 2] + _PAST_M, z + _RESTART_M)
            origins[:, 2] = np.maximum(beyond, np.nextafter(origins[:, 2], np.float32(np.inf)))
            left = face
        rays, z, sign = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return rays, z, sign

    def _depth(self, origins: Array32, face: NDArray[np.int32]) -> Array:
        """Depth z at which vertical rays hit their faces, in double precision."""
        p = self._vertices[face]
        n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        nz = np.where(np.abs(n[:, 2]) < 1e-18, 1e-18, n[:, 2])
        z = p[:, 0, 2] - ((origins[:, 0] - p[:, 0, 0]) * n[:, 0] + (origins[:, 1] - p[:, 0, 1]) * n[:, 1]) / nz
        return np.clip(z, p[:, :, 2].min(axis=1), p[:, :, 2].max(axis=1))


def voxelise(scene: Scene, grid: Grid, *, control_spheres: bool) -> NDArray[np.int16]:
    """Voxelise the scene in Hounsfield units (K, J, I), with point spread and noise.

    Later parts displace earlier ones.
    """
    K, J, width = grid.shape
    out = np.empty(grid.shape, dtype=np.int16)
    order = {"board": 0, "posts": 1, "specimen": 2, "wires": 3}
    solids = [_Solid(part, grid) for part in sorted(scene.fixed_parts, key=lambda part: order.get(part.name, 9))]
    centres = [*scene.registration_m, *(scene.control_m if control_spheres else ())]
    spheres = apply(inverse(grid.T_world_grid), np.array(centres))
    rng = np.random.default_rng([scene.seed, 0xC702])
    for row in range(0, J, _ROWS):
        first, last = max(0, row - _HALO), min(J, row + _ROWS + _HALO)
        slab = np.full((K, last - first, width), AIR, dtype=np.float32)
        for solid in solids:
            touched = solid.coverage(grid, first, last - first)
            if touched is None:
                continue
            box, inside = touched
            hounsfield: float | Array32 = solid.hounsfield
            if hounsfield == TISSUE:
                origin = np.array([box[2].start, box[1].start + first, box[0].start])
                hounsfield = TISSUE + (BONE - TISSUE) * _bone(scene, grid, origin, inside)
            _fill(slab[box], inside, hounsfield)
        for centre in spheres:
            _add_sphere(slab, grid, first, centre)
        slab = _blurred(slab)[:, row - first : row - first + min(_ROWS, J - row)]
        slab += NOISE_HU * rng.standard_normal(slab.shape, dtype=np.float32)
        out[:, row : row + slab.shape[1]] = np.clip(np.rint(slab), -1024, 3071).astype(np.int16)
    return out


def _fill(slab: Array32, inside: Array32, hounsfield: float | Array32) -> None:
    """Blend a material into the slab by the fraction `inside` of each voxel."""
    slab += inside * (hounsfield - slab)


def _add_sphere(slab: Array32, grid: Grid, first_row: int, centre: Array) -> None:
    """Add a plastic sphere from its signed distance, which is accurate even where its surface grazes a voxel."""
    h = grid.voxel_m
    reach = RADIUS_M + 2 * h
    low = np.maximum(np.floor((centre - reach) / h).astype(int) - [0, first_row, 0], 0)
    high = np.minimum(
        np.ceil((centre + reach) / h).astype(int) + 1 - [0, first_row, 0],
        [slab.shape[2], slab.shape[1], slab.shape[0]],
    )
    if np.any(high <= low):
        return
    x, y, z = (np.arange(low[axis], high[axis]) * h for axis in range(3))
    y = y + first_row * h
    squared = (
        (z - centre[2])[:, None, None] ** 2 + (y - centre[1])[None, :, None] ** 2 + (x - centre[0])[None, None] ** 2
    )
    inside = np.clip(0.5 + (RADIUS_M - np.sqrt(squared)) / h, 0.0, 1.0).astype(np.float32)
    _fill(slab[low[2] : high[2], low[1] : high[1], low[0] : high[0]], inside, PLASTIC)


def _bone(scene: Scene, grid: Grid, origin: NDArray[np.int64], inside: Array32) -> Array32:
    """Bone mask (1: bone, 0: soft tissue) of a box at voxel `origin` (i, j, k)."""
    bone = np.zeros(inside.shape, dtype=np.float32)
    k, j, i = np.nonzero(inside > 0.02)
    if len(k) == 0:
        return bone
    p = apply(grid.T_world_grid, np.asarray((np.stack([i, j, k], axis=1) + origin) * grid.voxel_m, dtype=np.float64))
    anatomy = scene.specimen.anatomy
    near = np.abs(p[:, 1] - anatomy.midline(p[:, 0])) < 0.024
    k, j, i, p = k[near], j[near], i[near], p[near]
    if len(k) == 0:
        return bone
    x, y, z = p.T
    d = y - anatomy.midline(x)
    level = (x - anatomy.phase_m) / 0.034
    between = np.abs(level - np.round(level)) * 0.034  # 0 in the middle of a vertebra, 17 mm at the disc
    body = np.hypot(d / 0.016, (z - 0.016) / 0.012) - 1.0
    solid = (body < 0) & (between < 0.0145)
    raised = anatomy.vertebrae(x, y)
    solid |= (raised > 0.0025) & (z > anatomy.height(x, y) - raised - 0.004)
    bone[k, j, i] = solid
    return bone


def _blurred(slab: Array32) -> Array32:
    """Apply a Gaussian blur of BLUR_VOXELS along all three axes."""
    K, rows, width = slab.shape
    kernel = cv2.getGaussianKernel(2 * _HALO + 1, BLUR_VOXELS, cv2.CV_32F)
    one = np.ones((1, 1), dtype=np.float32)
    border = cv2.BORDER_REPLICATE
    along_k = cv2.sepFilter2D(slab.reshape(K, rows * width), -1, one, kernel, borderType=border)
    along_k = along_k.reshape(K, rows, width)
    for k in range(K):
        along_k[k] = cv2.sepFilter2D(along_k[k], -1, kernel, kernel, borderType=border)
    return np.asarray(along_k, dtype=np.float32)
