"""A second, independent renderer of marker spheres: selectable lamps, gloss, background, blur, tone curve and JPEG.

Outlines are exact: every pixel near a sphere is the mean of rays through the distorted lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.core.geometry import Array
from tests.support.scenes.sphere_images import RADIUS_M, box_around, met, sampled_pixels

COLOURS_BGR = {
    "white": (0.78, 0.80, 0.82), "green": (0.085, 0.74, 0.50), "dark green": (0.10, 0.32, 0.06),
    "orange": (0.04, 0.26, 0.85), "grey": (0.30, 0.30, 0.30), "blue": (0.60, 0.22, 0.07),
}  # fmt: skip
GROUNDS_BGR = {
    "skin": ((0.28, 0.36, 0.62), (0.16, 0.22, 0.48)), "blood": ((0.03, 0.03, 0.22), (0.10, 0.12, 0.40)),
    "white cloth": ((0.78, 0.78, 0.76), (0.55, 0.56, 0.56)), "green cloth": ((0.20, 0.32, 0.10), (0.13, 0.22, 0.06)),
    "wood": ((0.16, 0.30, 0.46), (0.09, 0.19, 0.33)), "black velvet": ((0.005, 0.005, 0.006), (0.001, 0.001, 0.001)),
    "table": ((0.42, 0.44, 0.46), (0.36, 0.38, 0.40)),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Look:
    """The conditions of one picture; directions point to the lamps, in the camera frame (z forward)."""

    colour: str = "white"
    ground: str = "skin"
    lamps: tuple[tuple[tuple[float, float, float], float], ...] = (((0.3, -0.5, -0.8), 0.75),)
    ambient: float = 0.22
    gloss: float = 0.0
    shininess: float = 60.0
    blur_px: float = 0.7
    noise: float = 0.003
    srgb: bool = True
    quality: int = 92
    subsampled: bool = True
    wires: int = 0
    stains: int = 0
    tissue: int = 0  # patches of background texture in front of spheres
    posts: bool = True
    mirror: float = 0.0  # reflectance of the surroundings at normal incidence
    up: tuple[float, float, float] = (0.0, -0.2, -0.98)  # of the surroundings: a bright room above the ground
    room: float = 0.9  # brightness of the room
    pale: float = 0.0  # fraction of white light added to the picture, like a cheap camera's lens flare and processing
    balance_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)  # gains of the camera's white balance


def _ground(shape: tuple[int, int], kind: str, rng: np.random.Generator) -> Array:
    h, w = shape
    mix = np.zeros((h, w))
    for cell, weight in ((150, 1.0), (40, 0.8), (12, 0.6), (4, 0.45)):
        stretch = 5 if kind == "wood" else 1
        grid = rng.normal(size=(h // cell + 3, w // (cell * stretch) + 3)).astype(np.float32)
        mix += weight * cv2.resize(grid, (w, h), interpolation=cv2.INTER_CUBIC)
    if kind.endswith("cloth"):
        mix += 0.8 * np.sin(np.arange(w) * 0.9)[None] + 0.8 * np.sin(np.arange(h) * 0.8)[:, None]
    share = 1 / (1 + np.exp(-mix))[..., None]
    a, b = (np.array(c) for c in GROUNDS_BGR[kind])
    fine = 1 + 0.06 * rng.normal(size=(h, w, 1))
    return np.asarray((share * a + (1 - share) * b) * fine, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Picture:
    """An image (H, W, 3) BGR uint8, and the index of the sphere that each pixel shows (H, W), -1 for none."""

    image: NDArray[np.uint8]
    owner: NDArray[np.int16]

    def visible(self, cam: CameraModel, index: int, cone: Cone) -> float:
        """The fraction of a sphere's outline that is in the image and not occluded."""
        azimuth = np.linspace(0.0, 2 * np.pi, 180, endpoint=False)
        rim = cam.project(cone.rays(azimuth, np.full(180, cone.half_angle_rad - 1.5 / cam.fx)))
        x, y = np.rint(rim).astype(int).T
        here = (x >= 1) & (y >= 1) & (x < cam.width - 1) & (y < cam.height - 1)
        here[here] = self.owner[y[here], x[here]] == index
        return float(here.mean())


def render_look(cam: CameraModel, centres_camera_m: Array, look: Look, seed: int = 0) -> NDArray[np.uint8]:
    """Render an image (H, W, 3) BGR uint8 of spheres with centres (M, 3) in the camera frame."""
    return picture_of(cam, centres_camera_m, look, seed).image


