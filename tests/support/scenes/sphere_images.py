"""Analytic pictures of shaded spheres with exact outlines, for tests of the detector and the registration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_of_sphere
from service.compute.markers.records import OutlineEvidence, SphereOutline, outline_from_cone
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, apply, inverse, look_at, transform

RADIUS_M = 0.015
REGISTRATION_M = np.array(
    [
        [-0.23, -0.15, 0.045], [-0.10, -0.17, 0.06], [0.06, -0.165, 0.04], [0.21, -0.14, 0.055], [0.25, 0.01, 0.04],
        [0.20, 0.15, 0.065], [0.08, 0.17, 0.05], [-0.07, 0.16, 0.04], [-0.21, 0.155, 0.06], [-0.255, 0.03, 0.05],
    ]
)  # fmt: skip
REGISTRATION = ScanSpheres(REGISTRATION_M, RADIUS_M)
_AT_OUTLINE_PX = 1.5  # a pixel's corner is 0.71 px from its middle; the rest is for the lens
CONTROL_M = np.array([[-0.09, 0.02, 0.09], [0.01, -0.02, 0.06], [0.10, 0.03, 0.085]])


def camera(width: int = 1536) -> CameraModel:
    height = round(width * 2 / 3)
    return CameraModel(
        width, height, 1.4 * width, 1.4 * width * 1.0005, width * 0.5 + 0.004 * width, height * 0.5 - 0.003 * width,
        -0.05, 0.03, 2e-4, -3e-4,
    )  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """Spheres in the scan frame and cameras in the world frame."""

    T_world_scan: Array
    T_world_camera: Array
    camera: CameraModel

    @property
    def images(self) -> PosedImages:
        """All images with their true poses."""
        return PosedImages(self.T_world_camera, self.camera)

    def centres_camera(self, image: int, centres_scan_m: Array) -> Array:
        return apply(inverse(self.T_world_camera[image]) @ self.T_world_scan, centres_scan_m)


def scene(n_images: int = 6, width: int = 1536, seed: int = 0) -> Scene:
    """Cameras on two arcs above the spheres, aimed near the scene's centre; the scan frame is arbitrary."""
    rng = np.random.default_rng(seed)
    T_world_scan = transform(Rotation.random(rng=rng), rng.uniform(-0.4, 0.4, 3))
    poses: list[Array] = []
    for k in range(n_images):
        azimuth = 2 * np.pi * k / n_images + rng.uniform(-0.2, 0.2)
        tilt = np.deg2rad(rng.uniform(12, 45))
        distance = rng.uniform(0.58, 0.72)
        eye = distance * np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        up = np.array([np.cos(azimuth + 2.4), np.sin(azimuth + 2.4), 0.2])
        T_scan_camera = look_at(eye, rng.uniform(-0.02, 0.02, 3) + np.array([0, 0, 0.05]), up)
        poses.append(T_world_scan @ T_scan_camera)
    return Scene(T_world_scan, np.array(poses), camera(width))


def exact_outlines(
    made: Scene, image: int, centres_scan_m: Array, noise_px: float = 0.0, seed: int = 0, margin_px: float = 0.0
) -> tuple[tuple[SphereOutline, ...], tuple[int, ...]]:
    """Outlines of a perfect detector, in random order, of the spheres inside the image; and the spheres' indices.

    `noise_px` is added to a cone's two directions and its size.
    """
    rng = np.random.default_rng(1000 * seed + image)
    c = made.centres_camera(image, centres_scan_m)
    pixels = made.camera.project(c)
    inside = np.all(
        (pixels > margin_px) & (pixels < np.array([made.camera.width, made.camera.height]) - margin_px), axis=1
    )
    order = rng.permutation(np.nonzero(inside & (c[:, 2] > 0.1))[0])
    covariance = np.eye(3) * (max(noise_px, 0.02) / made.camera.fx) ** 2
    evidence = OutlineEvidence(
        1.0, 0.1, max(noise_px, 0.02) * 10, 300, 0.02, 0.3, (180.0, 180.0, 180.0), 0.9, covariance
    )
    out: list[SphereOutline] = []
    for k in order:
        cone = cone_of_sphere(c[k], RADIUS_M)
        d = rng.normal(size=3) * noise_px / made.camera.fx
        axis = cone.axis + cone.frame()[:, :2] @ d[:2]
        noisy = Cone(axis / float(np.linalg.norm(axis)), cone.half_angle_rad + float(d[2]))
        out.append(outline_from_cone(noisy, made.camera, 200, evidence))
    return tuple(out), tuple(int(k) for k in order)


