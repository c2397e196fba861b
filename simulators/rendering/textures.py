"""Textures of the scene: linear albedo with shaded relief, and the gloss of wet tissue."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from simulators.geometry import Array, Array32, Bytes
from simulators.rendering.noise import Noise, mixed, ramp
from simulators.scene.specimen import HALF_LENGTH_M
from simulators.scene.world import BOARD_HALF_M, Scene
from simulators.units import metres, mm

DRAPE_HALF_M = 1.3
_DRAPE_CORE = 0.30  # the centre ± this fraction of the texture covers ± DRAPE_CORE_M at full resolution
DRAPE_CORE_M = 0.42


@dataclass(frozen=True, slots=True)
class Texture:
    """A texture of texels (H, W, 4) float32, linear albedo and gloss, with the size of a texel in metres.

    Rows run along u, columns along v.
    """

    texels: Array32
    texel_m: float


def drape_coordinate(metres: Array) -> Array:
    """Texture coordinate 0…1 of a position on the drape: uniform in the centre, coarser outside."""
    a = np.abs(metres)
    slope = (0.5 - _DRAPE_CORE) / (DRAPE_HALF_M - DRAPE_CORE_M)
    t = np.where(a < DRAPE_CORE_M, a * _DRAPE_CORE / DRAPE_CORE_M, _DRAPE_CORE + (a - DRAPE_CORE_M) * slope)
    return 0.5 + np.sign(metres) * t


@dataclass(frozen=True, slots=True)
class _Grain:
    """Noise (H, W) that several tissues share, from coarse to fine, and its source."""

    noise: Noise
    wobble: Array32
    fine: Array32
    pores: Array32
    speckle: Array32

    @classmethod
    def of(cls, noise: Noise) -> _Grain:
        return cls(
            noise,
            wobble=noise.octaves(1, 0.012, 5),
            fine=noise.octaves(2, 0.0016, 4, 0.75),
            pores=noise.field(7, 0.0011),
            speckle=noise.field(3, 0.0005),
        )

    def coloured(self, colour: tuple[float, float, float]) -> Array32:
        """(H, W, 3) of one colour."""
        out = np.empty((*self.noise.shape, 3), dtype=np.float32)
        out[:] = colour
        return out


def specimen_texture(scene: Scene, size: int) -> Texture:
    """Skin, fat, muscle, bone and blood, placed by the anatomy's coordinates."""
    anatomy = scene.specimen.anatomy
    length, arc = 2 * HALF_LENGTH_M, 0.30
    noise = Noise(scene.seed * 7 + 1, (size, size), (length, arc))
    grid = cv2.resize(scene.specimen.grid_m, (size, size), interpolation=cv2.INTER_LINEAR)
    place = np.asarray(grid, dtype=np.float64)
    x, y = place[..., 0], place[..., 1]
    grain = _Grain.of(noise)
    t = np.asarray(anatomy.incision(x, y), dtype=np.float32) + np.float32(0.02) * grain.wobble
    fibres = noise.octaves(12, 0.0016, 4, 0.8, stretch=14.0)
    skin, fat, muscle, bone = _skin(scene, grain), _fat(grain), _muscle(grain, fibres), _bone(grain)

    height = np.asarray(anatomy.vertebrae(x, y), dtype=np.float32)
    is_bone = ramp(0.0032, 0.0058, height + np.float32(0.0016) * grain.wobble)
    colour = muscle + (skin - muscle) * ramp(1.00, 1.06, t)[..., None]
    band = ramp(0.86, 0.94, t) * (1 - ramp(1.03, 1.08, t))
    colour += (fat - colour) * band[..., None]
    colour += (bone - colour) * (is_bone * (1 - ramp(0.6, 0.75, t)))[..., None]
    pool = ramp(0.3, 1.3, noise.octaves(17, 0.014, 5)) * (1 - ramp(0.65, 0.9, t)) * (1 - 0.8 * is_bone)
    colour = mixed(colour, (0.13, 0.008, 0.008), 0.85 * pool)
    # The cut ends (columns of texels next to u = 0 and 1) show muscle, fat and skin as the incision does.
    end = np.minimum(np.arange(size), np.arange(size)[::-1])[:, None] < 0.0015 * size
    colour = np.where(end[..., None], muscle, colour)
    uneven = np.where(t < 1.0, 1.8 * fibres * (1 - 0.8 * is_bone), grain.pores)
    relief = 0.00016 * grain.fine + 0.00035 * grain.wobble + 0.00012 * uneven
    colour *= _relief_shading(relief.astype(np.float32), length / size, arc / size)[..., None]
    gloss = np.where(t > 1.05, 0.10, np.where(t > 0.9, 0.5, 0.75)) + 0.5 * pool
    gloss = gloss * (0.45 + 0.55 * ramp(-0.6, 1.2, noise.octaves(18, 0.003, 4)))
    return Texture(_packed(colour, gloss.astype(np.float32)), length / size)


