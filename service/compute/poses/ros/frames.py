"""The tree of frames of a recording, and poses in it at a time; nothing is interpolated unasked."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

from service.compute.poses.ros.messages import StampedTransform
from service.core.errors import DataError
from service.core.geometry import Transform, inverse, transform
from service.core.units import ms, seconds_of_ns


@dataclass(frozen=True, slots=True)
class Timing:
    """How a pose may be taken for a time that no message has.

    Attributes:
        within_ns: the nearest message may be so far away.
        interpolate: between the messages before and after, if these are not farther apart than `most_ns`.
        most_ns: see `interpolate`.
    """

    within_ns: int = 0
    interpolate: bool = False
    most_ns: int = 0


@dataclass(frozen=True, slots=True)
class FoundPose:
    """T_a_b (4, 4) at a time, and how it was found."""

    T_a_b: Transform
    away_ns: int  # of the farthest message that was taken for it
    interpolated: bool


class NoPoseError(Exception):
    """There is no pose at this time; says why in a sentence."""


@dataclass
class _Edge:
    parent: str
    static: bool
    stamps_ns: list[int] = field(default_factory=list[int])
    poses: list[Transform] = field(default_factory=list[Transform])
    ordered: bool = True


class FrameTree:
    """Frames and the transforms between them, from messages in any order."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._edges: dict[str, _Edge] = {}  # by child

    def add(self, found: StampedTransform, *, static: bool) -> None:
        """Add a transform. Raises DataError if its child has another parent."""
        edge = self._edges.setdefault(found.child, _Edge(found.parent, static))
        if edge.parent != found.parent or edge.static != static:
            raise DataError(
                f"the frame {found.child!r} has two parents, {edge.parent!r} and {found.parent!r}, or is once static "
                "and once not",
                where=self._where,
                remedy="Record one tree of frames",
            )
        if static:
            edge.stamps_ns, edge.poses = [0], [found.T_parent_child]
            return
        edge.ordered = edge.ordered and (not edge.stamps_ns or found.stamp_ns > edge.stamps_ns[-1])
        edge.stamps_ns.append(found.stamp_ns)
        edge.poses.append(found.T_parent_child)

    def frames(self) -> tuple[str, ...]:
        """The names of all frames, sorted."""
        return tuple(sorted({*self._edges, *(edge.parent for edge in self._edges.values())}))

    def is_static(self, a: str, b: str) -> bool:
        """Whether two frames do not move against each other. Raises as `pose` does."""
        up, down = self._between(a, b)
        return all(self._edges[child].static for child in (*up, *down))

    def pose(self, a: str, b: str, stamp_ns: int, timing: Timing) -> FoundPose:
        """T_a_b at a time.

        Raises:
            DataError: a frame is unknown, or the two are not connected.
            NoPoseError: a transform between them has no message that may be taken for this time.
        """
        up, down = self._between(a, b)
        away, interpolated = 0, False
        T_top = [np.eye(4), np.eye(4)]
        for side, chain in enumerate((up, down)):
            for child in chain:  # from the frame upwards
                found = self._at(child, stamp_ns, timing)
                T_top[side] = found.T_a_b @ T_top[side]
                away, interpolated = max(away, found.away_ns), interpolated or found.interpolated
        return FoundPose(inverse(T_top[0]) @ T_top[1], away, interpolated)

    def _between(self, a: str, b: str) -> tuple[list[str], list[str]]:
        """The children on the ways from a and from b up to their lowest common frame."""
        ways = [self._upwards(a), self._upwards(b)]
        while ways[0] and ways[1] and ways[0][-1] == ways[1][-1]:
            ways = [ways[0][:-1], ways[1][:-1]]
        tops = [self._edges[way[-1]].parent if way else frame for way, frame in zip(ways, (a, b), strict=True)]
        if tops[0] != tops[1]:
            raise DataError(
                f"the frames {a!r} and {b!r} are not connected (they end in {tops[0]!r} and {tops[1]!r})",
                where=self._where,
                remedy="Record the transforms between them too, also /tf_static",
            )
        return ways[0], ways[1]

    def _upwards(self, frame: str) -> list[str]:
        if frame not in self.frames():
            raise DataError(
                f"there is no frame {frame!r}; there are {', '.join(self.frames()) or 'none'}",
                where=self._where,
                remedy="Name one of these frames",
            )
        way: list[str] = []
        while frame in self._edges:
            if frame in way:
                raise DataError(f"the frame {frame!r} is above itself", where=self._where, remedy="Record a tree")
            way.append(frame)
            frame = self._edges[frame].parent
        return way

    def _at(self, child: str, stamp_ns: int, timing: Timing) -> FoundPose:
        edge = self._edges[child]
        if edge.static:
            return FoundPose(edge.poses[0], 0, interpolated=False)
        if not edge.ordered:
            order = sorted(range(len(edge.stamps_ns)), key=edge.stamps_ns.__getitem__)
            edge.stamps_ns = [edge.stamps_ns[k] for k in order]
            edge.poses = [edge.poses[k] for k in order]
            edge.ordered = True
        return _chosen(edge, child, stamp_ns, timing)


def _chosen(edge: _Edge, child: str, stamp_ns: int, timing: Timing) -> FoundPose:
    after = bisect_left(edge.stamps_ns, stamp_ns)
    near = [k for k in (after - 1, after) if 0 <= k < len(edge.stamps_ns)]
    best = min(near, key=lambda k: abs(edge.stamps_ns[k] - stamp_ns))
    away = abs(edge.stamps_ns[best] - stamp_ns)
    if away <= timing.within_ns:
        return FoundPose(edge.poses[best], away, interpolated=False)
    what = f"{edge.parent} → {child}: the nearest message is {ms(seconds_of_ns(away)):.3f} ms away"
    if not timing.interpolate:
        raise NoPoseError(what)
    if len(near) < 2:
        raise NoPoseError(f"{what}, and there is none on the other side")
    gap = edge.stamps_ns[after] - edge.stamps_ns[after - 1]
    if gap > timing.most_ns:
        raise NoPoseError(f"{what}, and those before and after are {ms(seconds_of_ns(gap)):.3f} ms apart")
    share = (stamp_ns - edge.stamps_ns[after - 1]) / gap
    T = _interpolated(edge.poses[after - 1], edge.poses[after], share)
    return FoundPose(T, max(abs(edge.stamps_ns[k] - stamp_ns) for k in near), interpolated=True)


def _interpolated(T_before: Transform, T_after: Transform, share: float) -> Transform:
    """The pose in between: the position on the line, the rotation about the axis that leads from one to the other."""
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415 - half a second

    turned = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([T_before[:3, :3], T_after[:3, :3]])))(share)
    return transform(turned, (1 - share) * T_before[:3, 3] + share * T_after[:3, 3])
