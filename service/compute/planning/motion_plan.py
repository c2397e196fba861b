"""Turns wanted camera poses into a motion: reachable, free of collisions, in focus and in a short order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal

import numpy as np

from service.compute.arm_kinematics import postures_near
from service.compute.planning.collision import ArmBody, Freedom, Obstacles, detour, nearest_contacts
from service.core.geometry import Array, Transform, apply, inverse, transform


@dataclass(frozen=True, slots=True)
class DepthOfField:
    """Distances along the optical axis within which a point is blurred no wider than the circle of confusion."""

    near_m: float
    far_m: float  # infinite if focused at the hyperfocal distance or beyond


def depth_of_field(
    focal_length_m: float, aperture_f: float, focus_distance_m: float, circle_of_confusion_m: float
) -> DepthOfField:
    """Compute near and far limit, in metres, for a thin lens focused at a distance from its entrance pupil.

    With H = f² / (N c) + f: near = s (H − f) / (H + s − 2 f), far = s (H − f) / (H − s).
    Source: S. F. Ray, Applied Photographic Optics, 3rd ed. 2002, chapter 22.
    """
    f, s = focal_length_m, focus_distance_m
    hyperfocal = f**2 / (aperture_f * circle_of_confusion_m) + f
    far = s * (hyperfocal - f) / (hyperfocal - s) if hyperfocal > s else float("inf")
    return DepthOfField(s * (hyperfocal - f) / (hyperfocal + s - 2 * f), far)


def depths_m(T_base_camera: Transform, points_base_m: Array) -> tuple[float, float]:
    """Return the least and greatest depth along the optical axis of points (N, 3) in base coordinates, metres."""
    depth = apply(inverse(T_base_camera), points_base_m)[:, 2]
    return float(np.min(depth)), float(np.max(depth))


Order = Literal["as_listed", "shortest"]
#: Called with the stage, done and total (0: unknown). What it raises ends the planning.
Progress = Callable[[str, int, int], None]

_NUDGES_DEG = tuple(sign * step for step in (2.5, 5.0, 7.5, 10.0, 12.5, 15.0) for sign in (1, -1))
_VIEWS_AT_ONCE = 16  # viewpoints that are checked together: one by one, most of the time goes into calls
_AT_ONCE = 24  # postures that are checked together: seven axes have hundreds for one pose
_MOST_WAYS = 36  # postures to which a way is looked for if the straight one to the best posture is blocked
_ROUND_POSTURES = 3  # postures of a viewpoint to which a detour is looked for
_VAIN_DETOURS = 12  # looked for in vain, a second each, after which a plan looks for no others
_ROOM_M = 0.05  # clearance beyond which more is not better
_ROOM_WEIGHT = 1.0  # rad²: cost of zero clearance, compared with squared joint travel


@dataclass(frozen=True, slots=True)
class PlanningScene:
    """Everything that a plan of motions depends on, in the station's base frame."""

    body: ArmBody
    obstacles: Obstacles
    centre_m: Array  # (3,) of the scene
    margin_m: float  # required clearance
    start_rad: Array  # (N,) current joints of the arm
    speed_rad_s: float
    acceleration_rad_s2: float
    sharp: DepthOfField | None = None
    must_be_sharp_m: Array = field(default_factory=lambda: np.zeros((0, 3)), repr=False)  # (N, 3) points
    pause_s: float = 0.0  # at each viewpoint

    @property
    def freedom(self) -> Freedom:
        """The space in which the arm may be."""
        return Freedom(self.body, self.obstacles, self.margin_m)


@dataclass(frozen=True, slots=True)
class PlannedView:
    """One viewpoint of a plan and its outcome."""

    name: str
    T_base_camera: Transform = field(repr=False)  # as planned, after nudging
    outcome: Literal["feasible", "nudged", "refused"]
    reason: str = ""  # of a nudge or a refusal
    nudge_deg: float = 0.0  # about the vertical through the scene's centre
    joints_rad: Array = field(default_factory=lambda: np.full(0, np.nan), repr=False)  # (N,); empty if refused
    travel_s: float = 0.0  # from the previous view
    from_rad: Array | None = None  # (N,) joints at which its way begins: those of the previous view, or of the start
    # (M, N) the joints of a detour, from those of the previous view on, to the last before this view's; straight from
    # each to the next. Empty if the way is straight.
    way_rad: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)