def _skin(scene: Scene, grain: _Grain) -> Array32:
    """Mottled skin with pores, hair, inspection stamps and smears of blood (H, W, 3)."""
    noise, size = grain.noise, grain.noise.shape[0]
    skin = grain.coloured((0.66, 0.43, 0.34))
    blotch = noise.octaves(4, 0.03, 5)
    skin *= (1.0 + 0.10 * blotch + 0.09 * grain.fine + 0.09 * grain.speckle)[..., None]
    skin = mixed(skin, (0.55, 0.22, 0.18), 0.5 * ramp(0.5, 1.8, noise.octaves(5, 0.018, 5)))
    skin = mixed(skin, (0.42, 0.27, 0.20), 0.55 * ramp(0.9, 1.5, noise.octaves(6, 0.004, 3)))
    skin = mixed(skin, (0.30, 0.15, 0.10), 0.55 * ramp(1.3, 2.2, grain.pores))
    skin = mixed(skin, (0.20, 0.13, 0.09), _strokes(noise, 8, 5200, 0.004, 0.010, size))
    skin = mixed(skin, (0.10, 0.10, 0.32), 0.7 * _stamp(size, scene.seed) * ramp(-1.0, 0.6, grain.fine))
    return mixed(skin, (0.28, 0.02, 0.02), 0.8 * ramp(1.2, 1.7, noise.octaves(9, 0.022, 6)))


def _fat(grain: _Grain) -> Array32:
    """Yellow fat with blood in it (H, W, 3)."""
    fat = grain.coloured((0.74, 0.58, 0.38))
    fat *= (1.0 + 0.16 * grain.noise.octaves(10, 0.005, 4) + 0.08 * grain.speckle)[..., None]
    return mixed(fat, (0.55, 0.12, 0.09), 0.7 * ramp(0.5, 1.4, grain.noise.octaves(11, 0.006, 4)))


def _muscle(grain: _Grain, fibres: Array32) -> Array32:
    """Colours (H, W, 3) of red muscle with tendons and fat; `fibres` (H, W) is its texture."""
    noise = grain.noise
    muscle = grain.coloured((0.34, 0.065, 0.05))
    muscle *= (1.0 + 0.34 * fibres + 0.18 * grain.fine + 0.08 * grain.speckle)[..., None]
    muscle = mixed(muscle, (0.66, 0.50, 0.42), 0.65 * ramp(1.4, 2.2, noise.octaves(13, 0.0030, 3, 0.7, stretch=9.0)))
    return mixed(muscle, (0.70, 0.56, 0.36), 0.8 * ramp(1.3, 1.8, noise.octaves(14, 0.008, 5, 0.7, stretch=2.0)))


