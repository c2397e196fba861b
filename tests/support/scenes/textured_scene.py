"""Renders textured slabs analytically, with lens distortion, as images with known poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform, look_at

TEXEL_M = 0.25e-3


def camera_of_width(width: int) -> CameraModel:
    """A 50 mm class lens with an off-centre principal point and mild distortion."""
    height = round(width * 2 / 3)
    return CameraModel(
        width,
        height,
        1.4 * width,
        1.401 * width,
        0.504 * width,
        0.497 * height,
        k1=-0.06,
        k2=0.05,
        p1=3e-4,
        p2=-2e-4,
    )


def ring_of_poses(count: int, distance_m: float = 0.62, tilt_deg: float = 32.0) -> list[Transform]:
    """T_world_camera on two rings of different tilt around the scene, looking near its centre."""
    poses: list[Transform] = []
    for k in range(count):
        azimuth = 2 * np.pi * k / count
        tilt = np.deg2rad(tilt_deg if k % 2 else 0.5 * tilt_deg)
        eye = distance_m * np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        target = np.array([0.01 * np.cos(3 * azimuth), 0.01 * np.sin(5 * azimuth), 0.02])
        poses.append(look_at(eye, target, np.array([0.0, 1.0, 0.1])))
    return poses


@dataclass(frozen=True, slots=True)
class Slab:
    """A horizontal rectangle with its own texture."""

    low: tuple[float, float]
    high: tuple[float, float]
    z: float
    texture: NDArray[np.float32]


def slabs(seed: int = 0) -> list[Slab]:
    """A table with a dozen slabs of different heights on it."""
    rng = np.random.default_rng(seed)
    out = [_slab((-0.45, -0.45), (0.45, 0.45), 0.0, rng)]
    for _ in range(12):
        low = rng.uniform(-0.2, 0.1, 2)
        size = rng.uniform(0.04, 0.09, 2)
        out.append(_slab((low[0], low[1]), (low[0] + size[0], low[1] + size[1]), rng.uniform(0.01, 0.09), rng))
    return out


def _slab(low: tuple[float, float], high: tuple[float, float], z: float, rng: np.random.Generator) -> Slab:
    shape = (int((high[1] - low[1]) / TEXEL_M) + 2, int((high[0] - low[0]) / TEXEL_M) + 2)
    texture = np.zeros(shape, dtype=np.float32)
    for texels, gain in ((4, 0.5), (10, 1.0), (25, 1.0), (80, 0.8)):
        coarse = rng.normal(0, 1, (shape[0] // texels + 3, shape[1] // texels + 3)).astype(np.float32)
        texture += gain * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return Slab(low, high, z, np.clip(128 + 38 * texture, 0, 255).astype(np.float32))


@lru_cache(maxsize=1)
def _camera_rays(camera: CameraModel) -> Array:
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2)
    return np.concatenate([camera.normalise(grid.astype(np.float64)), np.ones((len(grid), 1))], axis=1)


def render(
    scene: Sequence[Slab], camera: CameraModel, T_world_camera: Transform, noise_seed: int | None = None
) -> NDArray[np.uint8]:
    """Grey image (height, width), 2 × 2 supersampled, with a little noise."""
    fine = camera.scaled(2 * camera.width, 2 * camera.height)
    rays: Array = _camera_rays(fine) @ T_world_camera[:3, :3].T
    across, along = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    eye = T_world_camera[:3, 3]
    image = np.full(len(rays), 60.0, dtype=np.float32)
    for slab in sorted(scene, key=lambda s: s.z):  # seen from above: higher slabs hide lower ones
        down = slab.z - eye[2]
        x, y = eye[0] + down * across, eye[1] + down * along
        inside = (x > slab.low[0]) & (x < slab.high[0]) & (y > slab.low[1]) & (y < slab.high[1])
        if inside.any():
            u = np.stack([x[inside], y[inside]], axis=1) - slab.low
            image[inside] = _sample(slab.texture, (u / TEXEL_M).astype(np.float32))
    small = cv2.resize(
        image.reshape(fine.height, fine.width), (camera.width, camera.height), interpolation=cv2.INTER_AREA
    )
    noise = 0.0 if noise_seed is None else np.random.default_rng(noise_seed).normal(0, 1.5, small.shape)
    return np.clip(small + noise, 0, 255).round().astype(np.uint8)


def _sample(texture: NDArray[np.float32], u: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bilinear samples; cv2.remap takes at most 32767 rows, so the list is folded into a rectangle."""
    rows = -(-len(u) // 1024)
    padded = np.zeros((rows * 1024, 2), dtype=np.float32)
    padded[: len(u)] = u
    folded = padded.reshape(rows, 1024, 2)
    x, y = np.ascontiguousarray(folded[..., 0]), np.ascontiguousarray(folded[..., 1])
    return cv2.remap(texture, x, y, cv2.INTER_LINEAR).astype(np.float32).reshape(-1)[: len(u)]
