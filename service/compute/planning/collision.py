"""Checks an arm and its surroundings for collisions, as capsules and boxes, and finds a way around what blocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from service.compute.arm_kinematics import chain
from service.core.arms import ArmModel
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
        """Describe the contact for a technician."""
        if self.clearance_m < 0:
            return f"the {self.first} would touch the {self.second}"
        return f"the {self.first} would come within {mm(self.clearance_m):.0f} mm of the {self.second}"


def link_segments(body: ArmBody, joints_rad: Array) -> tuple[Array, Array, Array]:
    """Return capsules of P parts at joints (K, N): starts, ends (K, P, 3) and radii (P,), in the base frame."""
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
    """Find the pair with the least clearance at each of the joints (K, N), except pairs that the model allows."""
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
    """Return joints (K, N) on the straight path in joint space, both ends included, at most `step_rad` apart."""
    count = max(1, int(np.ceil(float(np.abs(end_rad - start_rad).max()) / step_rad)))
    return start_rad + np.linspace(0.0, 1.0, count + 1)[:, None] * (end_rad - start_rad)


_TINY = 1e-15


def segment_distance_m(p0: Array, p1: Array, q0: Array, q1: Array) -> Array:
    """Return least distances (...,) between segments p0–p1 and q0–q1, (..., 3), broadcast; points are segments too.

    Source: C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    d1, d2, r = p1 - p0, q1 - q0, p0 - q0
    a, e, f = _dot(d1, d1), _dot(d2, d2), _dot(d2, r)
    b, c = _dot(d1, d2), _dot(d1, r)
    denominator = a * e - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(denominator > 1e-12 * a * e, (b * f - c * e) / denominator, 0.0)
        s = np.where(a > _TINY, np.clip(s, 0.0, 1.0), 0.0)
        t = np.where(e > _TINY, (b * s + f) / np.where(e > _TINY, e, 1.0), 0.0)
        # If t is outside its segment, it is clamped, and s is recomputed.
        clamped = np.clip(t, 0.0, 1.0)
        s = np.where(a > _TINY, np.clip((b * clamped - c) / np.where(a > _TINY, a, 1.0), 0.0, 1.0), 0.0)
    gap = r + s[..., None] * d1 - clamped[..., None] * d2
    return np.sqrt(_dot(gap, gap))


def segment_box_distance_m(p0: Array, p1: Array, half_extent_m: Array) -> Array:
    """Return the least distances (...,) of segments p0–p1 (..., 3) to a box around the origin; 0 for one within it.

    The distance to a convex body is convex along a segment, so ternary search finds its minimum, to a micrometre on
    segments of a metre.
    """
    low, high = (
        np.zeros(np.broadcast_shapes(p0.shape, p1.shape)[:-1]),
        np.ones(np.broadcast_shapes(p0.shape, p1.shape)[:-1]),
    )
    for _ in range(36):
        third = (high - low) / 3
        left, right = low + third, high - third
        nearer_left = _box(p0 + left[..., None] * (p1 - p0), half_extent_m) <= _box(
            p0 + right[..., None] * (p1 - p0), half_extent_m
        )
        high = np.where(nearer_left, right, high)
        low = np.where(nearer_left, low, left)
    middle = 0.5 * (low + high)
    return _box(p0 + middle[..., None] * (p1 - p0), half_extent_m)


def _box(points: Array, half_extent_m: Array) -> Array:
    outside = np.maximum(np.abs(points) - half_extent_m, 0.0)
    return np.sqrt(_dot(outside, outside))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b), dtype=np.float64)


#: Spacing of the configurations that are checked on a way.
PATH_STEP_RAD = float(np.radians(3.0))
_REACH_RAD = 0.6  # by how much a tree grows at once, along the joint that turns farthest
_BEYOND_RAD = 1.5  # beyond the two ends, joints are drawn within this
_MOST_DRAWS = 400
_SHORTENINGS = 60
_SEED = 7  # the same question always has the same answer


@dataclass(frozen=True, slots=True)
class Freedom:
    """The space in which an arm may be: the clearance that it must keep from everything, itself included."""

    body: ArmBody
    obstacles: Obstacles
    margin_m: float

    def obstruction(self, joints_rad: Array) -> str:
        """Name what it would come too near to at the worst of the joints (K, N); "" if it keeps clear."""
        if not len(joints_rad):
            return ""
        contacts = nearest_contacts(self.body, self.obstacles, joints_rad)
        worst = min(contacts, key=lambda contact: contact.clearance_m)
        return str(worst) if worst.clearance_m < self.margin_m else ""

    def obstruction_between(self, start_rad: Array, end_rad: Array) -> str:
        """Name what blocks the straight path between joints (N,). The ends are free, or the arm is already there."""
        return self.obstruction(straight_path(start_rad, end_rad, PATH_STEP_RAD)[1:-1])


