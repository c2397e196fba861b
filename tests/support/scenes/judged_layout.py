"""Judges random layouts of spheres as the layout step does, from simulated outlines in photographs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.layout.ambiguity import check_layout, layout_bounds
from service.compute.layout.photographs import LensPrior, SpherePhotograph, layout_from_photographs
from service.compute.markers.cones import Cone, cone_of_sphere, fit_cone
from simulators.geometry import apply, inverse
from simulators.rig.world_server import HELD_CAMERAS
from simulators.scene.world import RADIUS_M, Scene

Array = NDArray[np.float64]
NOMINAL = CameraModel(1920, 1280, 50 / 35.7 * 1920, 50 / 35.7 * 1920, 959.5, 639.5)
NOISE_PX, BIAS_PX, STATED_PX = 0.053, -0.021, 0.044  # outlines at 1920 px: rms with chi² 1.46, and common bias
_RIM: Array = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result for one layout."""

    kind: str
    seed: int
    margin_mm: float  # ground truth
    good: bool  # ground truth: every value is within its limit
    passed: bool
    photographs: int
    decided: bool


def layout_of(kind: str, rng: np.random.Generator, scene: Scene) -> Array:
    """Centres (13, 3): ten spheres around the specimen as somebody may place them, three on it."""
    if kind == "simulated scene":
        return np.concatenate([scene.registration_m, scene.control_m])
    turn = np.arange(10) * (2 * np.pi / 10) + rng.uniform(0, 0.6)
    heights = np.array([0.045, 0.085] * 5)
    if kind == "irregular":
        turn = turn + rng.uniform(-0.22, 0.22, 10)
        heights = rng.uniform(0.034, 0.108, 10)
    ring = np.stack([0.19 * np.cos(turn), 0.125 * np.sin(turn), heights], axis=1)
    spread = {"regular": 0.0003, "nearly regular": 0.003, "irregular": 0.006}[kind]
    return np.concatenate([ring + rng.normal(0, spread, ring.shape), scene.control_m])


def photograph(world: Array, T_world_camera: Array, lens: CameraModel, rng: np.random.Generator) -> SpherePhotograph:
    """Outlines of all spheres as read with the nominal camera, in any order."""
    cones: list[Cone] = []
    for centre in apply(inverse(T_world_camera), world)[rng.permutation(len(world))]:
        true = cone_of_sphere(centre, RADIUS_M)
        rim = lens.project(true.rays(_RIM, np.full_like(_RIM, true.half_angle_rad)))
        rays = np.column_stack([NOMINAL.normalise(rim), np.ones(len(_RIM))])
        cone = fit_cone(rays / np.linalg.norm(rays, axis=1, keepdims=True), np.ones(len(_RIM)), true, 8)
        shift = rng.normal(0.0, NOISE_PX / NOMINAL.fx, 3)
        axis = cone.axis + cone.frame()[:, :2] @ shift[:2]
        half = cone.half_angle_rad + float(shift[2]) + BIAS_PX / NOMINAL.fx
        cones.append(Cone(axis / np.linalg.norm(axis), half))
    return SpherePhotograph(
        NOMINAL, tuple(cones), np.tile((STATED_PX / NOMINAL.fx) ** 2 * np.eye(3), (len(cones), 1, 1))
    )


def judge(kind: str, seed: int) -> Outcome:
    """Judge one layout, from its first photograph to its verdict."""
    rng = np.random.default_rng([seed, 0x1A90])
    scene = Scene.generate(seed)
    world = layout_of(kind, rng, scene)
    lens = CameraModel.from_record(scene.camera_intrinsics(1920).to_json())
    truth = check_layout(world)
    good = all(bounded.value_m >= limit for bounded, limit in layout_bounds(truth).values())
    photographs: list[SpherePhotograph] = []
    passed = failed = False
    for T_world_held in HELD_CAMERAS.values():
        jitter = rng.normal(0.0, 0.01, 3)
        T = T_world_held.copy()
        T[:3, 3] += jitter
        photographs.append(photograph(world, T, lens, rng))
        found = layout_from_photographs(photographs, RADIUS_M, LensPrior(), len(world))
        bounds = layout_bounds(check_layout(found.centres_m, found.covariance)).values()
        passed = all(bounded.lower_m >= limit for bounded, limit in bounds)
        failed = any(bounded.upper_m < limit for bounded, limit in bounds)
        if passed or failed:
            break
    return Outcome(kind, seed, 1e3 * truth.margin_m, good, passed, len(photographs), passed or failed)