@dataclass(frozen=True, slots=True)
class MotionPlan:
    """Views in the planned order, then the refused ones."""

    views: tuple[PlannedView, ...]
    order: Order
    total_s: float
    listed_s: float  # time of the same views in the order of the list

    @property
    def feasible(self) -> tuple[PlannedView, ...]:
        """The views that will be taken."""
        return tuple(view for view in self.views if view.outcome != "refused")

    @property
    def refused(self) -> tuple[PlannedView, ...]:
        """The views that will not be taken."""
        return tuple(view for view in self.views if view.outcome == "refused")


def plan_motion(
    views: Sequence[tuple[str, Transform]],
    scene: PlanningScene,
    order: Order,
    progress: Progress = lambda _what, _done, _total: None,
) -> MotionPlan:
    """Check, nudge and order camera poses (name, T_base_camera).

    `progress` is called before each few viewpoints.

    A pose that is out of reach, in collision or out of focus is turned about the vertical through the scene's centre,
    by up to 15°, until it is feasible; otherwise it is refused with the reason of the original pose. A viewpoint
    whose straight path in joint space is blocked is taken in another posture, or by a detour, or else refused at its
    place in the order.
    """
    placed: list[PlannedView] = []
    for k in range(0, len(views), _VIEWS_AT_ONCE):
        progress("checking the viewpoints", k, len(views))
        some = views[k : k + _VIEWS_AT_ONCE]
        best = best_postures([T for _, T in some], scene)
        placed += [_place(name, T, joints, scene) for (name, T), joints in zip(some, best, strict=True)]
    able = [view for view in placed if view.outcome != "refused"]
    refused = [view for view in placed if view.outcome == "refused"]
    way = np.vstack([scene.start_rad, *(view.joints_rad for view in able)])
    sequence: Sequence[int] = range(len(able))
    if order == "shortest" and len(able) > 2:
        progress("finding a short way", 0, 0)
        sequence = shortest_order(travel_times_s(way, scene), lambda: progress("finding a short way", 0, 0))
    kept: list[PlannedView] = []
    here = scene.start_rad
    total, vain = 0.0, 0
    for number, i in enumerate(sequence):
        progress("checking the way between the viewpoints", number, len(able))
        blocked = scene.freedom.obstruction_between(here, able[i].joints_rad)
        free = _other_way(here, able[i], scene) if blocked else None
        if free is not None:
            able[i], blocked = replace(able[i], joints_rad=free), ""
        elif blocked and vain < _VAIN_DETOURS:
            round_about = _round_about(here, able[i], scene)
            vain += 0 if len(round_about.way_rad) else _ROUND_POSTURES
            able[i], blocked = round_about, "" if len(round_about.way_rad) else blocked
        if blocked:
            stands = scene.freedom.obstruction(here[None])
            reason = f"where the arm stands, {stands}: move it clear by its pendant" if stands else ""
            refused.append(replace(able[i], outcome="refused", reason=reason or f"on the way there {blocked}"))
            continue
        legs = [*able[i].way_rad, able[i].joints_rad] if len(able[i].way_rad) else [here, able[i].joints_rad]
        travel_s = float(_legs_s(np.stack(legs), scene).sum())
        kept.append(replace(able[i], travel_s=travel_s, from_rad=here))
        total += travel_s + scene.pause_s
        here = able[i].joints_rad
    listed_s = float(_legs_s(way, scene).sum())
    return MotionPlan((*kept, *refused), order, total, listed_s + scene.pause_s * len(able))


def infeasible_reason(T_base_camera: Transform, joints_rad: Array | None, scene: PlanningScene) -> str:
    """Return why a pose cannot be taken; "" if it can."""
    if joints_rad is None:
        return "the arm does not reach it"
    contact = nearest_contacts(scene.body, scene.obstacles, joints_rad[None])[0]
    return str(contact) if contact.clearance_m < scene.margin_m else _blurred(T_base_camera, scene)


