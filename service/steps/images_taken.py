"""Counts the images of a step: one number for header, notices, capture page, report and audit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from service.core.protocol.models import Step
from service.core.recovery import planned_views
from service.core.run.state import StepState
from service.steps.notes import board_plans, suggested_views
from service.steps.viewpoints import viewpoint_name


@dataclass(frozen=True, slots=True)
class ImagesTaken:
    """The images of a step that count now, and of how many: those planned, asked for since, given up, or taken."""

    taken: int
    known: int  # 0: nothing is planned, as where a person chooses the views
    given_up: int = 0

    @property
    def to_come(self) -> int:
        """How many are still to come."""
        return max(self.known - self.taken - self.given_up, 0)


def images_taken(step: Step, now: StepState) -> ImagesTaken:
    """Return the count of a step; images that were replaced, or belong to an attempt that was, do not count."""
    planned = planned_views(step)
    if not planned:
        return ImagesTaken(len(now.captured), 0)
    sets: tuple[Any, ...] = getattr(step.params, "viewpoints", ()) or ()
    names = {viewpoint_name(planned_set.prefix, i) for planned_set in sets for i in range(planned_set.count)}
    names |= {pose.viewpoint for plan in board_plans(now) for pose in plan.poses}
    names |= {view.viewpoint for note in suggested_views(now) for view in note.viewpoints}
    names |= {*now.captured, *now.skipped_viewpoints, *now.viewpoint_failures}
    return ImagesTaken(len(now.captured), max(planned, len(names)), len(set(now.skipped_viewpoints)))