def detour(start_rad: Array, end_rad: Array, freedom: Freedom) -> Array | None:
    """Return the joints (M, N) to go through from start to end (N,), each on a straight way; None if none was found.

    Two trees grow from the ends towards drawn joints and towards each other (RRT-Connect: Kuffner and LaValle, ICRA
    2000); the way is then shortened. It is deterministic. That none was found does not prove that there is none.
    """
    rng = np.random.default_rng(_SEED)
    limits = freedom.body.model.limits_rad
    low = np.maximum(np.minimum(start_rad, end_rad) - _BEYOND_RAD, -limits)
    high = np.minimum(np.maximum(start_rad, end_rad) + _BEYOND_RAD, limits)
    trees = _Tree.at(start_rad), _Tree.at(end_rad)
    for draw in range(_MOST_DRAWS):
        one, other = trees if draw % 2 == 0 else trees[::-1]
        grown = one.step(rng.uniform(low, high), freedom)
        if grown is None:
            continue
        met = other.meet(one.joints_rad[grown], freedom)
        if met is not None:
            ways = one.way_to(grown), other.way_to(met)
            first, last = ways if draw % 2 == 0 else ways[::-1]
            return _shortened(np.array([*first, *last[::-1][1:]]), freedom, rng)[1:-1]
    return None


@dataclass(slots=True)
class _Tree:
    """Joints that can be reached from the first, each straight from its parent."""

    joints_rad: list[Array]
    parents: list[int]

    @classmethod
    def at(cls, root_rad: Array) -> _Tree:
        return cls([root_rad], [-1])

    def step(self, towards_rad: Array, freedom: Freedom) -> int | None:
        """Grow by one branch towards joints (N,), not beyond; its index, None if it is blocked."""
        parent = self._nearest(towards_rad)
        there = self._reached(parent, towards_rad)
        way = straight_path(self.joints_rad[parent], there, PATH_STEP_RAD)[1:]
        return None if freedom.obstruction(way) else self._grown(there, parent)

    def meet(self, joints_rad: Array, freedom: Freedom) -> int | None:
        """Grow branch by branch as far as the joints (N,) of the other tree; their index here, None if blocked."""
        at = self._nearest(joints_rad)
        while True:
            there = self._reached(at, joints_rad)
            arrives = np.array_equal(there, joints_rad)
            # The other tree's joints are known to be free, or one of the ends, which are not looked at.
            way = straight_path(self.joints_rad[at], there, PATH_STEP_RAD)[1 : -1 if arrives else None]
            if freedom.obstruction(way):
                return None
            at = self._grown(there, at)
            if arrives:
                return at

    def _nearest(self, joints_rad: Array) -> int:
        return int(np.abs(np.array(self.joints_rad) - joints_rad).max(axis=1).argmin())

    def _reached(self, parent: int, towards_rad: Array) -> Array:
        away = towards_rad - self.joints_rad[parent]
        farthest = float(np.abs(away).max())
        return towards_rad if farthest <= _REACH_RAD else self.joints_rad[parent] + away * (_REACH_RAD / farthest)

    def _grown(self, joints_rad: Array, parent: int) -> int:
        self.joints_rad.append(joints_rad)
        self.parents.append(parent)
        return len(self.parents) - 1

    def way_to(self, index: int) -> list[Array]:
        """Return the joints from the first to this one."""
        way: list[Array] = []
        while index >= 0:
            way.append(self.joints_rad[index])
            index = self.parents[index]
        return way[::-1]


def _shortened(way: Array, freedom: Freedom, rng: np.random.Generator) -> Array:
    """Return the way (K, N) without joints that a straight way can leave out."""
    for _ in range(_SHORTENINGS):
        if len(way) < 3:
            return way
        i = int(rng.integers(0, len(way) - 2))
        j = int(rng.integers(i + 2, len(way)))
        if not freedom.obstruction_between(way[i], way[j]):
            way = np.concatenate([way[: i + 1], way[j:]])
    return way