def _blurred(T_base_camera: Transform, scene: PlanningScene) -> str:
    if scene.sharp is not None and len(scene.must_be_sharp_m):
        near, far = depths_m(T_base_camera, scene.must_be_sharp_m)
        if near < scene.sharp.near_m or far > scene.sharp.far_m:
            return (
                f"the scene lies {near:.2f} to {far:.2f} m from the camera, "
                f"the sharp range is {scene.sharp.near_m:.2f} to {scene.sharp.far_m:.2f} m"
            )
    return ""


def travel_times_s(joints_rad: Array, scene: PlanningScene) -> Array:
    """Return (K, K) times between joint positions (K, N), by the farthest turn: ramp up, constant, ramp down."""
    distance = np.zeros((len(joints_rad), len(joints_rad)))
    for turns in joints_rad.T:
        np.maximum(distance, np.abs(turns[:, None] - turns[None]), out=distance)
    return turn_times_s(distance, scene.speed_rad_s, scene.acceleration_rad_s2)


def _legs_s(joints_rad: Array, scene: PlanningScene) -> Array:
    """Return (K - 1,) time from each of the joint positions (K, N) to the next."""
    turns = np.abs(np.diff(joints_rad, axis=0)).max(axis=1)
    return turn_times_s(turns, scene.speed_rad_s, scene.acceleration_rad_s2)


def turn_times_s(turns_rad: Array, speed_rad_s: float, acceleration_rad_s2: float) -> Array:
    """Return the time for joints to turn by angles of any shape: ramp up, constant speed if reached, ramp down."""
    v, a = speed_rad_s, acceleration_rad_s2
    return np.where(turns_rad > v**2 / a, turns_rad / v + v / a, 2 * np.sqrt(turns_rad / a))


def shortest_order(times_s: Array, working: Callable[[], None] = lambda: None) -> list[int]:
    """Find a short open path from node 0 through all others, for times (K + 1, K + 1); indices 0 … K − 1 of them.

    Starts from the better of the listed order and the nearest-neighbour order and improves it by 2-opt until no
    reversal helps. It is deterministic and never longer than the listed order. `working` is called again and again.
    """
    count = len(times_s) - 1
    paths = [list(range(1, count + 1)), _nearest_neighbours(times_s)]
    best = min((_two_opt(path, times_s, working) for path in paths), key=lambda path: _length(path, times_s))
    return [node - 1 for node in best]


def _nearest_neighbours(times_s: Array) -> list[int]:
    left, path, here = np.arange(1, len(times_s)), list[int](), 0
    while len(left):
        nearest = int(times_s[here, left].argmin())  # the first of several
        here = int(left[nearest])
        left = np.delete(left, nearest)
        path.append(here)
    return path


def _two_opt(path: Sequence[int], times_s: Array, working: Callable[[], None]) -> list[int]:
    nodes = np.array(path)
    improved = True
    while improved:
        improved = False
        for i in range(len(nodes) - 1):
            working()
            before = nodes[i - 1] if i else 0
            leaving_s = np.append(times_s[nodes[i + 1 : -1], nodes[i + 2 :]], 0.0)  # the last has no successor
            j = i + 1
            while j < len(nodes):  # each later node, as the end of a stretch that is reversed if that helps
                old = times_s[before, nodes[i]] + leaving_s[j - i - 1 :]
                new = times_s[before, nodes[j:]] + np.append(times_s[nodes[i], nodes[j + 1 :]], 0.0)
                better = new < old - 1e-9
                if not better.any():
                    break
                j += int(better.argmax())
                nodes[i : j + 1] = nodes[i : j + 1][::-1].copy()
                improved = True
                j += 1
    return [int(node) for node in nodes]


def _length(path: Sequence[int], times_s: Array) -> float:
    return float(sum(times_s[a, b] for a, b in zip([0, *path], path)))  # noqa: B905 - the last has no successor


def _place(name: str, T_base_camera: Transform, best: Array | None, scene: PlanningScene) -> PlannedView:
    """Return the view with its best posture (N,); without one, turned until there is one, or refused."""
    if best is not None:
        return PlannedView(name, T_base_camera, "feasible", joints_rad=best)
    nearest = next(iter(_postures(T_base_camera, scene)), None)
    reason = infeasible_reason(T_base_camera, nearest, scene)
    for nudge in _NUDGES_DEG:
        turned = turned_about_scene(T_base_camera, scene.centre_m, float(np.radians(nudge)))
        best = best_posture(turned, scene)
        if best is not None:
            return PlannedView(name, turned, "nudged", reason, nudge, best)
    return PlannedView(name, T_base_camera, "refused", reason)


