"""Notes of steps that decisions and estimates depend on: advice that mends an attempt, and the motions planned."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

MOTION_PLAN = "motion_plan"  # name of the note


class _NoteRecord(BaseModel):
    model_config = ConfigDict(frozen=True)


class HandWork(_NoteRecord):
    """The work that a technician should do by hand, for a simulated one; further fields are those of the action."""

    model_config = ConfigDict(frozen=True, extra="allow")

    action: str  # its name in simulators/rig/world_server.py


class Mending(_NoteRecord):
    """A way to bring an attempt of a step within its limits.

    Attributes:
        advice: the advice to the technician.
        title: the request in few words, where it is the normal course of the step and nothing went wrong.
        does: the effect of the next confirmation in that case, as a button's label; "" where something went wrong.
        hands: the same for a simulated technician.
        viewpoints: further views that a retry takes; only their number counts.
        poses: further poses above the calibration board; only their number counts.
        images: number of images that a retry takes again.
    """

    advice: str = ""
    title: str = ""
    does: str = ""
    hands: tuple[HandWork, ...] = ()
    viewpoints: tuple[object, ...] = ()
    poses: tuple[object, ...] = ()
    images: int = 0


class NotedView(_NoteRecord):
    """A viewpoint in a motion plan.

    Attributes:
        viewpoint: its name.
        outcome: the planner's answer: feasible, nudged, or refused where the arm cannot take it.
        reason: the reason of a refusal.
        nudge_deg: the angle by which it was turned along its arc so that the arm can take it.
        joints_rad: the arm's joints there; None if refused.
        travel_s: the travel time from the view before.
        way_rad: joints of a detour, from those of the view before to the last before this view's; empty if straight.
    """

    viewpoint: str
    outcome: str
    reason: str = ""
    nudge_deg: float = 0.0
    joints_rad: tuple[float, ...] | None = None
    travel_s: float = 0.0
    way_rad: tuple[tuple[float, ...], ...] = ()


class NotedStation(_NoteRecord):
    """The viewpoints of one station in the order of capture, and how long all of them take."""

    station: str = ""
    order: str = ""
    estimated_s: float = 0.0
    views: tuple[NotedView, ...]


class NotedMotionPlan(_NoteRecord):
    """The arm's motion in a capture."""

    stations: tuple[NotedStation, ...] = ()

    @property
    def views(self) -> tuple[NotedView, ...]:
        """All viewpoints in the order of capture."""
        return tuple(view for station in self.stations for view in station.views)

    @property
    def view_s(self) -> float | None:
        """Estimated seconds for one view; None without a plan."""
        total_s = sum(station.estimated_s for station in self.stations)
        able = sum(view.outcome != "refused" for view in self.views)
        return total_s / able if total_s > 0 and able else None
