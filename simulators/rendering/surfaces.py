"""The scene's surfaces for the renderer: one mesh with filtered textures and light at the vertices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import cv2
import numpy as np

from simulators.geometry import Array, Array32, Bools, Bytes, Ints
from simulators.rendering.array_cache import cached
from simulators.rendering.lighting import Caster, blocked_rays, vertex_light
from simulators.rendering.noise import Noise
from simulators.rendering.textures import (
    DRAPE_HALF_M,
    Texture,
    board_texture,
    drape_coordinate,
    drape_texture,
    post_texture,
    specimen_texture,
    steel_texture,
)
from simulators.scene.parts import Part, grid_faces, join_parts, sphere_mesh, vertex_normals
from simulators.scene.world import BOARD_THICKNESS_M, RADIUS_M, Scene

MATERIALS = ("specimen", "board", "post", "steel", "drape")
SPECIMEN, STEEL = 0, 3
LAMP_COLOUR = np.array([0.80, 0.755, 0.69], dtype=np.float32)
ROOM_COLOUR = np.array([0.185, 0.205, 0.235], dtype=np.float32)
SPRAY_ALBEDO, SPRAY_COVER = 0.74, 0.62
_REMAP_COLUMNS = 4096
Weights = Sequence[Array32]
Numbers = TypeVar("Numbers", Array32, Ints)


@dataclass(frozen=True, slots=True)
class Shaded:
    """Shading of ray hits: linear colour (N, 3), distance in lengths of the ray (N,), material (N,; 255 for none)."""

    colour: Array32
    depth: Array32
    material: Bytes


class MipMap:
    """A texture at successively halved sizes, sampled at the level that fits the pixel's footprint."""

    def __init__(self, texture: Texture) -> None:
        self.texel_m = texture.texel_m
        self._levels = [texture.texels]
        while min(self._levels[-1].shape[:2]) > 16:
            h, w = self._levels[-1].shape[:2]
            half = cv2.resize(self._levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(half, dtype=np.float32))

    def sample(self, uv: Array32, footprint_m: Array32) -> Array32:
        """Sample the texture at uv (N, 2) for pixels that cover footprint_m (N,); returns (N, 4)."""
        if len(self._levels) == 1:
            return _bilinear(self._levels[0], uv)
        level = np.log2(np.maximum(footprint_m / np.float32(self.texel_m), 1.0))
        level = np.minimum(level, np.float32(len(self._levels) - 1.001))
        low = level.astype(np.int32)
        out = np.empty((len(uv), 4), dtype=np.float32)
        for k in np.unique(low):
            at = np.flatnonzero(low == k)
            uv_at = _rows(uv, at)
            fraction = _rows(level, at) - np.float32(k)
            fine, mixed = (_bilinear(self._levels[k + j], uv_at) for j in (0, 1))
            mixed -= fine
            _scale(mixed, fraction)
            mixed += fine
            if len(at) == len(uv):
                return mixed
            out[at] = mixed
        return out


