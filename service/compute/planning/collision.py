"""Collision checks of an arm with a camera on its flange: its surroundings and the arm itself, as capsules.

There are no meshes: a capsule around each link errs on the safe side by some centimetres. The checks keep plans free
of collisions; they are not a safety function.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from service.compute.arm_kinematics import chain
from service.compute.planning.capsules import segment_box_distance_m, segment_distance_m
from service.core.arms.model import ArmModel
from service.core.geometry import Array, Transform, apply, inverse
from service.core.units import mm


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
    others: tuple[tuple[str, Capsule], ...] = ()  # what else stands there, such as another arm, with its name


@dataclass(frozen=True, slots=True)
class ArmBody:
    """An arm with the camera on its flange."""

    model: ArmModel
    T_flange_camera: Transform = field(repr=False)
    camera: Capsule = field(repr=False)  # in the camera frame

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the links from the base on, and last the camera."""
        return (*(link.name for link in self.model.links), "camera")


@dataclass(frozen=True, slots=True)
class Contact:
    """The pair with the least clearance in a configuration."""

    first: str
    second: str
    clearance_m: float  # negative: depth of the overlap

    def __str__(self) -> str:
        """The contact in words, for a technician."""
        if self.clearance_m < 0:
            return f"the {self.first} would touch the {self.second}"
        return f"the {self.first} would come within {mm(self.clearance_m):.0f} mm of the {self.second}"


def link_segments(body: ArmBody, joints_rad: Array) -> tuple[Array, Array, Array]:
    """Capsules of the P parts at joints (K, N): starts (K, P, 3), ends (K, P, 3), radii (P,), in the base frame."""
    links, frames = body.model.links, chain(body.model.joint_values(joints_rad))
    T_base_part = np.concatenate(
        [frames[:, [link.frame for link in links]], frames[:, -1:] @ body.T_flange_camera], axis=1
    )
    R, t = T_base_part[:, :, :3, :3], T_base_part[:, :, :3, 3]
    starts = np.array([*(link.start_m for link in links), body.camera.start_m])
    ends = np.array([*(link.end_m for link in links), body.camera.end_m])
    radii = np.array([*(link.radius_m for link in links), body.camera.radius_m])
    return (R @ starts[..., None])[..., 0] + t, (R @ ends[..., None])[..., 0] + t, radii


def nearest_contacts(body: ArmBody, obstacles: Obstacles, joints_rad: Array) -> list[Contact]:
    """The pair with the least clearance at each of the joints (K, N), without pairs that the arm's model allows."""
    starts, ends, radii = link_segments(body, joints_rad)
    parts, allowed = body.parts, body.model.allowed
    pairs: list[tuple[str, str]] = []
    clearances: list[Array] = []

    def add(first: str, second: str, clearance: Array) -> None:
        pairs.append((first, second))
        clearances.append(clearance)

    between = [p for p in combinations(range(len(parts)), 2) if (parts[p[0]], parts[p[1]]) not in allowed]
    first, second = [i for i, _ in between], [j for _, j in between]
    gaps = segment_distance_m(starts[:, first], ends[:, first], starts[:, second], ends[:, second])
    for k, (i, j) in enumerate(between):
        add(parts[i], parts[j], gaps[:, k] - radii[i] - radii[j])
    T_specimen_base = inverse(obstacles.T_base_specimen)
    to_specimen = segment_box_distance_m(
        apply(T_specimen_base, starts), apply(T_specimen_base, ends), obstacles.specimen_half_m
    )
    for i, part in enumerate(parts):
        if (part, "table") not in allowed:
            lowest = np.minimum(starts[:, i, 2], ends[:, i, 2]) - radii[i]
            add(part, "table", lowest - obstacles.table_z_m)
        if (part, "specimen") not in allowed:
            add(part, "specimen", to_specimen[:, i] - radii[i])
        standing = [("spheres", sphere) for sphere in obstacles.spheres if (part, "spheres") not in allowed]
        if (part, "surroundings") not in allowed:
            standing += obstacles.others
        for name, capsule in standing:
            gap = segment_distance_m(starts[:, i], ends[:, i], capsule.start_m, capsule.end_m)
            add(part, name, gap - radii[i] - capsule.radius_m)
    table = np.stack(clearances)
    worst = table.argmin(axis=0)
    return [Contact(pairs[w][0], pairs[w][1], float(table[w, k])) for k, w in enumerate(worst)]


def straight_path(start_rad: Array, end_rad: Array, step_rad: float) -> Array:
    """Joints (K, N) on the straight path in joint space, both ends included, in steps of at most `step_rad`."""
    count = max(1, int(np.ceil(float(np.abs(end_rad - start_rad).max()) / step_rad)))
    return start_rad + np.linspace(0.0, 1.0, count + 1)[:, None] * (end_rad - start_rad)
