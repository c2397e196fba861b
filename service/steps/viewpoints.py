"""Where a protocol wants the camera: on arcs around the centre of the scene, and before the board."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from service.compute.photography import ViewRange
from service.core.errors import OrthocaptureError
from service.core.geometry import Array, Transform, inverse, look_at, rotation_about_z
from service.core.records.base import Record
from service.steps.context import StationLayout


class NoViewpointError(OrthocaptureError):
    """A viewpoint set has no viewpoint."""


class Arc(Record):
    """Viewpoints at one tilt from the vertical, evenly spread over an azimuth range.

    Azimuth 0 looks from the robot's side; tilt 0 looks straight down.
    """

    tilt_deg: float  # the angle from the vertical, 0 to 80
    azimuth_from_deg: float  # start of the range, from the robot's side
    azimuth_to_deg: float  # end of the range
    count: int  # viewpoints on the arc
    distance_m: float  # to the point aimed at, 0.2 to 2

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        if not (0 <= self.tilt_deg <= 80 and self.count >= 1 and 0.2 <= self.distance_m <= 2):
            raise ValueError("an arc needs tilt_deg 0…80, count ≥ 1 and distance_m 0.2…2")
        return self


class ViewpointSet(Record):
    """Arcs at one station, and how the camera is rolled and aimed."""

    station: str  # name in the rig file
    prefix: str  # the beginning of the viewpoints' names
    arcs: tuple[Arc, ...]  # the arcs on which the viewpoints lie
    rolls_deg: tuple[float, ...] = (0.0,)  # rolls of the camera, cycled over the viewpoints
    # Where the top of the image points: away from the base, natural for an arm's wrist, or upwards, as it does for a
    # camera beside a turntable.
    image_top: Literal["away", "up"] = "away"
    aim_spread_m: float = 0.0  # spread of the aim point around the scene centre (for board images)
    aim_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the aim point's offset, in the base frame

    @property
    def count(self) -> int:
        """Number of viewpoints of the set."""
        return sum(arc.count for arc in self.arcs)

    @model_validator(mode="after")
    def _has_a_top(self) -> Self:
        if self.image_top == "up" and any(arc.tilt_deg == 0 for arc in self.arcs):
            raise ValueError(
                "image_top: up needs arcs with tilt_deg above 0: straight down, nothing in an image is up"
            )
        return self


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """One pose for the camera."""

    name: str
    station: str
    T_base_camera: Transform
    joints_rad: Array | None = None  # (N,) as planned; None: the solution nearest to the present posture
    way_rad: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (M, N) of a detour, as in PlannedView
    from_rad: Array | None = None  # (N,) joints from which its way was planned; None: nobody planned one


_UP = np.array([0.0, 0.0, 1.0])
_DENSER_TILTS_DEG = (5.0, 15.0, 25.0, 35.0, 42.0)
_DENSER_AZIMUTHS_DEG = (-80.0, -60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0, 80.0)
_APART_M = 0.03  # views nearer than this to a planned one add little


def viewpoint_name(prefix: str, index: int) -> str:
    """Return the name of a planned viewpoint by its number in its set, from 0: `v1_001`."""
    return f"{prefix}{index + 1:03d}"


def plan_viewpoints(viewpoint_set: ViewpointSet, layout: StationLayout) -> tuple[Viewpoint, ...]:
    """Return all viewpoints of a set in the base frame of its station, in the order of capture.

    Raises NoViewpointError if the set is empty.
    """
    centre = np.array(layout.scene_centre_m) + np.array(viewpoint_set.aim_offset_m)
    approach = np.array(layout.approach)
    side = np.cross(_UP, approach)
    viewpoints: list[Viewpoint] = []
    for arc in viewpoint_set.arcs:
        azimuths = np.deg2rad(np.linspace(arc.azimuth_from_deg, arc.azimuth_to_deg, arc.count))
        if arc.count == 1:
            azimuths = np.deg2rad([(arc.azimuth_from_deg + arc.azimuth_to_deg) / 2])
        for azimuth in azimuths:
            i = len(viewpoints)
            horizontal = np.cos(azimuth) * approach + np.sin(azimuth) * side
            tilt = np.deg2rad(arc.tilt_deg)
            eye = centre + arc.distance_m * (np.cos(tilt) * _UP + np.sin(tilt) * horizontal)
            aim = centre + viewpoint_set.aim_spread_m * _spread(i, approach, side)
            roll = np.deg2rad(viewpoint_set.rolls_deg[i % len(viewpoint_set.rolls_deg)])
            top = _UP if viewpoint_set.image_top == "up" else -approach
            T_base_camera = look_at(eye, aim, top) @ rotation_about_z(roll)
            viewpoints.append(Viewpoint(viewpoint_name(viewpoint_set.prefix, i), layout.name, T_base_camera))
    if not viewpoints:
        raise NoViewpointError(
            f"viewpoint set {viewpoint_set.prefix!r} is empty", remedy="Give it at least one arc in the protocol"
        )
    return tuple(viewpoints)


def denser_viewpoints(viewpoint_set: ViewpointSet, layout: StationLayout) -> tuple[Viewpoint, ...]:
    """Return further viewpoints that a step may suggest: a grid of tilts and azimuths at the same distance.

    A viewpoint is named after its place, such as `v2_t25-40` for a tilt of 25° and an azimuth of −40°, so that names
    mean the same in every attempt.
    """
    distance_m = float(np.median([arc.distance_m for arc in viewpoint_set.arcs]))
    planned = [v.T_base_camera[:3, 3] for v in plan_viewpoints(viewpoint_set, layout)]
    out: list[Viewpoint] = []
    for tilt in _DENSER_TILTS_DEG:
        for azimuth in _DENSER_AZIMUTHS_DEG:
            arc = Arc(tilt_deg=tilt, azimuth_from_deg=azimuth, azimuth_to_deg=azimuth, count=1, distance_m=distance_m)
            single = viewpoint_set.model_copy(update={"arcs": (arc,), "rolls_deg": (0.0,), "aim_spread_m": 0.0})
            (viewpoint,) = plan_viewpoints(single, layout)
            eye = viewpoint.T_base_camera[:3, 3]
            if min(float(np.linalg.norm(eye - other)) for other in planned) > _APART_M:
                name = f"{viewpoint_set.prefix}t{tilt:02.0f}{azimuth:+03.0f}"
                out.append(Viewpoint(name, layout.name, viewpoint.T_base_camera))
    return tuple(out)


def flange_target(T_base_camera: Transform, T_flange_camera: Transform) -> Transform:
    """Return T_base_flange that puts the camera at T_base_camera."""
    return T_base_camera @ inverse(T_flange_camera)


def _spread(i: int, approach: Array, side: Array) -> Array:
    """Return a low-discrepancy offset in the horizontal plane, within ±1 (R2 sequence, Roberts 2018)."""
    u = (0.5 + 0.7548776662466927 * (i + 1)) % 1.0
    v = (0.5 + 0.5698402909980532 * (i + 1)) % 1.0
    return (2 * u - 1) * side + (2 * v - 1) * approach


# --- poses before the calibration board ----------------------------------------------------------------------------


class BoardPoses(Record):
    """Board images that the software plans: how many, from where, and what they must reach."""

    station: str  # the station where the images are taken
    prefix: str  # the beginning of the views' names
    count: Annotated[int, Field(ge=4, le=300)]  # the number of images
    # Tilt of the camera from the vertical.
    tilts_deg: tuple[Annotated[float, Field(ge=0, le=60)], ...] = ViewRange().tilts_deg
    rolls_deg: tuple[float, ...] = ViewRange().rolls_deg  # the camera's angles about its axis
    # Distance from the camera to the board.
    distances_m: tuple[Annotated[float, Field(ge=0.2, le=2)], ...] = ViewRange().distances_m
    above_scene_m: float = 0.09  # approximate height of the board above the scene's centre
    long_side: Literal["across", "along"] = "across"  # the board's direction, seen from the robot
    place_tolerance_mm: Annotated[float, Field(gt=0, le=100)] = 30.0  # the tolerance of the board's centre
    turn_tolerance_deg: Annotated[float, Field(gt=0, le=30)] = 10.0  # tolerance of the turn about the vertical
    coverage: Annotated[float, Field(gt=0, le=1)] = 0.97  # share of the image area that the planned images must cover
    replacements: Annotated[int, Field(ge=0, le=100)] = 12  # most per attempt, for images without a board

    @property
    def wishes(self) -> ViewRange:
        """The range of board views, as the planner takes it."""
        return ViewRange(self.tilts_deg, self.rolls_deg, self.distances_m)