def turned_about_scene(T_base_camera: Transform, centre_m: Array, angle_rad: float) -> Transform:
    """Return the camera pose turned about the vertical through the scene's centre."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return transform(R, centre_m - R @ centre_m) @ T_base_camera


def _postures(T_base_camera: Transform, scene: PlanningScene) -> Array:
    """Return the joints (K, N) that reach a pose, those nearest to the arm's current ones first."""
    T_base_flange = T_base_camera @ inverse(scene.body.T_flange_camera)
    return postures_near(scene.body.model, T_base_flange, scene.start_rad)


def able_postures(T_base_camera: Transform, scene: PlanningScene) -> Iterator[Array]:
    """Yield the joints (N,) that reach a pose free of collisions and in focus, the best ones first.

    With six axes these are nearest to the arm's current ones. With seven, whose elbow is free, more clearance also
    counts, among postures about equally near.
    """
    if _blurred(T_base_camera, scene):
        return
    found = _postures(T_base_camera, scene)
    for k in range(0, len(found), _AT_ONCE):
        some = found[k : k + _AT_ONCE]
        yield from _able(some, _clearances_m(some, scene), scene)


def _able(postures_rad: Array, clearances_m: Array, scene: PlanningScene) -> Iterator[Array]:
    """Yield those of the postures (K, N), with clearances (K,), that have enough of it, the best ones first."""
    order = range(len(postures_rad))
    if scene.body.model.axes > 6:  # the elbow is free
        tight = np.clip(1 - (clearances_m - scene.margin_m) / _ROOM_M, 0, None)
        away = np.sum((postures_rad - scene.start_rad) ** 2, axis=1)
        order = [int(i) for i in np.argsort(away + _ROOM_WEIGHT * tight**2, kind="stable")]
    yield from (postures_rad[i] for i in order if clearances_m[i] >= scene.margin_m)


def _clearances_m(postures_rad: Array, scene: PlanningScene) -> Array:
    """Return the clearance (K,) at each of the postures (K, N)."""
    contacts = nearest_contacts(scene.body, scene.obstacles, postures_rad)
    return np.array([contact.clearance_m for contact in contacts])


def best_postures(T_base_camera: Sequence[Transform], scene: PlanningScene) -> list[Array | None]:
    """Find `best_posture` of each of several poses, whose postures are checked together, which takes less time."""
    found = [_postures(T, scene) for T in T_base_camera]
    first = [postures_rad[:_AT_ONCE] for postures_rad in found]
    ends = np.cumsum([len(some) for some in first])[:-1]
    clearances = np.split(_clearances_m(np.concatenate(first), scene), ends)
    best: list[Array | None] = []
    for T, every, some, clearances_m in zip(T_base_camera, found, first, clearances, strict=True):
        able = None if _blurred(T, scene) else next(_able(some, clearances_m, scene), None)
        best.append(best_posture(T, scene) if able is None and len(every) > len(some) else able)
    return best


def best_posture(T_base_camera: Transform, scene: PlanningScene) -> Array | None:
    """Return the best of `able_postures`; None if there is none."""
    return next(able_postures(T_base_camera, scene), None)


def _other_way(here: Array, view: PlannedView, scene: PlanningScene) -> Array | None:
    """Find joints (N,) of another posture for a view, reached straight from `here`; None if there is none."""
    others = islice(able_postures(view.T_base_camera, scene), 1, _MOST_WAYS)
    return next((q for q in others if not scene.freedom.obstruction_between(here, q)), None)


def _round_about(here: Array, view: PlannedView, scene: PlanningScene) -> PlannedView:
    """Return the view with a detour from `here`, in its first posture to which one is found; else as it is."""
    for joints_rad in islice(able_postures(view.T_base_camera, scene), _ROUND_POSTURES):
        between = detour(here, joints_rad, scene.freedom)
        if between is not None:
            return replace(view, joints_rad=joints_rad, way_rad=np.concatenate([here[None], between]))
    return view