def _bone(grain: _Grain) -> Array32:
    """Colours (H, W, 3) of bone with blood on it and pores."""
    bone = grain.coloured((0.66, 0.50, 0.36))
    bone *= (1.0 + 0.10 * grain.fine + 0.07 * grain.speckle + 0.08 * grain.wobble)[..., None]
    bone = mixed(bone, (0.45, 0.10, 0.08), 0.75 * ramp(0.3, 1.3, grain.noise.octaves(15, 0.007, 5)))
    return mixed(bone, (0.20, 0.03, 0.03), 0.8 * ramp(1.4, 2.0, grain.noise.field(16, 0.0016)))


def board_texture(scene: Scene, size: int) -> Texture:
    """Planks with grain and knots, printed labels, rulers, stains."""
    length, width = 2 * BOARD_HALF_M[0], 2 * BOARD_HALF_M[1]
    noise = Noise(scene.seed * 7 + 2, (size, size), (length, width))
    v = np.linspace(0.0, width, size, dtype=np.float32)[None, :]
    warp = noise.octaves(1, 0.05, 3, 0.5, stretch=4.0) * np.float32(0.006)
    rings = np.sin((v + warp * 3) * np.float32(2 * np.pi / 0.0085)) + 0.6 * np.sin(
        (v + warp * 5) * np.float32(1700.0)
    )
    grain = noise.octaves(2, 0.0011, 4, 0.8, stretch=22.0)
    colour = np.empty((size, size, 3), dtype=np.float32)
    colour[:] = (0.40, 0.235, 0.115)
    plank = np.floor(v / np.float32(width / 4))
    tone = 1.0 + 0.10 * np.sin(plank * 2.4 + scene.seed)
    colour *= (tone * (1.0 + 0.10 * rings + 0.17 * grain + 0.07 * noise.octaves(3, 0.0015, 2)))[..., None]
    colour = mixed(colour, (0.12, 0.06, 0.03), 0.8 * ramp(1.6, 2.2, noise.octaves(4, 0.0016, 3, 0.8, stretch=9.0)))
    colour = mixed(colour, (0.16, 0.02, 0.015), 0.7 * ramp(1.3, 1.7, noise.octaves(5, 0.03, 6)))
    colour = mixed(colour, (0.62, 0.46, 0.28), 0.5 * ramp(1.0, 1.8, noise.octaves(6, 0.020, 5)))
    ink, paper = _labels(size, (length, width), scene.seed)
    colour = mixed(colour, (0.70, 0.68, 0.62), 0.92 * paper)
    colour = mixed(colour, (0.035, 0.035, 0.04), 0.9 * ink)
    colour *= (1.0 - 0.55 * ramp(0.0008, 0.0, np.abs((v % np.float32(width / 4)) - np.float32(width / 8))))[..., None]
    colour *= (1.0 + 0.05 * noise.field(7, 0.0006))[..., None]
    return Texture(_packed(colour, np.full((size, size), 0.04, np.float32)), length / size)


def drape_texture(scene: Scene, size: int) -> Texture:
    """Blue-green surgical drape: weave, lint, creases, stains and the manufacturer's print."""
    extent = DRAPE_CORE_M / _DRAPE_CORE
    noise = Noise(scene.seed * 7 + 3, (size, size), (extent, extent))
    colour = np.empty((size, size, 3), dtype=np.float32)
    colour[:] = (0.055, 0.20, 0.24)
    warp_threads, weft = (
        noise.octaves(1, 0.0012, 3, 0.8, stretch=9.0),
        noise.octaves(2, 0.0012, 3, 0.8, stretch=9.0).T,
    )
    lint = noise.octaves(3, 0.0016, 3, 0.85)
    colour *= (1.0 + 0.13 * warp_threads + 0.13 * weft + 0.15 * lint + 0.08 * noise.octaves(4, 0.06, 5))[..., None]
    colour = mixed(colour, (0.45, 0.52, 0.55), 0.6 * _strokes(noise, 5, 7000, 0.003, 0.012, size))
    colour = mixed(colour, (0.015, 0.06, 0.085), 0.6 * ramp(1.2, 1.8, noise.octaves(6, 0.011, 5)))
    colour = mixed(colour, (0.16, 0.015, 0.012), 0.85 * ramp(1.5, 1.75, noise.octaves(7, 0.035, 6)))
    colour = mixed(colour, (0.50, 0.55, 0.55), 0.75 * _print(size, scene.seed))
    relief = 0.0016 * noise.octaves(8, 0.045, 4, 0.45)
    colour *= _relief_shading(relief.astype(np.float32), extent / size, extent / size)[..., None]
    return Texture(_packed(colour, np.full((size, size), 0.0, np.float32)), extent / size)


