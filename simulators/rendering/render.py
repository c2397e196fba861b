"""Renders what the camera sees: ray casting with exact outlines, lens distortion, exposure and photon noise."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from simulators.geometry import Array, Array32, Bools, Bytes, Ints, inverse
from simulators.rendering.lighting import THREADS
from simulators.rendering.overlays import Frame, draw_calibration_board, draw_sphere
from simulators.rendering.sensor import EXPOSED, FULL_WELL_E, READ_NOISE_E, Light, light_of
from simulators.rendering.srgb import coded_table
from simulators.rendering.surfaces import Surfaces
from simulators.scene.intrinsics import Intrinsics
from simulators.scene.world import NOMINAL_LUX, RADIUS_M, Moved, Scene

TILE_PIXELS = 500_000
MOST_KEPT_RAYS = 16_000_000  # 24 bytes each
HALO = 4  # additional rows of a tile, so that edge detection and lens blur do not see its border
_TEXTURES = ((800, 512), (1400, 1024), (2601, 2048))  # texture size that suffices below this image width
PREVIEW_WIDTH = 640
BLUR_PX = 0.42
WHITE = 1.12  # linear colour that saturates at the reference exposure
REFERENCE = {"exposure_s": 1 / 15, "iso": 100.0, "aperture_f": 22.0}
_SUB = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float32) / np.float32(3.0)


@dataclass(frozen=True, slots=True)
class View:
    """Holds what the camera sees: the parsed answer to the world's `view` request."""

    T_world_camera: Array
    intrinsics: Intrinsics
    seed: int
    moved: Moved
    spray: bool
    control_spheres: bool
    T_world_board: Array | None
    light_lux: float

    @classmethod
    def from_json(cls, view: Mapping[str, Any], width: int) -> View:
        """Parse the world's answer, for images of this width."""
        scene = view["scene"]
        board = scene.get("board")
        return cls(
            T_world_camera=np.array(view["T_world_camera"], dtype=np.float64),
            intrinsics=Intrinsics(**view["intrinsics"]).scaled(width),
            seed=int(scene["seed"]),
            moved=tuple((int(i), float(x), float(y), float(z)) for i, x, y, z in scene.get("moved", ())),
            spray=bool(scene.get("spray", False)),
            control_spheres=bool(scene.get("control_spheres", False)),
            T_world_board=None if board is None else np.array(board, dtype=np.float64),
            light_lux=float(view.get("light_lux", NOMINAL_LUX)),
        )


