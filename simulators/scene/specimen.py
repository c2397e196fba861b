"""The specimen: a piece of a pig's back with a retracted incision and the vertebrae at its bottom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from simulators.geometry import Array, Ints, smoothstep
from simulators.rendering.array_cache import cached
from simulators.scene.parts import Part, grid_faces, join_parts

HALF_LENGTH_M = 0.160
HALF_WIDTH_M = 0.090
HEIGHT_M = 0.080
INCISION_HALF_LENGTH_M = 0.118
INCISION_HALF_WIDTH_M = 0.035
INCISION_DEPTH_M = 0.040
LEVEL_SPACING_M = 0.034


@dataclass(frozen=True, slots=True)
class SmoothNoise:
    """Band-limited noise of unit variance, `shape` wide, with about `cells` features along the first axis.

    What is random is drawn at once, and the field is computed when it is needed.
    """

    shape: tuple[int, int]
    cells: float
    drawn: Array

    @classmethod
    def draw(cls, rng: np.random.Generator, shape: tuple[int, int], cells: float) -> SmoothNoise:
        """Draw one; coarse noise is drawn on a coarse grid."""
        coarse = _coarse(shape, cells)
        return cls(shape, cells, rng.standard_normal(tuple(n // coarse + 4 for n in shape)))

    def field(self) -> Array:
        """Return the noise, of this shape."""
        coarse = _coarse(self.shape, self.cells)
        field = gaussian_filter(self.drawn, _sigma(self.shape, self.cells) / coarse, mode="reflect")
        field /= field.std()
        if coarse == 1:
            return field[: self.shape[0], : self.shape[1]]
        at = np.meshgrid(*(np.arange(n) / coarse + 1 for n in self.shape), indexing="ij")
        return map_coordinates(field, at, order=3, mode="nearest")


def _sigma(shape: tuple[int, int], cells: float) -> float:
    return shape[0] / cells / 2.5


def _coarse(shape: tuple[int, int], cells: float) -> int:
    """Spacing of the grid that the noise is drawn on."""
    return max(1, int(_sigma(shape, cells) / 2))


@dataclass(frozen=True, slots=True)
class Relief:
    """The noise of the fine relief: lumps, the course and size of muscle bundles, the deep surface, and folds."""

    lumps: SmoothNoise
    small_lumps: SmoothNoise
    course: SmoothNoise
    bundles: SmoothNoise
    deep: SmoothNoise
    folds: SmoothNoise

    @classmethod
    def draw(cls, rng: np.random.Generator, shape: tuple[int, int]) -> Relief:
        """Draw all of it, for a grid of this shape."""
        lumps, small_lumps, course, bundles, deep, folds = (
            SmoothNoise.draw(rng, shape, cells) for cells in (7, 22, 9, 45, 70, 14)
        )
        return cls(lumps, small_lumps, course, bundles, deep, folds)

    def drawn(self) -> list[Array]:
        """Return the random numbers, which all of it depends on."""
        each = (self.lumps, self.small_lumps, self.course, self.bundles, self.deep, self.folds)
        return [noise.drawn for noise in each]


@dataclass(frozen=True, slots=True)
class Anatomy:
    """The functions that shape the surface, of x (along the spine) and y (across), in metres."""

    phase_m: float
    bend_m: float
    lean: float

    def midline(self, x: Array) -> Array:
        """y of the spine at x."""
        return self.bend_m * (np.cos(np.pi * x / (2 * HALF_LENGTH_M)) - 0.5) + self.lean * x

    def half_width(self, x: Array) -> Array:
        """Half the width of the body at x."""
        return HALF_WIDTH_M * (1.0 - 0.13 * (x / HALF_LENGTH_M) ** 2 + 0.025 * np.sin(31.0 * x))

    def opening(self, x: Array) -> Array:
        """Half the width of the incision at x, at least 0.1 mm."""
        s = np.clip(1.0 - (x / INCISION_HALF_LENGTH_M) ** 2, 0.0, 1.0)
        return np.maximum(1e-4, INCISION_HALF_WIDTH_M * s**0.62 * (1.0 + 0.07 * np.sin(47.0 * x + 1.0)))

    def incision(self, x: Array, y: Array) -> Array:
        """Distance from the midline as a fraction of the incision's half width; below 1 is inside the incision."""
        return np.abs(y - self.midline(x)) / self.opening(x)

    def vertebrae(self, x: Array, y: Array) -> Array:
        """Height of the bone above the floor of the incision: spinous processes, laminae, facet joints."""
        d = y - self.midline(x)
        level = (x - self.phase_m) / LEVEL_SPACING_M
        s = (level - np.round(level)) * LEVEL_SPACING_M
        between = LEVEL_SPACING_M / 2 - np.abs(s)
        spinous = 0.017 * smoothstep(0.0105, 0.0065, np.abs(s + 0.002)) * smoothstep(0.0048, 0.0022, np.abs(d))
        spinous *= 1.0 + 0.12 * np.cos(300.0 * s)
        lamina = 0.0065 * smoothstep(0.0150, 0.0070, np.abs(s)) * np.exp(-((np.abs(d) / 0.0125) ** 4))
        facet = 0.0085 * np.exp(-(((np.abs(d) - 0.0150) / 0.0042) ** 2) - (between / 0.0055) ** 2)
        return np.maximum(np.maximum(spinous, lamina), facet)

    def height(self, x: Array, y: Array) -> Array:
        """Height of the surface above the board, without the fine relief."""
        w = self.half_width(x)
        crest = HEIGHT_M * (1.0 - 0.10 * (x / HALF_LENGTH_M) ** 4)
        body = crest * np.clip(1.0 - np.abs(y / w) ** 2.8, 0.0, 1.0) ** 0.55
        t = self.incision(x, y)
        # The depth fades towards the incision's ends; the retraction rolls up its lip.
        ramp = smoothstep(0.0, 0.7, 1.0 - np.abs(x / INCISION_HALF_LENGTH_M))
        lip = 0.0045 * np.exp(-(((t - 1.13) / 0.13) ** 2)) * ramp
        inside = smoothstep(1.03, 0.68, t)
        floor = INCISION_DEPTH_M * ramp - self.vertebrae(x, y) * smoothstep(0.1, 0.6, ramp)
        return body + lip - inside * floor