def post_texture(scene: Scene, size: int) -> Texture:
    """Turned beech: u runs around a post, v along the posts one after another."""
    noise = Noise(scene.seed * 7 + 4, (size, size), (0.0314, 0.6))
    colour = np.empty((size, size, 3), dtype=np.float32)
    colour[:] = (0.50, 0.34, 0.19)
    colour *= (1.0 + 0.2 * noise.octaves(1, 0.004, 4, 0.8, stretch=0.15) + 0.1 * noise.octaves(2, 0.002, 3))[
        ..., None
    ]
    return Texture(_packed(colour, np.full((size, size), 0.05, np.float32)), 0.6 / size)


def steel_texture() -> Texture:
    """Bright metal."""
    colour = np.full((8, 8, 3), 0.34, dtype=np.float32)
    return Texture(_packed(colour, np.full((8, 8), 1.0, np.float32)), 0.01)


def _packed(colour: Array32, gloss: Array32) -> Array32:
    out = np.empty((*gloss.shape, 4), dtype=np.float32)
    np.clip(colour, 0.004, 0.9, out=out[..., :3])
    np.clip(gloss, 0.0, 1.0, out=out[..., 3])
    return out


def _relief_shading(height_m: Array32, du_m: float, dv_m: float) -> Array32:
    """Shading factor of a relief (H, W) in metres under a lamp high at one side: N'·L / N·L."""
    slope_u = np.gradient(height_m, axis=0) / np.float32(du_m)
    slope_v = np.gradient(height_m, axis=1) / np.float32(dv_m)
    return np.clip(1.0 - 0.45 * slope_u + 0.6 * slope_v, 0.45, 1.6).astype(np.float32)