def false_outlines(cam: CameraModel, n: int, seed: int = 0) -> tuple[SphereOutline, ...]:
    """False detections at random places, of plausible sizes."""
    rng = np.random.default_rng(seed)
    evidence = OutlineEvidence(
        0.8, 0.2, 0.2, 200, 0.05, 0.2, (120.0, 120.0, 120.0), 0.6, np.eye(3) * (0.1 / cam.fx) ** 2
    )
    out: list[SphereOutline] = []
    for _ in range(n):
        pixel = rng.uniform([0, 0], [cam.width, cam.height])[None]
        centre = np.append(cam.normalise(pixel)[0], 1.0) * rng.uniform(0.5, 0.8)
        out.append(outline_from_cone(cone_of_sphere(centre, RADIUS_M), cam, 200, evidence))
    return tuple(out)


def _background(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """Linear BGR in 0…1: blotches over several octaves, like tissue and cloth."""
    h, w = shape
    out = np.zeros((h, w, 3), dtype=np.float32)
    for octave in (4, 12, 40, 160):
        grid = rng.uniform(0, 1, (octave * h // w + 2, octave + 2, 3)).astype(np.float32)
        grid /= np.float32(octave**0.3)
        out += cv2.resize(grid, (w, h), interpolation=cv2.INTER_CUBIC)
    out -= out.min()
    out *= np.array([0.14, 0.16, 0.32], dtype=np.float32) / out.max()
    out += np.float32(0.01)
    return out


Box = tuple[int, int, int, int]  # first column, first row, last column, last row


def box_around(cam: CameraModel, centre_camera_m: Array, radii: float) -> Box | None:
    """The pixels within so many radii of a sphere's centre; None if these are outside the image."""
    u, v = cam.project(centre_camera_m[None])[0]
    reach = radii * RADIUS_M / centre_camera_m[2] * cam.fx + 3
    x0, y0 = (int(max(0, np.floor(q - reach))) for q in (u, v))
    x1, y1 = int(min(cam.width - 1, u + reach)), int(min(cam.height - 1, v + reach))
    return None if x1 <= x0 or y1 <= y0 else (x0, y0, x1, y1)


def sampled_pixels(
    cam: CameraModel, centre_camera_m: Array, box: Box, oversample: int, inside: int = 1
) -> Iterator[tuple[NDArray[np.bool_], Array]]:
    """The pixels of a box that show a sphere, and the rays through the distorted lens that they average.

    Those at the outline have `oversample`² rays each, so that it is exact. Those within change little from ray to
    ray, and have `inside`² rays.

    Yields:
        pixels (H, W) of the box, N in number, and unit rays (N, K, 3).
    """
    x0, y0, x1, y1 = box
    middles = np.stack(np.meshgrid(np.arange(x0, x1 + 1.0), np.arange(y0, y1 + 1.0)), axis=-1)
    distance_m = np.linalg.norm(centre_camera_m)
    rays = _rays(cam, middles)
    angle = np.arccos(np.clip(rays @ centre_camera_m / distance_m, -1, 1))
    beyond_px = (angle - np.arcsin(RADIUS_M / distance_m)) * cam.fx / rays[..., 2]
    within = beyond_px < -_AT_OUTLINE_PX
    for pixels, n in ((within, inside), (~within & (beyond_px < _AT_OUTLINE_PX), oversample)):
        if not pixels.any():
            continue
        sub = (np.arange(n) + 0.5) / n - 0.5
        grid = middles[pixels][:, None, None] + np.stack(np.meshgrid(sub, sub), axis=-1)
        yield pixels, _rays(cam, grid.reshape(-1, n * n, 2))


def _rays(cam: CameraModel, pixels: Array) -> Array:
    """Unit rays (..., 3) through pixels (..., 2)."""
    plane = cam.normalise(pixels.reshape(-1, 2))
    rays = np.column_stack([plane, np.ones(len(plane))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays.reshape(*pixels.shape[:-1], 3)


def met(rays: Array, centre_camera_m: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which unit rays (..., 3) meet a sphere, and its unit normals there; of others, the normals mean nothing."""
    along = rays @ centre_camera_m
    gap = along**2 - (centre_camera_m @ centre_camera_m - RADIUS_M**2)
    return gap > 0, (rays * (along - np.sqrt(np.maximum(gap, 0)))[..., None] - centre_camera_m) / RADIUS_M


def coded_8bit(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Light (0…1) as 8 bits of sRGB."""
    return _CODES[np.rint(image * (len(_CODES) - 1)).astype(np.uint16)]


def _codes() -> NDArray[np.uint8]:
    light = np.linspace(0, 1, 2**16)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(coded * 255).astype(np.uint8)


_CODES = _codes()  # of 65536 steps of light; one step is at most a twentieth of a code


def render(
    cam: CameraModel,
    centres_camera_m: Array,
    seed: int = 0,
    *,
    colour: tuple[float, float, float] = (0.62, 0.68, 0.72),
    oversample: int = 4,
    jpeg_quality: int = 95,
    blur_px: float = 0.6,
    noise: float = 0.004,
    occluders: int = 0,
) -> NDArray[np.uint8]:
    """JPEG image (H, W, 3) BGR uint8 of matte spheres, centres (M, 3) in the camera frame, with a lamp."""
    rng = np.random.default_rng(seed)
    image = _background((cam.height, cam.width), rng)
    lamp = np.array([0.35, -0.5, -0.8]) + rng.uniform(-0.2, 0.2, 3)
    lamp /= np.linalg.norm(lamp)
    order = np.argsort(-np.linalg.norm(centres_camera_m, axis=1))
    for c in centres_camera_m[order]:
        box = box_around(cam, c, 1.25)
        if box is None:
            continue
        patch = image[box[1] : box[3] + 1, box[0] : box[2] + 1]
        for pixels, rays in sampled_pixels(cam, c, box, oversample, inside=oversample):
            hit, normal = met(rays, c)
            shade = 0.18 + 0.82 * np.maximum(normal @ lamp, 0)
            half = lamp - rays
            half /= np.linalg.norm(half, axis=-1, keepdims=True)
            gloss = 0.12 * np.maximum(np.sum(normal * half, axis=-1), 0) ** 40
            values = (shade[..., None] * colour + gloss[..., None]) * hit[..., None]
            patch[pixels] = patch[pixels] * (1 - hit.mean(axis=1))[:, None] + values.mean(axis=1)
    for _ in range(occluders):
        a, b = rng.uniform([0, 0], [cam.width, cam.height], (2, 2)).astype(int)
        cv2.line(image, a.tolist(), b.tolist(), (0.3, 0.3, 0.3), max(2, cam.width // 250))
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), dtype=np.float32)
    image += rng.normal(size=image.shape).astype(np.float32) * np.float32(noise) * np.sqrt(np.float32(0.2) + image)
    np.clip(image, 0, 1, out=image)
    ok, data = cv2.imencode(".jpg", coded_8bit(image), [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    assert ok
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded, dtype=np.uint8)
