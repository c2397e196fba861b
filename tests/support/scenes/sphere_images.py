"""Analytic pictures of shaded spheres with exact outlines, for tests of the detector and the registration."""

from __future__ import annotations

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


def _background(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """Linear BGR in 0…1: blotches over several octaves, like tissue and cloth."""
    h, w = shape
    out = np.zeros((h, w, 3))
    for octave in (4, 12, 40, 160):
        grid = rng.uniform(0, 1, (octave * h // w + 2, octave + 2, 3)).astype(np.float32)
        out += cv2.resize(grid, (w, h), interpolation=cv2.INTER_CUBIC) / (octave**0.3)
    out -= out.min()
    return out / out.max() * np.array([0.14, 0.16, 0.32]) + 0.01


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
    tones = np.array(colour)
    order = np.argsort(-np.linalg.norm(centres_camera_m, axis=1))
    for c in centres_camera_m[order]:
        centre = cam.project(c[None])[0]
        reach = 1.25 * RADIUS_M / c[2] * cam.fx + 3
        x0, y0 = np.maximum(np.floor(centre - reach).astype(int), 0)
        x1 = min(int(centre[0] + reach), cam.width - 1)
        y1 = min(int(centre[1] + reach), cam.height - 1)
        if x1 <= x0 or y1 <= y0:
            continue
        step = 1.0 / oversample
        xs = np.arange((x1 - x0 + 1) * oversample) * step + x0 - 0.5 + step / 2
        ys = np.arange((y1 - y0 + 1) * oversample) * step + y0 - 0.5 + step / 2
        grid = np.stack(np.meshgrid(xs, ys), axis=-1)
        rays = np.concatenate([cam.normalise(grid.reshape(-1, 2)), np.ones((grid.size // 2, 1))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        along = rays @ c
        gap = along**2 - (c @ c - RADIUS_M**2)
        hit = gap > 0
        normal = (rays * (along - np.sqrt(np.maximum(gap, 0)))[:, None] - c) / RADIUS_M
        shade = 0.18 + 0.82 * np.maximum(normal @ lamp, 0)
        half = lamp - rays
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        gloss = 0.12 * np.maximum(np.einsum("ij,ij->i", normal, half), 0) ** 40
        values = (shade[:, None] * tones + gloss[:, None]) * hit[:, None]
        ny, nx = y1 - y0 + 1, x1 - x0 + 1
        box = (ny, oversample, nx, oversample)
        cover = hit.astype(float).reshape(box).mean(axis=(1, 3))
        light = values.reshape(*box, 3).mean(axis=(1, 3))
        patch = image[y0 : y1 + 1, x0 : x1 + 1]
        patch *= 1 - cover[..., None]
        patch += light
    for _ in range(occluders):
        a, b = rng.uniform([0, 0], [cam.width, cam.height], (2, 2)).astype(int)
        cv2.line(image, a.tolist(), b.tolist(), (0.3, 0.3, 0.3), max(2, cam.width // 250))
    image = cv2.GaussianBlur(image, (0, 0), blur_px)
    image += rng.normal(size=image.shape) * noise * np.sqrt(0.2 + image)
    image = np.clip(image, 0, 1)
    coded = np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)
    ok, data = cv2.imencode(".jpg", np.round(coded * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    assert ok
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded, dtype=np.uint8)
