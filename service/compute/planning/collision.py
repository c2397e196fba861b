"""Collision checks of an arm with a camera on its flange: table, specimen, spheres and the arm itself, as capsules.

There are no meshes: a capsule around each link errs on the safe side by some centimetres. The checks keep plans free
of collisions; they are not a safety function.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from service.compute.arm.kinematics import ArmModel, chain
from service.compute.planning.capsules import segment_box_distance_m, segment_distance_m
from service.core.geometry import Array, Transform, apply, inverse
from service.core.units import mm

LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "camera")
# Neighbouring links touch by design, and the mount holds the camera beside the last two joints. Shoulder and base do
# not move relative to the table, so it is not checked against them.
ALLOWED_PAIRS = frozenset(
    {
        ("base", "shoulder"), ("base", "upper_arm"), ("shoulder", "upper_arm"), ("upper_arm", "forearm"),
        ("forearm", "wrist_1"), ("forearm", "wrist_2"), ("wrist_1", "wrist_2"), ("wrist_1", "wrist_3"),
        ("wrist_2", "wrist_3"), ("wrist_1", "camera"), ("wrist_2", "camera"), ("wrist_3", "camera"),
        ("base", "table"), ("shoulder", "table"), ("upper_arm", "table"),
        ("base", "specimen"), ("base", "spheres"),
    }
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within `radius_m` of the segment from `start_m` (3,) to `end_m` (3,)."""

    start_m: Array
    end_m: Array
    radius_m: float


@dataclass(frozen=True, slots=True)
class Obstacles:
    """The arm's surroundings, in its base frame."""

    table_z_m: float  # the table fills everything below
    T_base_specimen: Transform = field(repr=False)  # centre and axes of the specimen's bounding box
    specimen_half_m: Array  # (3,)
    spheres: tuple[Capsule, ...] = ()  # spheres and their posts, if known


@dataclass(frozen=True, slots=True)
class ArmBody:
    """An arm's capsules: DH parameters, radii, sideways offsets of the long links, and the camera on the flange."""

    model: ArmModel
    radii_m: tuple[float, float, float, float, float, float, float]  # of LINKS except the camera
    upper_arm_offset_m: float  # along the second axis, from the plane of the links in the DH model
    forearm_offset_m: float
    T_flange_camera: Transform = field(repr=False)
    camera: Capsule = field(repr=False)  # in the camera frame
    base_depth_m: float = 0.10  # pedestal top below the base frame


@dataclass(frozen=True, slots=True)
class Contact:
    """The pair with the least clearance in a configuration."""

    first: str
    second: str
    clearance_m: float  # negative: depth of the overlap

    def __str__(self) -> str:
        """The contact in words, for a technician."""
        if self.clearance_m < 0:
            return f"the {_words(self.first)} would touch the {_words(self.second)}"
        return (
            f"the {_words(self.first)} would come within {mm(self.clearance_m):.0f} mm of the {_words(self.second)}"
        )


def universal_robot_body(model: ArmModel, T_flange_camera: Transform, camera: Capsule) -> ArmBody:
    """Capsules for a Universal Robots arm, sized for the UR10e and scaled by the wrist's offset for others."""
    scale = float(model.d_m[3]) / 0.17415
    return ArmBody(
        model,
        tuple(scale * r for r in (0.095, 0.095, 0.075, 0.065, 0.055, 0.055, 0.05)),  # pyright: ignore[reportArgumentType] - seven in, seven out
        1.012 * float(model.d_m[3]),
        0.226 * float(model.d_m[3]),
        T_flange_camera,
        camera,
    )


def link_segments(body: ArmBody, joints_rad: Array) -> tuple[Array, Array, Array]:
    """Capsules of LINKS at joints (K, 6): starts (K, 8, 3), ends (K, 8, 3), radii (8,), in the base frame."""
    frames = chain(body.model.joint_values(joints_rad))
    o, z = frames[:, :, :3, 3], frames[:, :, :3, 2]
    upper, fore = body.upper_arm_offset_m * z[:, 1], body.forearm_offset_m * z[:, 1]
    zero = np.zeros_like(o[:, 0])
    T_base_camera = frames[:, 6] @ body.T_flange_camera
    R, t = T_base_camera[:, :3, :3], T_base_camera[:, :3, 3]
    ends = [
        (zero - np.array([0, 0, body.base_depth_m]), zero + np.array([0, 0, 0.05])),
        (o[:, 1], o[:, 1] + upper),
        (o[:, 1] + upper, o[:, 2] + upper),
        (o[:, 2] + fore, o[:, 3] + fore),
        (o[:, 3] + fore, o[:, 4]),
        (o[:, 4], o[:, 5]),
        (o[:, 5], o[:, 6]),
        (R @ body.camera.start_m + t, R @ body.camera.end_m + t),
    ]
    starts = np.stack([a for a, _ in ends], axis=1)
    return starts, np.stack([b for _, b in ends], axis=1), np.array([*body.radii_m, body.camera.radius_m])


def nearest_contacts(
    body: ArmBody, obstacles: Obstacles, joints_rad: Array, allowed: frozenset[tuple[str, str]] = ALLOWED_PAIRS
) -> list[Contact]:
    """The pair with the least clearance at each of the joints (K, 6), without allowed pairs."""
    starts, ends, radii = link_segments(body, joints_rad)
    pairs: list[tuple[str, str]] = []
    clearances: list[Array] = []

    def add(first: str, second: str, clearance: Array) -> None:
        pairs.append((first, second))
        clearances.append(clearance)

    T_specimen_base = inverse(obstacles.T_base_specimen)
    to_specimen = segment_box_distance_m(
        apply(T_specimen_base, starts), apply(T_specimen_base, ends), obstacles.specimen_half_m
    )
    between = [p for p in combinations(range(len(LINKS)), 2) if (LINKS[p[0]], LINKS[p[1]]) not in allowed]
    first, second = [i for i, _ in between], [j for _, j in between]
    gaps = segment_distance_m(starts[:, first], ends[:, first], starts[:, second], ends[:, second])
    for k, (i, j) in enumerate(between):
        add(LINKS[i], LINKS[j], gaps[:, k] - radii[i] - radii[j])
    for i, link in enumerate(LINKS):
        if (link, "table") not in allowed:
            lowest = np.minimum(starts[:, i, 2], ends[:, i, 2]) - radii[i]
            add(link, "table", lowest - obstacles.table_z_m)
        if (link, "specimen") not in allowed:
            add(link, "specimen", to_specimen[:, i] - radii[i])
        if (link, "spheres") not in allowed:
            for sphere in obstacles.spheres:
                gap = segment_distance_m(starts[:, i], ends[:, i], sphere.start_m, sphere.end_m)
                add(link, "spheres", gap - radii[i] - sphere.radius_m)
    table = np.stack(clearances)
    worst = table.argmin(axis=0)
    return [Contact(pairs[w][0], pairs[w][1], float(table[w, k])) for k, w in enumerate(worst)]


def straight_path(start_rad: Array, end_rad: Array, step_rad: float) -> Array:
    """Joints (K, 6) on the straight path in joint space, both ends included, in steps of at most `step_rad`."""
    count = max(1, int(np.ceil(float(np.abs(end_rad - start_rad).max()) / step_rad)))
    return start_rad + np.linspace(0.0, 1.0, count + 1)[:, None] * (end_rad - start_rad)


def _words(name: str) -> str:
    return name.replace("_", " ")