@dataclass(frozen=True, slots=True)
class Specimen:
    """The surface as a grid (n_x, n_y, 3) in world metres, closed by a base and two cut ends."""

    anatomy: Anatomy
    grid_m: Array

    @classmethod
    def generate(cls, rng: np.random.Generator, n_x: int = 320, n_y: int = 220) -> Specimen:
        """Generate a specimen of about 2 n_x n_y faces; deterministic for a given generator state."""
        anatomy = Anatomy(
            phase_m=float(rng.uniform(-0.008, 0.008)),
            bend_m=float(rng.uniform(-0.006, 0.006)),
            lean=float(rng.uniform(-0.02, 0.02)),
        )
        relief = Relief.draw(rng, (n_x, n_y))
        (grid,) = cached(
            "specimen",
            [anatomy, n_x, n_y, *relief.drawn()],
            lambda: [_with_relief(relief, anatomy, _smooth(anatomy, n_x, n_y))],
        )
        return cls(anatomy, grid)

    def part(self) -> Part:
        """Return the closed solid, with its top mapped to uv (0…1 along x, 0…1 along the arc)."""
        n_x, n_y = self.grid_m.shape[:2]
        u, v = np.meshgrid((np.arange(n_x) + 0.5) / n_x, (np.arange(n_y) + 0.5) / n_y, indexing="ij")
        vertices = self.grid_m.reshape(-1, 3)
        top = Part("top", "specimen", vertices, grid_faces(n_x, n_y), np.stack([u, v], axis=-1).reshape(-1, 2))
        index = np.arange(n_x * n_y, dtype=np.int64).reshape(n_x, n_y)
        ends = [self._end(index[0, ::-1], u=0.004), self._end(index[-1], u=0.996)]
        # The base repeats the rim's vertices; it is never visible, so its texture does not matter.
        left, right = index[:, 0], index[:, -1]
        a, b, c, d = left[:-1], left[1:], right[1:], right[:-1]
        base = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])
        closed = Part(top.name, top.material, top.vertices_m, np.concatenate([top.faces, base]), top.uv)
        return join_parts("specimen", "specimen", [closed, *ends])

    def _end(self, rim: Ints, u: float) -> Part:
        """A cut end as rings from the rim to its centre, because light is stored at vertices."""
        p = self.grid_m.reshape(-1, 3)[np.append(rim, rim[0])]
        middle = (p[0] + p[-2]) / 2 + [0.0, 0.0, 0.02]
        fractions = np.linspace(0.0, 1.0, 24)
        vertices = p[None] + fractions[:, None, None] * (middle - p)[None]
        uv = np.stack(
            np.broadcast_arrays(np.abs(u - 0.09 * fractions)[:, None], np.linspace(0.02, 0.98, len(p))[None]), axis=-1
        )
        return Part("end", "specimen", vertices.reshape(-1, 3), grid_faces(len(fractions), len(p)), uv.reshape(-1, 2))


def _smooth(anatomy: Anatomy, n_x: int, n_y: int) -> Array:
    """The grid (n_x, n_y, 3) without the fine relief."""
    x = np.linspace(-HALF_LENGTH_M, HALF_LENGTH_M, n_x)
    fine = np.linspace(-1.0, 1.0, 8 * n_y)
    grid = np.empty((n_x, n_y, 3))
    for i, xi in enumerate(x):
        # Vertices at equal arc length of the cross-section, so that steep walls are meshed as finely as the top.
        y = fine * anatomy.half_width(np.full(1, xi))
        z = anatomy.height(np.full_like(y, xi), y)
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(y), np.diff(z)))])
        yi = np.interp(np.linspace(0.0, arc[-1], n_y), arc, y)
        grid[i] = np.stack([np.full(n_y, xi), yi, anatomy.height(np.full(n_y, xi), yi)], axis=1)
    return grid


def _with_relief(relief: Relief, anatomy: Anatomy, grid: Array) -> Array:
    """Displace the grid along z, and the incision's walls sideways, by lumps, muscle bundles and skin folds."""
    x, y, z = (grid[..., k] for k in range(3))
    t = anatomy.incision(x, y)
    rim = np.clip(z / 0.02, 0.0, 1.0)  # zero where the specimen touches the board
    ends = smoothstep(0.0, 0.02, HALF_LENGTH_M - np.abs(x)) * 0.8 + 0.2
    lumps = 0.0022 * relief.lumps.field() + 0.0007 * relief.small_lumps.field()
    wall = smoothstep(1.15, 0.95, t) * smoothstep(0.45, 0.62, t)
    # Muscle bundles run along the wall, slightly oblique.
    phase = 900.0 * z + 60.0 * x + 2.0 * relief.course.field()
    bundles = relief.bundles.field() * 0.0008 + 0.0010 * np.sin(phase)
    deep = smoothstep(0.7, 0.5, t)
    z = z + rim * ends * (lumps * (1.0 - 0.6 * deep) + 0.0006 * deep * relief.deep.field())
    side = np.sign(y - anatomy.midline(x))
    y = y - side * wall * ends * (bundles + 0.0025 * relief.folds.field())
    return np.stack([x, y, np.maximum(z, 0.0)], axis=-1)
