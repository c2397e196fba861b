"""A way around what blocks the straight one, in joint space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.compute.planning.collision import ArmBody, Obstacles, nearest_contacts, straight_path
from service.core.geometry import Array

#: Spacing of the configurations that are checked on a way.
PATH_STEP_RAD = float(np.radians(3.0))
_REACH_RAD = 0.6  # by how much a tree grows at once, along the joint that turns farthest
_BEYOND_RAD = 1.5  # beyond the two ends, joints are drawn within this
_MOST_DRAWS = 400
_SHORTENINGS = 60
_SEED = 7  # the same question always has the same answer


@dataclass(frozen=True, slots=True)
class Freedom:
    """Where an arm may be: the clearance that it must keep from everything, itself included."""

    body: ArmBody
    obstacles: Obstacles
    margin_m: float

    def obstruction(self, joints_rad: Array) -> str:
        """What it would come too near to at the worst of the joints (K, N), in words; "" if it keeps clear."""
        if not len(joints_rad):
            return ""
        contacts = nearest_contacts(self.body, self.obstacles, joints_rad)
        worst = min(contacts, key=lambda contact: contact.clearance_m)
        return str(worst) if worst.clearance_m < self.margin_m else ""

    def obstruction_between(self, start_rad: Array, end_rad: Array) -> str:
        """What blocks the straight way between two joints (N,). The ends are free, or the arm is there already."""
        return self.obstruction(straight_path(start_rad, end_rad, PATH_STEP_RAD)[1:-1])


def detour(start_rad: Array, end_rad: Array, freedom: Freedom) -> Array | None:
    """Joints (M, N) to go through from start to end (N,), each on a straight way; None if none was found.

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
        """The joints from the first to this one."""
        way: list[Array] = []
        while index >= 0:
            way.append(self.joints_rad[index])
            index = self.parents[index]
        return way[::-1]


def _shortened(way: Array, freedom: Freedom, rng: np.random.Generator) -> Array:
    """The way (K, N) without joints that a straight way can leave out."""
    for _ in range(_SHORTENINGS):
        if len(way) < 3:
            return way
        i = int(rng.integers(0, len(way) - 2))
        j = int(rng.integers(i + 2, len(way)))
        if not freedom.obstruction_between(way[i], way[j]):
            way = np.concatenate([way[: i + 1], way[j:]])
    return way