def _bilinear(texels: Array32, uv: Array32) -> Array32:
    h, w = texels.shape[:2]
    n = len(uv)
    # remap takes images of at most 32767 rows and columns: fold the list into several rows.
    columns = min(n, _REMAP_COLUMNS)
    padded = -(-n // columns) * columns
    row, column = np.zeros(padded, dtype=np.float32), np.zeros(padded, dtype=np.float32)
    row[:n] = uv[:, 0] * np.float32(h) - np.float32(0.5)
    column[:n] = uv[:, 1] * np.float32(w) - np.float32(0.5)
    shape = (padded // columns, columns)
    out = cv2.remap(
        texels, column.reshape(shape), row.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(out, dtype=np.float32).reshape(padded, -1)[:n]


class Surfaces:
    """All surfaces except the spheres' faces and the calibration board."""

    def __init__(self, scene: Scene, texture_size: int) -> None:
        self.scene = scene
        parts = [*scene.fixed_parts, drape_part(scene)]
        order = {part.material: part for part in parts}
        parts = [order[name] for name in MATERIALS]
        offsets = np.cumsum([0, *(len(part.vertices_m) for part in parts[:-1])])
        self._vertices = np.concatenate([part.vertices_m for part in parts])
        self._faces = np.concatenate([part.faces + o for part, o in zip(parts, offsets, strict=True)])
        self._normals = np.concatenate([vertex_normals(part.vertices_m, part.faces) for part in parts])
        self._normals32 = self._normals.astype(np.float32)
        self._uv = np.concatenate([part.uv for part in parts]).astype(np.float32)
        self._material = np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part.faces) for part in parts])
        p = self._vertices[self._faces]
        n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        self._face_normal = (n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)).astype(np.float32)
        self._caster = Caster(self._vertices, self._faces)
        self._parts = parts
        self._light: dict[bool, Array32] = {}
        painted = (scene.seed, scene.specimen.anatomy, scene.specimen.grid_m, texture_size)
        *texels, texel_m, self._ripple = cached("textures", painted, lambda: _painted(scene, texture_size))
        self._textures = [MipMap(Texture(*texture)) for texture in zip(texels, texel_m.tolist(), strict=True)]

    def light(self, control: bool) -> Array32:
        """Light of lamp and room at the vertices (V, 2), with the shadows of the spheres that are present."""
        if control not in self._light:
            scene = self.scene
            spheres = (scene.registration_m, scene.control_m if control else None)
            lit = (self._vertices, self._normals, self._faces, *spheres, scene.lamp_m)
            (self._light[control],) = cached("light", lit, lambda: [self._lit(control)])
        return self._light[control]

    def _lit(self, control: bool) -> Array32:
        blocked = self._shadow
        if control:
            blocked = blocked | self._blocked_by(_spheres(self.scene.control_m))
        return vertex_light(blocked, self._vertices, self._normals, self.scene.lamp_m)

    @cached_property
    def _shadow(self) -> Bools:
        """Occlusion without the control spheres; theirs is added to it."""
        return self._blocked_by([*self._parts, *_spheres(self.scene.registration_m)])

    def _blocked_by(self, parts: list[Part]) -> Bools:
        solid = join_parts("shadow", "any", parts)
        return blocked_rays(Caster(solid.vertices_m, solid.faces), self._vertices, self._normals, self.scene.lamp_m)

    def shade(self, eye: Array, directions: Array32, pixel_rad: float, *, control: bool, spray: bool) -> Shaded:
        """Cast rays (N, 3) of unit depth along the camera axis from `eye` (world).

        `pixel_rad` is the angle of a pixel.
        """
        n = len(directions)
        start = np.ascontiguousarray(np.broadcast_to(eye.astype(np.float32), (n, 3)))
        face, depth, u, v = self._caster.first(start, directions)
        colour = np.full((n, 3), 0.012, dtype=np.float32)
        material = np.full(n, 255, dtype=np.uint8)
        hit = np.flatnonzero(face >= 0)
        depth = np.where(face >= 0, depth, np.float32(1e3)).astype(np.float32)
        if len(hit) == 0:
            return Shaded(colour, depth, material)
        f, u, v = _rows(face, hit), _rows(u, hit), _rows(v, hit)
        of_hit = self._material.take(f)
        material[hit] = of_hit
        corners = self._faces.take(f, axis=0)
        weights = (1.0 - u - v, u, v)
        light = self._light_at(corners, weights, control)
        uv = _interpolated(self._uv, corners, weights)
        ray, far = _rows(directions, hit), _rows(depth, hit)
        length = np.sqrt(np.einsum("ij,ij->i", ray, ray))
        cosine = np.abs(np.einsum("ij,ij->i", ray, self._face_normal.take(f, axis=0))) / length
        # Between the footprint's two axes: sharper than isotropic filtering, and without aliasing.
        footprint = np.float32(pixel_rad) * far * np.minimum(1.0 / np.sqrt(np.maximum(cosine, 0.06)), 3.0)
        texel = self._sampled(of_hit, uv, footprint.astype(np.float32))
        if spray:
            on = of_hit == SPECIMEN
            texel[on, :3] += np.float32(SPRAY_COVER) * (np.float32(SPRAY_ALBEDO) - texel[on, :3])
            texel[on, 3] = 0.0
        lamp, room = np.ascontiguousarray(light[:, 0]), np.ascontiguousarray(light[:, 1])
        shaded = np.empty((len(hit), 3), dtype=np.float32)
        for k in range(3):
            shaded[:, k] = texel[:, k] * (lamp * LAMP_COLOUR[k] + room * ROOM_COLOUR[k])
        self._add_gloss(shaded, texel[:, 3], eye, ray, far, corners, weights, uv, lamp)
        if len(hit) == n:
            return Shaded(shaded, depth, material)
        colour[hit] = shaded
        return Shaded(colour, depth, material)

    def _light_at(self, corners: Ints, weights: Weights, control: bool) -> Array32:
        return _interpolated(self.light(control), corners, weights)

    def _sampled(self, material: Bytes, uv: Array32, footprint_m: Array32) -> Array32:
        texel = np.empty((len(uv), 4), dtype=np.float32)
        for index, texture in enumerate(self._textures):
            at = np.flatnonzero(material == index)
            if len(at):
                texel[at] = texture.sample(_rows(uv, at), _rows(footprint_m, at))
        return texel

    def _add_gloss(
        self,
        shaded: Array32,
        gloss: Array32,
        eye: Array,
        ray: Array32,
        depth: Array32,
        corners: Ints,
        weights: Weights,
        uv: Array32,
        lamp: Array32,
    ) -> None:
        """Add specular highlights of the lamp (Blinn-Phong) on wet tissue and steel."""
        at = np.flatnonzero((gloss > 0.12) & (lamp > 0.02))
        if len(at) == 0:
            return
        gloss, ray, depth, lamp = (values.take(at, axis=0) for values in (gloss, ray, depth, lamp))
        normal = _interpolated(self._normals32, corners.take(at, axis=0), [weight.take(at) for weight in weights])
        # Mirrored repetition, because the ripples do not tile seamlessly.
        tiled = np.abs((uv.take(at, axis=0) * np.float32(16.0)) % np.float32(2.0) - np.float32(1.0))
        normal[:, :2] += _bilinear(self._ripple, tiled)[:, :2]
        _normalise(normal)
        place = eye.astype(np.float32) + ray * depth[:, None]
        to_lamp = self.scene.lamp_m.astype(np.float32) - place
        _normalise(to_lamp)
        half = ray.copy()
        _normalise(half)
        half = to_lamp - half
        _normalise(half)
        s = np.clip(np.einsum("ij,ij->i", normal, half), 0.0, 1.0) ** 48 * gloss * np.minimum(lamp, 1.0)
        shaded[at] += np.float32(0.55) * s[:, None] * LAMP_COLOUR