class Renderer:
    """Renders views at one image width; caches the textures and the light of one scene."""

    def __init__(self, image_width: int) -> None:
        self.image_width = image_width
        self._texture_size = next((size for width, size in _TEXTURES if image_width < width), 4096)
        self._surfaces: Surfaces | None = None
        self._rays: tuple[Intrinsics, Array] | None = None

    def render(self, view: Mapping[str, Any], camera_settings: Mapping[str, float], seed: int) -> Bytes:
        """Render a view as RGB (H, W, 3).

        `camera_settings` are exposure_s, iso and aperture_f; `seed` is that of the noise.
        """
        return self._rendered(View.from_json(view, self.image_width), camera_settings, seed)

    def light(self, view: Mapping[str, Any], camera_settings: Mapping[str, float]) -> Light:
        """The light on the sensor, without noise: linear RGB (H, W, 3) of the picture and the border around it."""
        seen = View.from_json(view, self.image_width)
        seen = replace(seen, intrinsics=_with_border(seen.intrinsics))
        scale = _electrons(seen, camera_settings) * _amplification(camera_settings)
        out = np.empty((seen.intrinsics.height, seen.intrinsics.width, 3), dtype=np.uint16)
        for first, rows in self._blurred_tiles(seen):
            out[first : first + len(rows)] = light_of(rows * np.float32(scale))
        return out

    def preview(self, view: Mapping[str, Any]) -> Bytes:
        """Render a small RGB frame at the reference exposure, for live view."""
        return self._rendered(View.from_json(view, min(PREVIEW_WIDTH, self.image_width)), REFERENCE, 0)

    def surfaces(self, seed: int, moved: Moved = ()) -> Surfaces:
        """The surfaces of this seed's scene; built on first use, and again if a sphere was moved."""
        now = None if self._surfaces is None else (self._surfaces.scene.seed, self._surfaces.scene.moved)
        if self._surfaces is None or now != (seed, moved):
            self._surfaces = Surfaces(Scene.generate(seed, moved), self._texture_size)
        return self._surfaces

    def _rendered(self, view: View, settings: Mapping[str, float], seed: int) -> Bytes:
        lens = view.intrinsics
        electrons, amplification = _electrons(view, settings), _amplification(settings)
        rng = np.random.default_rng([view.seed, seed])
        image = np.empty((lens.height, lens.width, 3), dtype=np.uint8)
        for first, rows in self._blurred_tiles(view):
            signal = rows * np.float32(electrons)
            noise = rng.standard_normal(signal.shape, dtype=np.float32)
            signal += noise * np.sqrt(signal + np.float32(READ_NOISE_E**2))
            image[first : first + len(rows)] = _srgb(signal * np.float32(amplification))
        return image

    def _blurred_tiles(self, view: View) -> Iterator[tuple[int, Array32]]:
        """First row and linear colour (rows, W, 3) of the parts of the image, blurred by the lens."""
        lens = view.intrinsics
        surfaces, rays = self.surfaces(view.seed, view.moved), self._kept_rays(lens)
        surfaces.light(view.control_spheres)  # computed once, before several tiles ask for it

        def blurred(first: int, last: int) -> Array32:
            top, bottom = max(0, first - HALO), min(lens.height, last + HALO)
            directions = _pixel_rays(lens, top, bottom) if rays is None else rays[top:bottom]
            linear = self._linear(surfaces, view, top, directions)
            linear = np.asarray(cv2.GaussianBlur(linear, (0, 0), BLUR_PX, borderType=cv2.BORDER_REPLICATE))
            return np.maximum(linear[first - top : last - top], 0.0)

        with ThreadPoolExecutor(THREADS) as pool:
            begun: deque[tuple[int, Future[Array32]]] = deque()
            for first, last in _tiles(lens):
                begun.append((first, pool.submit(blurred, first, last)))
                if len(begun) > THREADS:  # no more of a large picture than is being used
                    yield _finished(begun)
            while begun:
                yield _finished(begun)

    def _linear(self, surfaces: Surfaces, view: View, top: int, rays: Array) -> Array32:
        """Linear colour (rows, W, 3) of the image rows from `top` on, of rays (rows, W, 3) in the camera frame."""
        R, eye = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
        world = (rays @ R.T).astype(np.float32)
        height, width = world.shape[:2]
        pixel_rad = 1.0 / view.intrinsics.fx
        shade = surfaces.shade(eye, world.reshape(-1, 3), pixel_rad, control=view.control_spheres, spray=view.spray)
        colour = shade.colour.reshape(height, width, 3)
        depth = shade.depth.reshape(height, width)
        frame = Frame(colour, depth, rays, view.T_world_camera, view.intrinsics, top)
        centres = surfaces.scene.sphere_centres_m(control=False)
        if view.control_spheres:
            centres = np.concatenate([centres, surfaces.scene.sphere_centres_m(control=True)])
        T_camera_world = inverse(view.T_world_camera)
        centres_camera = centres @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        edges = _edges(depth, shade.material.reshape(height, width))
        self._supersample(surfaces, view, frame, world, np.flatnonzero(edges))
        for index in np.argsort(-centres_camera[:, 2]):
            draw_sphere(frame, centres_camera[index], centres[index], RADIUS_M, surfaces.scene.lamp_m)
        if view.T_world_board is not None:
            draw_calibration_board(frame, view.T_world_board, surfaces.scene.lamp_m)
        return frame.colour

    def _supersample(self, surfaces: Surfaces, view: View, frame: Frame, world: Array32, at: Ints) -> None:
        """Replace the pixels `at` (flat indices) by the mean of 3 × 3 rays."""
        if len(at) == 0:
            return
        d_row, d_column = (np.gradient(world, axis=axis).reshape(-1, 3)[at] for axis in (0, 1))
        middle = world.reshape(-1, 3)[at]
        rays = middle[None] + _SUB[:, :1, None] * d_row[None] + _SUB[:, 1:, None] * d_column[None]
        eye = view.T_world_camera[:3, 3]
        total = np.zeros((len(at), 3), dtype=np.float32)
        for row in rays:
            shade = surfaces.shade(
                eye,
                np.ascontiguousarray(row, dtype=np.float32),
                0.5 / view.intrinsics.fx,
                control=view.control_spheres,
                spray=view.spray,
            )
            total += shade.colour
        frame.colour.reshape(-1, 3)[at] = total / np.float32(len(_SUB))

    def _kept_rays(self, lens: Intrinsics) -> Array | None:
        """Rays (H, W, 3) of all pixel centres, in the camera frame; None if they are too many to be kept."""
        if lens.width * lens.height > MOST_KEPT_RAYS:
            return None
        if self._rays is None or self._rays[0] != lens:
            self._rays = (lens, _pixel_rays(lens, 0, lens.height))
        return self._rays[1]


