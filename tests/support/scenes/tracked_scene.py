"""Spheres, scene points and cameras with exact geometry: tracks, outlines and robot poses with chosen errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.sfm.features import Tracks
from service.core.geometry import Array, apply, inverse, transform
from tests.support.scenes.sphere_images import REGISTRATION_M, exact_outlines, scene


@dataclass(frozen=True)
class TrackedScene:
    """The output of structure from motion, detector and robot, and the ground truth."""

    camera: CameraModel
    tracks: Tracks  # in the frame and unit of `poses`
    poses: Array  # (N, 4, 4) from structure from motion
    outlines: list[tuple[SphereOutline, ...]]
    T_base_camera: Array  # (N, 4, 4), two stations
    groups: NDArray[np.int64]
    T_scan_camera: Array  # ground truth
    T_scan_base: Array  # (2, 4, 4) ground truth
    scale: float  # metres per unit of `poses`


def small_turn(rng: np.random.Generator, sigma_rad: float) -> Rotation:
    return Rotation.from_rotvec(rng.normal(0, sigma_rad, 3))


def tracked_scene(
    seed: int,
    *,
    images: int = 8,
    points: int = 150,
    track_px: float = 0.0,
    outline_px: float = 0.0,
    robot_m: float = 0.0,
    robot_rad: float = 0.0,
    outliers: float = 0.0,
    camera_error_px: float = 0.0,
    camera_errors: Mapping[str, float] | None = None,
) -> TrackedScene:
    """Cameras above spheres and a bumpy scene; structure from motion starts near the truth, in a frame of its own.

    With `camera_error_px` the tracks and outlines come from a camera whose principal point differs by so much from
    the one that is returned as calibrated; `camera_errors` are added to its parameters by name.
    """
    rng = np.random.default_rng(seed)
    made = scene(images, 1536, seed)
    errors = {"cx": camera_error_px, **(camera_errors or {})}
    calibrated = dataclasses.replace(
        made.camera, **{name: getattr(made.camera, name) + d for name, d in errors.items()}
    )
    T_scan_camera = np.array([inverse(made.T_world_scan) @ T for T in made.T_world_camera])
    X = np.column_stack([rng.uniform(-0.2, 0.2, (points, 2)), rng.uniform(0, 0.1, points)])
    image, point, pixels = [], [], []
    for i, T in enumerate(T_scan_camera):
        seen = made.camera.project(apply(inverse(T), X))
        for k in np.nonzero(rng.uniform(size=points) < 0.7)[0]:
            image.append(i)
            point.append(k)
            wrong = rng.normal(0, 8, 2) if rng.uniform() < outliers else np.zeros(2)
            pixels.append(seen[k] + rng.normal(0, track_px, 2) + wrong)
    often = np.bincount(point, minlength=points) >= 3
    rows = often[np.array(point)]
    number = np.cumsum(often) - 1
    # Frame and unit of structure from motion; its errors are small compared with a pixel.
    scale = float(rng.uniform(0.05, 0.3))
    T_sfm_scan = transform(Rotation.random(rng=rng), rng.uniform(-1, 1, 3))
    poses: list[Array] = []
    for pose in T_scan_camera:
        near = transform(small_turn(rng, 2e-4).as_matrix() @ pose[:3, :3], pose[:3, 3] + rng.normal(0, 1e-4, 3))
        poses.append(T_sfm_scan @ transform(near[:3, :3], near[:3, 3] / scale))
    start = apply(T_sfm_scan, (X[often] + rng.normal(0, 1e-4, X[often].shape)) / scale)
    outlines = []
    for i in range(images):
        found = exact_outlines(made, i, REGISTRATION_M, outline_px, seed)[0]
        outlines.append(
            found if calibrated == made.camera else tuple(_seen_with(o, made.camera, calibrated) for o in found)
        )
    groups = (np.arange(images) >= images // 2).astype(np.int64)
    bases = np.array([transform(Rotation.random(rng=rng), rng.uniform(-0.6, 0.6, 3)) for _ in range(2)])
    robot: list[Array] = []
    for g, pose in zip(groups, T_scan_camera, strict=True):
        exact = inverse(bases[g]) @ pose
        robot.append(
            transform(
                small_turn(rng, robot_rad).as_matrix() @ exact[:3, :3], exact[:3, 3] + rng.normal(0, robot_m, 3)
            )
        )
    tracks = Tracks(np.array(image)[rows], number[np.array(point)[rows]], np.array(pixels)[rows], start)
    return TrackedScene(
        calibrated, tracks, np.array(poses), outlines, np.array(robot), groups, T_scan_camera, bases, scale
    )


def _seen_with(outline: SphereOutline, true: CameraModel, calibrated: CameraModel) -> SphereOutline:
    """The outline as it is read with the calibrated camera instead of the true one."""
    rim = outline.cone.rays(np.linspace(0, 2 * np.pi, 24), np.full(24, outline.cone.half_angle_rad))
    rays = np.column_stack([calibrated.normalise(true.project(np.vstack([outline.cone.axis, rim]))), np.ones(25)])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    half = float(np.mean(np.arccos(rays[1:] @ rays[0])))
    return dataclasses.replace(outline, cone=dataclasses.replace(outline.cone, axis=rays[0], half_angle_rad=half))


def pose_errors(estimated: Array, true: Array) -> Array:
    """Increments (N, 6) (d, w) from the true poses to the estimated ones."""
    turns = Rotation.from_matrix(estimated[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)).as_rotvec()
    return np.hstack([estimated[:, :3, 3] - true[:, :3, 3], turns])