def _painted(scene: Scene, size: int) -> list[Array32]:
    """The texels of all materials' textures, the sizes of their texels in metres, and the ripples of wet tissue."""
    textures = (
        specimen_texture(scene, size),
        board_texture(scene, size),
        post_texture(scene, max(64, size // 4)),
        steel_texture(),
        drape_texture(scene, size),
    )
    ripple = Noise(scene.seed, (512, 512), (0.02, 0.02))
    slopes = np.stack([ripple.octaves(k, 0.004, 3) for k in (1, 2)], axis=-1)
    texel_m = np.array([texture.texel_m for texture in textures])
    return [*(texture.texels for texture in textures), texel_m, np.ascontiguousarray(slopes * np.float32(0.16))]


def _interpolated(values: Array32, corners: Ints, weights: Weights) -> Array32:
    """Interpolate values (V, k) at corners (N, 3) with barycentric weights, three of (N,)."""
    out = values.take(corners[:, 0], axis=0)
    _scale(out, weights[0])
    for k in (1, 2):
        more = values.take(corners[:, k], axis=0)
        _scale(more, weights[k])
        out += more
    return out


def _rows(values: Numbers, at: Ints) -> Numbers:
    """The rows `at`, in rising order, of values (N, ...): the values themselves if these are all."""
    return values if len(at) == len(values) else values.take(at, axis=0)


# NumPy takes several times as long where the inner loop runs over two or three columns only.
def _scale(rows: Array32, by: Array32) -> None:
    """Multiply each of the rows (N, k) by its number (N,), in place."""
    for k in range(rows.shape[1]):
        rows[:, k] *= by


def _normalise(rows: Array32) -> None:
    """Divide each of the rows (N, 3) by its length, in place."""
    x, y, z = rows.T
    length = np.sqrt(x * x + y * y + z * z)
    for k in range(3):
        rows[:, k] /= length


def drape_part(scene: Scene) -> Part:
    """Build the draped table under the board: a gently creased sheet, finer in its visible centre."""
    core = np.linspace(-0.55, 0.55, 181)
    outside = np.linspace(0.55, DRAPE_HALF_M, 26)[1:]
    axis = np.concatenate([-outside[::-1], core, outside])
    gx, gy = np.meshgrid(axis, axis, indexing="ij")
    rng = np.random.default_rng([scene.seed, 0xD2A9E])
    z = np.zeros_like(gx)
    for _ in range(26):
        k = rng.normal(0.0, 1.0, 2) * rng.choice([9.0, 22.0, 45.0])
        z += np.sin(k[0] * gx + k[1] * gy + rng.uniform(0, 2 * np.pi)) / (1.0 + 0.05 * float(np.hypot(*k))) * 0.0009
    z -= BOARD_THICKNESS_M + 0.004
    z = np.minimum(z, -BOARD_THICKNESS_M + 0.003)
    uv = np.stack([drape_coordinate(gx), drape_coordinate(gy)], axis=-1).reshape(-1, 2)
    vertices = np.stack([gx, gy, z], axis=-1).reshape(-1, 3)
    return Part("drape", "drape", vertices, grid_faces(len(axis), len(axis)), uv)


def _spheres(centres_m: Iterable[Array]) -> list[Part]:
    return [sphere_mesh(centre, RADIUS_M, 3) for centre in centres_m]