def picture_of(cam: CameraModel, centres_camera_m: Array, look: Look, seed: int = 0) -> Picture:
    """Render the same image, with what each pixel shows."""
    owner = np.full((cam.height, cam.width), -1, dtype=np.int16)
    rng = np.random.default_rng(seed)
    image = _ground((cam.height, cam.width), look.ground, rng) * (0.35 + 0.65 * sum(s for _, s in look.lamps))
    order = np.argsort(-np.linalg.norm(centres_camera_m, axis=1)) if len(centres_camera_m) else []
    rows, columns = np.mgrid[: cam.height, : cam.width]
    for index in order:
        c = centres_camera_m[index]
        u, v = cam.project(c[None])[0]
        radius = RADIUS_M / c[2] * cam.fx
        away = rng.uniform(0, 2 * np.pi)
        shadow = np.exp(
            -((columns - u - 0.5 * radius * np.cos(away)) ** 2 + (rows - v - 0.5 * radius * np.sin(away)) ** 2)
            / (1.6 * radius**2)
        )
        image *= 1 - 0.45 * shadow[..., None]
        if look.posts:
            foot = (round(u + 1.9 * radius * np.cos(away)), round(v + 1.9 * radius * np.sin(away)))
            cv2.line(image, (round(u), round(v)), foot, (0.12, 0.16, 0.2), max(3, round(0.5 * radius)), cv2.LINE_AA)
            cv2.line(owner, (round(u), round(v)), foot, -1, max(3, round(0.5 * radius)))
        _draw_sphere(image, owner, cam, int(index), c, look, rng)
    for _ in range(look.wires):
        k = int(rng.integers(len(centres_camera_m)))
        u, v = cam.project(centres_camera_m[k][None])[0]
        radius = RADIUS_M / centres_camera_m[k][2] * cam.fx
        angle, side = rng.uniform(0, np.pi), rng.uniform(-0.8, 0.8) * radius
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        ends = [
            np.rint(np.array([u, v]) + side * across + s * 3 * radius * along).astype(int).tolist() for s in (-1, 1)
        ]
        tone = float(rng.choice([0.04, 0.6]))
        cv2.line(image, ends[0], ends[1], (tone, tone, tone), max(2, round(0.12 * radius)), cv2.LINE_AA)
        cv2.line(owner, ends[0], ends[1], -1, max(2, round(0.12 * radius)))
    for k in range(look.tissue):
        u, v = cam.project(centres_camera_m[k % len(centres_camera_m)][None])[0]
        radius = RADIUS_M / centres_camera_m[k % len(centres_camera_m)][2] * cam.fx
        mask = np.zeros(image.shape[:2], np.uint8)
        cv2.ellipse(
            mask, (round(u), round(v + 1.25 * radius)), (round(1.6 * radius), round(0.75 * radius)), 0, 0, 360, 1, -1
        )
        owner[mask > 0] = -1
        image[mask > 0] = _ground((cam.height, cam.width), look.ground, rng)[mask > 0]
    image = cv2.GaussianBlur(image, (0, 0), look.blur_px)
    image += rng.normal(size=image.shape) * look.noise * np.sqrt(0.15 + np.maximum(image, 0))
    image = np.clip((look.pale + (1 - look.pale) * image) * look.balance_bgr, 0, 1)
    if look.srgb:
        image = np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420 if look.subsampled else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    settings = [cv2.IMWRITE_JPEG_QUALITY, look.quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    ok, data = cv2.imencode(".jpg", np.round(image * 255).astype(np.uint8), settings)
    assert ok
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return Picture(np.asarray(decoded, dtype=np.uint8), owner)


def _reflection(rays: Array, normal: Array, look: Look) -> tuple[Array, Array]:
    """Reflection on the sphere: the fraction (N, 1), by Schlick's approximation of Fresnel, and the light (N, 3).

    The room lies above the horizon, the lit ground below: the horizon is reflected as a ring well inside the outline,
    and near the outline the sphere reflects what lies behind it.
    """
    facing = np.clip(-np.sum(rays * normal, axis=1), 0, 1)
    share = look.mirror + (1 - look.mirror) * (1 - facing) ** 5
    away = rays + 2 * facing[:, None] * normal
    up = np.array(look.up) / np.linalg.norm(look.up)
    room = 1 / (1 + np.exp(-(away @ up) / 0.02))
    ground = np.mean([np.array(c) for c in GROUNDS_BGR[look.ground]], axis=0)
    ground = ground * (0.35 + 0.65 * sum(s for _, s in look.lamps))
    return share[:, None], room[:, None] * look.room + (1 - room[:, None]) * ground


def _draw_sphere(
    image: Array,
    owner: NDArray[np.int16],
    cam: CameraModel,
    index: int,
    c: Array,
    look: Look,
    rng: np.random.Generator,
) -> None:
    box = box_around(cam, c, 1.25)
    if box is None:
        return
    patch, shown = (whole[box[1] : box[3] + 1, box[0] : box[2] + 1] for whole in (image, owner))
    spots = [_spot(rng) for _ in range(look.stains)]
    for pixels, rays in sampled_pixels(cam, c, box, 5, inside=5):
        hit, normal = met(rays, c)
        cover = hit.mean(axis=1)
        colour = np.zeros(rays.shape)
        colour[hit] = _light(rays[hit], normal[hit], look, spots)
        shown[pixels] = np.where(cover > 0.5, index, shown[pixels])
        patch[pixels] = patch[pixels] * (1 - cover)[:, None] + colour.mean(axis=1)


def _spot(rng: np.random.Generator) -> Array:
    """The direction (3,) of a stain's middle, on the side of the camera."""
    spot = rng.normal(size=3)
    spot[2] = -abs(spot[2])
    return spot / np.linalg.norm(spot)


def _light(rays: Array, normal: Array, look: Look, spots: Sequence[Array]) -> Array:
    """Light (N, 3) BGR that a sphere sends along rays (N, 3) that meet it, at places with these normals (N, 3)."""
    sky = np.array([0.2, -0.9, -0.4]) / np.linalg.norm([0.2, -0.9, -0.4])
    shade = look.ambient * (1 + 0.5 * (normal @ sky))
    shine = np.zeros(len(rays))
    for direction, strength in look.lamps:
        lamp = np.array(direction) / np.linalg.norm(direction)
        shade = shade + strength * np.maximum(normal @ lamp, 0)
        half = lamp - rays
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        facing = normal @ lamp > 0
        shine += look.gloss * strength * facing * np.maximum(np.sum(normal * half, axis=1), 0) ** look.shininess
    albedo = np.tile(np.array(COLOURS_BGR[look.colour]), (len(rays), 1))
    for spot in spots:
        albedo[normal @ spot > 0.96] = [0.02, 0.02, 0.2]
    colour = albedo * shade[:, None] + shine[:, None]
    if look.mirror:
        share, light = _reflection(rays, normal, look)
        colour = (1 - share) * colour + share * light
    return colour
