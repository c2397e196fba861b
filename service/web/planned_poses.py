"""Planned camera poses and their stations, computed without any device."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from threading import Lock

import numpy as np

from service.core.geometry import Transform
from service.core.protocol import Step
from service.followed_run import RunRecord
from service.steps.context import StationLayout
from service.steps.kinds import calibration
from service.steps.notes import BOARD_POSES, SUGGESTION, board_plans, suggested_views
from service.steps.viewpoints import Viewpoint, ViewpointSet, denser_viewpoints, plan_viewpoints
from service.web.images import recorded_rig_section

Vector = tuple[float, float, float]
_lock = Lock()


@dataclass(frozen=True, slots=True)
class PlannedPose:
    """A camera pose in the base frame of its station: where it is and where it looks."""

    name: str
    station: str
    position_m: Vector
    looks: Vector  # unit vector of the optical axis


@dataclass(frozen=True, slots=True)
class StationPlan:
    """A station, as needed to draw a plan of it."""

    layout: StationLayout
    specimen_m: tuple[float, float]  # size along the approach, and across it


def station_of(log: RunRecord, name: str) -> StationPlan | None:
    """Return a station of the rig as it was when the run began; None if the rig has no such station."""
    section = recorded_rig_section(log)
    there = section.stations.get(name)
    if there is None:
        return None
    azimuth = math.radians(there.approach_azimuth_deg)
    layout = StationLayout(name, there.robot, there.scene_centre_m, (math.cos(azimuth), math.sin(azimuth), 0.0))
    size = section.collision.specimen_size_m
    return StationPlan(layout, (size[0], size[1]))


def planned_poses(log: RunRecord, step: Step) -> tuple[Viewpoint, ...]:
    """Return the viewpoints of the protocol, then those that an attempt of the step has suggested."""
    return _planned(log, step)[0]


def planned_viewpoints(log: RunRecord, step: Step) -> tuple[PlannedPose, ...]:
    """Return positions and viewing directions of the planned poses."""
    return _planned(log, step)[1]


_known: OrderedDict[tuple[str, str, tuple[int, ...]], tuple[tuple[Viewpoint, ...], tuple[PlannedPose, ...]]] = (
    OrderedDict()
)
_KNOWN = 32  # plans that are kept: pages of a run under way ask for the same one again and again
_OF_PLANS = (BOARD_POSES, SUGGESTION)


def _planned(log: RunRecord, step: Step) -> tuple[tuple[Viewpoint, ...], tuple[PlannedPose, ...]]:
    """Compute poses once for each first event (protocol, rig) and set of the step's notes: these determine them."""
    notes = tuple(note.seq for note in log.state.steps[step.id].notes if note.note in _OF_PLANS)
    key = (log.events[0].sha256, step.id, notes)
    with _lock:
        if key in _known:
            _known.move_to_end(key)
            return _known[key]
    poses = _computed_poses(log, step)
    computed = poses, tuple(PlannedPose(v.name, v.station, *place(v.T_base_camera)) for v in poses)
    with _lock:
        _known[key] = computed
        while len(_known) > _KNOWN:
            _known.popitem(last=False)
    return computed


def _computed_poses(log: RunRecord, step: Step) -> tuple[Viewpoint, ...]:
    sets: tuple[ViewpointSet, ...] = getattr(step.params, "viewpoints", ())
    board = step.params.board_poses if isinstance(step.params, calibration.Params) else None
    out: list[Viewpoint] = []
    for viewpoint_set in sets:
        station = station_of(log, viewpoint_set.station)
        if station is not None:
            out += plan_viewpoints(viewpoint_set, station.layout)
    state = log.state.steps[step.id]
    for plan in board_plans(state):
        there = board.station if board is not None else next(iter(sets)).station
        out += [Viewpoint(pose.viewpoint, there, np.array(pose.T_base_camera)) for pose in plan.poses]
    wanted = {view.viewpoint for note in suggested_views(state) for view in note.viewpoints}
    for viewpoint_set in sets[-1:]:
        last = station_of(log, viewpoint_set.station)
        if wanted and last is not None:
            out += [v for v in denser_viewpoints(viewpoint_set, last.layout) if v.name in wanted]
    return tuple(out)


def place(T_base_camera: Transform) -> tuple[Vector, Vector]:
    """Return the position and optical axis of a camera pose."""
    return _vector(T_base_camera[:3, 3]), _vector(T_base_camera[:3, 2])


def nominal_T_flange_camera(log: RunRecord) -> tuple[tuple[float, float, float, float], ...] | None:
    """Return T_flange_camera by the design of the camera's mount; None if the rig file does not state it."""
    return recorded_rig_section(log).T_flange_camera_nominal


def _vector(values: Transform) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z
