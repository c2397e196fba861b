"""Single views of a structured-light sensor: what each of its pixels measures of the scene, in the sensor's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from simulators.geometry import Array, apply, look_at
from simulators.scene.world import SCENE_CENTRE_M, Scene

NOISE_M = 0.05e-3
_BASELINE_M = 0.10  # between projector and camera; a point must be visible from both
_DISTANCE_M = 0.80
_HALF_FIELD = 0.36  # tangent of half the horizontal field of view
_MOST_GRAZING = 0.25  # cosine of incidence below which nothing is measured
_GLOSSY = 0.60  # the same on wet tissue and steel without scanning spray
_AROUND = (0.0, 0.0), (32.0, 20.0), (32.0, 140.0), (32.0, 260.0)  # tilt and azimuth of the sensor's places, degrees
_CLEAR_M = 0.3e-3  # above the surface, where its shadow rays begin


@dataclass(frozen=True, slots=True)
class SensorView:
    """One view.

    Attributes:
        points_m: (rows, columns, 3) in the sensor's frame, which looks along +z; NaN where nothing was measured.
        normals: (rows, columns, 3), likewise.
        T_world_sensor: (4, 4), the truth.
    """

    points_m: Array
    normals: Array
    T_world_sensor: Array


def sensor_pose(index: int) -> Array:
    """T_world_sensor of the nth place around the scene, from above and then from three sides."""
    tilt, azimuth = np.radians(_AROUND[index % len(_AROUND)])
    out = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    return look_at(SCENE_CENTRE_M + _DISTANCE_M * out, SCENE_CENTRE_M, np.array([0.0, 1.0, 0.0]))


def sensor_view(
    scene: Scene, T_world_sensor: Array, columns: int, rows: int, *, spray: bool, control_spheres: bool, nth: int
) -> SensorView:
    """Measure a view of the scene with noise along the lines of sight; `nth` seeds the noise."""
    parts = scene.parts(control_spheres)
    offsets = np.cumsum([0, *(len(part.faces) for part in parts)])
    vertices, faces = scene.solid_mesh(control_spheres)
    embree = EmbreeScene()
    mesh = TriangleMesh(embree, vertices[faces].astype(np.float32))
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, columns), np.linspace(-1.0, 1.0, rows) * rows / columns)
    ray = np.stack([_HALF_FIELD * x, _HALF_FIELD * y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    direction = ray @ T_world_sensor[:3, :3].T
    eye = T_world_sensor[:3, 3]
    hit = embree.run(np.broadcast_to(eye, ray.shape).astype(np.float32), direction.astype(np.float32), output=1)
    found = np.asarray(hit["primID"]) >= 0
    normal = np.asarray(hit["Ng"], dtype=np.float64)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    depth = np.where(found, np.asarray(hit["tfar"], dtype=np.float64), 0.0)
    world = eye + depth[:, None] * direction
    projector = apply(T_world_sensor, np.array([[_BASELINE_M, 0.0, 0.0]]))[0]
    back = projector - world
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    start = (world + _CLEAR_M * back).astype(np.float32)
    found &= np.asarray(embree.run(start, back.astype(np.float32), query="OCCLUDED")) != 0
    material = np.searchsorted(offsets, np.asarray(hit["primID"]), side="right") - 1
    shiny = np.array([part.material in ("specimen", "steel") and not spray for part in parts])[material]
    cosine = np.minimum(-np.sum(normal * direction, axis=1), np.sum(normal * back, axis=1))
    found &= cosine > np.where(shiny, _GLOSSY, _MOST_GRAZING)
    noise = NOISE_M * np.random.default_rng([scene.seed, 0x51E3, nth]).standard_normal(len(ray))
    points = np.where(found[:, None], ray * (depth + noise)[:, None], np.nan)
    own = np.where(found[:, None], normal @ T_world_sensor[:3, :3], np.nan)
    del mesh
    return SensorView(points.reshape(rows, columns, 3), own.reshape(rows, columns, 3), T_world_sensor)