def _finished(begun: deque[tuple[int, Future[Array32]]]) -> tuple[int, Array32]:
    first, tile = begun.popleft()
    return first, tile.result()


def _electrons(view: View, settings: Mapping[str, float]) -> float:
    """Electrons per unit of linear colour, before ISO amplification."""
    gain = view.light_lux / NOMINAL_LUX / WHITE
    gain *= settings["exposure_s"] / REFERENCE["exposure_s"] * (REFERENCE["aperture_f"] / settings["aperture_f"]) ** 2
    return gain * FULL_WELL_E


def _amplification(settings: Mapping[str, float]) -> float:
    """The signal of one electron as a fraction of saturation."""
    return settings["iso"] / REFERENCE["iso"] / FULL_WELL_E


def _with_border(lens: Intrinsics) -> Intrinsics:
    """The intrinsics of all exposed photosites, of which the picture is a part."""
    b = EXPOSED
    width, height = lens.width + b.left + b.right, lens.height + b.top + b.bottom
    return replace(lens, width=width, height=height, cx=lens.cx + b.left, cy=lens.cy + b.top)


def _tiles(lens: Intrinsics) -> Iterator[tuple[int, int]]:
    rows = max(16, TILE_PIXELS // lens.width)
    for first in range(0, lens.height, rows):
        yield first, min(lens.height, first + rows)


def _pixel_rays(lens: Intrinsics, top: int, bottom: int) -> Array:
    column, row = np.meshgrid(np.arange(lens.width, dtype=np.float64), np.arange(top, bottom, dtype=np.float64))
    return lens.rays(np.stack([column, row], axis=-1))


def _edges(depth: Array32, material: Bytes) -> Bools:
    """Pixels (H, W) crossed by an outline or a crease: the depth changes abruptly, or the material changes."""
    bend = np.abs(cv2.Laplacian(np.minimum(depth, 10.0), cv2.CV_32F)) > np.float32(0.004)
    change = cv2.morphologyEx(material, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
    return bend | change


_SRGB_STEPS = 4095
_SRGB = coded_table(_SRGB_STEPS)


def _srgb(linear: Array32) -> Bytes:
    """Convert linear colour to sRGB bytes, clipped to 0…1."""
    index = np.clip(linear * np.float32(_SRGB_STEPS) + np.float32(0.5), 0, _SRGB_STEPS).astype(np.uint16)
    return _SRGB[index]