def _strokes(noise: Noise, name: int, count: int, low_m: float, high_m: float, size: int) -> Array32:
    """Short curved hairs (H, W), 0..1."""
    rng = noise.rng(name)
    start = rng.uniform(0.0, 1.0, (count, 2))
    angle = rng.normal(0.6, 0.5, count)
    length = rng.uniform(low_m, high_m, count) / noise.extent_m[0]
    bend = rng.normal(0.0, 0.35, count)
    canvas = np.zeros((size, size), dtype=np.uint8)
    steps = np.linspace(0.0, 1.0, 6)
    for p, a, n, b in zip(start, angle, length, bend, strict=True):
        direction = a + b * steps
        points = p + np.cumsum(np.stack([np.cos(direction), np.sin(direction)], axis=1), axis=0) * n / 6
        fixed = np.round(points[:, ::-1] * size * 16).astype(np.int32)
        cv2.polylines(canvas, [fixed], False, 255, max(1, size // 2048), cv2.LINE_AA, 4)
    return canvas.astype(np.float32) / np.float32(255.0)


def _text(canvas: Bytes, words: str, at: tuple[float, float], height: float) -> None:
    """Draw words with their baseline starting `at` (column, row); `at` and `height` are fractions of the size."""
    size = canvas.shape[0]
    scale = height * size / 22.0
    thick = max(1, round(0.13 * height * size))
    origin = (round(at[0] * size), round(at[1] * size))
    cv2.putText(canvas, words, origin, cv2.FONT_HERSHEY_DUPLEX, scale, 255, thick, cv2.LINE_AA)


def _as_seen(canvas: Bytes) -> Array32:
    """Rotate a canvas drawn with x to the right and y down into rows along u = +x and columns along v = +y."""
    return np.ascontiguousarray(canvas[::-1].T).astype(np.float32) / np.float32(255.0)


def _stamp(size: int, seed: int) -> Array32:
    """The oval stamps of the meat inspection on the skin (H, W), 0…1."""
    canvas = np.zeros((size, size), dtype=np.uint8)
    thick = max(1, size // 500)
    for column, row, tilt in ((0.20, 0.17, 12.0), (0.72, 0.85, -20.0), (0.50, 0.12, 4.0)):
        centre = (round(column * size), round(row * size))
        cv2.ellipse(canvas, centre, (round(0.075 * size), round(0.045 * size)), tilt, 0, 360, 255, thick, cv2.LINE_AA)
        _text(canvas, f"CH {seed % 900 + 100}", (column - 0.055, row - 0.004), 0.022)
        _text(canvas, "INSPECTED", (column - 0.058, row + 0.022), 0.013)
    return _as_seen(canvas)


_LABELS = (
    ("SPINE LAB", 0.05, 0.10),
    ("SPECIMEN {seed:04d}", 0.42, 0.07),
    ("CRANIAL >", 0.74, 0.12),
    ("< CAUDAL", 0.04, 0.90),
    ("DO NOT MOVE", 0.36, 0.925),
    ("OR-2  L/R", 0.68, 0.90),
    ("THIS SIDE UP", 0.015, 0.40),
    ("SN 30-15", 0.90, 0.66),
)  # text, and column and row of its beginning as fractions of the board


def _labels(size: int, extent_m: tuple[float, float], seed: int) -> tuple[Array32, Array32]:
    """Ink and paper (H, W), 0…1, of rulers along the board's rim and of labels."""
    ink, paper = np.zeros((size, size), dtype=np.uint8), np.zeros((size, size), dtype=np.uint8)
    for at_mm in range(10, round(mm(extent_m[0])) - 10):
        at = round(metres(at_mm) / extent_m[0] * size)
        long = 0.022 if at_mm % 10 == 0 else 0.016 if at_mm % 5 == 0 else 0.010
        cv2.line(ink, (at, round(0.985 * size)), (at, round((0.985 - long) * size)), 255, max(1, size // 1800))
        if at_mm % 10 == 0:
            _text(ink, str(at_mm // 10), (at / size - 0.006, 0.955), 0.010)
    rng = np.random.default_rng([seed, 5])
    for text, column, row in _LABELS:
        word = text.format(seed=seed)
        wide = 0.016 * len(word) + 0.02
        a = (round((column - 0.01) * size), round((row - 0.035) * size))
        b = (round((column - 0.01 + wide) * size), round((row + 0.018) * size))
        cv2.rectangle(paper, a, b, 255, -1)
        _text(ink, word, (column, row), 0.018)
        bars = rng.integers(1, 5, 40)
        for k, bar in enumerate(np.cumsum(bars)):
            left = (column + 0.0016 * float(bar)) * size
            if k % 2 == 0 and left < b[0] - 0.01 * size:
                corner = (round(left), round((row + 0.006) * size))
                cv2.rectangle(ink, corner, (round(left + 0.0012 * size), round((row + 0.014) * size)), 255, -1)
    return _as_seen(ink), _as_seen(paper)


def _print(size: int, seed: int) -> Array32:
    """The drape's printed text (H, W), 0…1."""
    canvas = np.zeros((size, size), dtype=np.uint8)
    rng = np.random.default_rng([seed, 6])
    for k, row in enumerate(np.arange(0.03, 1.0, 0.075)):
        column = float(rng.uniform(-0.05, 0.05))
        while column < 1.0:
            words = f"STERILE DRAPE {rng.integers(100, 999)}" if k % 2 else f"LOT {rng.integers(10000, 99999)}  3-PLY"
            _text(canvas, words, (column, float(row + rng.uniform(-0.006, 0.006))), 0.011)
            column += float(rng.uniform(0.22, 0.34))
    return _as_seen(canvas)
