"""Notes of steps that other steps and pages read, as typed records, and the number of a step's images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from service.computations.live import Suggestion
from service.computations.records import Matrix
from service.core.protocol import Step
from service.core.recovery import planned_views
from service.core.run.state import StepState
from service.core.words import counted
from service.steps.viewpoints import viewpoint_name

BOARD_POSES, SUGGESTION = "board_poses", "suggested_viewpoints"
SPOILT = "spoilt images"  # images that a retry of the step repeats
DEIDENTIFIED = "personal data removed"
DEPARTING = "images depart from the calibration"


class _NoteRecord(BaseModel):
    model_config = ConfigDict(frozen=True)


class BoardPose(_NoteRecord):
    """A planned pose of the camera above the calibration board."""

    viewpoint: str
    T_base_camera: Matrix


class BoardPrediction(_NoteRecord):
    """The result that is predicted of the planned board images; None where there are too few images to predict it.

    Attributes:
        coverage: the share of the image's cells in which a corner is expected.
        coverage_map: the expected corners in each cell, row by row.
        uncertainty_mm: the standard deviation of a projected point at the specimen's distance.
        tilt_deg: the largest tilt of the board.
        rotation_spread_deg: the spread of the camera's rotations.
        hand_eye_sigma_mm: the standard deviation of the hand-eye translation.
        hand_eye_sigma_deg: the standard deviation of the hand-eye rotation.
    """

    coverage: float
    coverage_map: tuple[tuple[int, ...], ...]
    uncertainty_mm: float | None
    tilt_deg: float
    rotation_spread_deg: float | None
    hand_eye_sigma_mm: float | None
    hand_eye_sigma_deg: float | None


class BoardPlan(_NoteRecord):
    """Planned board images.

    Attributes:
        why: the occasion of the plan: first, start, rest, replacement or mend.
        attempt: the step's attempt.
        poses: the poses in the order of capture.
        prediction: the prediction of what they will give.
        from_images: the number of images from which camera, mount and board were known.
        instead_of: the reasons why earlier images are replaced, by viewpoint.
    """

    why: str = ""
    attempt: int = 0
    poses: tuple[BoardPose, ...]
    prediction: BoardPrediction
    from_images: int = 0
    instead_of: dict[str, str] = Field(default_factory=dict[str, str])


class SuggestedViews(_NoteRecord):
    """The advice on what a capture did not achieve, and the views that would help most."""

    advice: str
    viewpoints: tuple[Suggestion, ...]


class ImagesToRepeat(_NoteRecord):
    """Images that were not good enough; `attempt` is that of the step, None in notes of early versions.

    A note with `advice` also stopped the capture.
    """

    viewpoints: tuple[str, ...] = ()
    attempt: int | None = None
    advice: str | None = None


class Deidentified(_NoteRecord):
    """Attributes that were removed from files before these were stored.

    Attributes:
        device: the device from which the files came.
        files: the number of files.
        removed: the names of the attributes, over all files; never their values.
    """

    device: str
    files: int
    removed: tuple[str, ...]

    @property
    def words(self) -> str:
        """The sentence for reports and pages."""
        names = ", ".join(self.removed) or "none was present"
        return (
            f"Personal data: {counted(self.files, 'file')} of the device {self.device} were kept as copies without "
            f"these attributes: {names}. UIDs were replaced; the pixels are those of the original files, which are "
            "not in the record"
        )


def deidentified(state: StepState) -> tuple[Deidentified, ...]:
    """Return what was removed from files in a step, oldest first."""
    return tuple(Deidentified.model_validate(note.data) for note in state.notes if note.note == DEIDENTIFIED)


def board_plans(state: StepState) -> tuple[BoardPlan, ...]:
    """Return the board images planned in a step, oldest plan first."""
    return tuple(BoardPlan.model_validate(note.data) for note in state.notes if note.note == BOARD_POSES)


def suggested_views(state: StepState) -> tuple[SuggestedViews, ...]:
    """Return the suggestions of a step, oldest first."""
    return tuple(SuggestedViews.model_validate(note.data) for note in state.notes if note.note == SUGGESTION)


def images_to_repeat(state: StepState, note: str) -> tuple[ImagesToRepeat, ...]:
    """Return the notes SPOILT or DEPARTING of a step, oldest first."""
    return tuple(ImagesToRepeat.model_validate(found.data) for found in state.notes if found.note == note)


# --- one number of images for header, notices, capture page, report and audit --------------------------------------


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
