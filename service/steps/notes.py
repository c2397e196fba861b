"""Notes of steps that other steps and pages read, as typed records: planned poses, suggestions, what was removed."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from service.core.run.state import StepState
from service.core.text.words import counted
from service.jobs.live_summary import Suggestion
from service.jobs.records import Matrix

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
    """What the planned board images are predicted to give; None where there are too few images for a prediction.

    Attributes:
        coverage: share of the image's cells in which a corner is expected.
        coverage_map: expected corners in each cell, row by row.
        uncertainty_mm: of a projected point at the specimen's distance, 1σ.
        tilt_deg: largest tilt of the board.
        rotation_spread_deg: spread of the camera's rotations.
        hand_eye_sigma_mm: of the hand-eye translation, 1σ.
        hand_eye_sigma_deg: of the hand-eye rotation, 1σ.
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
        why: the poses were planned: first, start, rest, replacement or mend.
        attempt: of the step.
        poses: in the order of capture.
        prediction: of what they will give.
        from_images: number of images from which camera, mount and board were known.
        instead_of: reasons why earlier images are replaced, by viewpoint.
    """

    why: str = ""
    attempt: int = 0
    poses: tuple[BoardPose, ...]
    prediction: BoardPrediction
    from_images: int = 0
    instead_of: dict[str, str] = Field(default_factory=dict[str, str])


class SuggestedViews(_NoteRecord):
    """What a capture found wanting, and the views that would help most."""

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
    """Attributes that were removed from files before these were kept.

    Attributes:
        device: from which the files came.
        files: their number.
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
    """What was removed from files in a step, oldest first."""
    return tuple(Deidentified.model_validate(note.data) for note in state.notes if note.note == DEIDENTIFIED)


def board_plans(state: StepState) -> tuple[BoardPlan, ...]:
    """The board images planned in a step, oldest plan first."""
    return tuple(BoardPlan.model_validate(note.data) for note in state.notes if note.note == BOARD_POSES)


def suggested_views(state: StepState) -> tuple[SuggestedViews, ...]:
    """The suggestions of a step, oldest first."""
    return tuple(SuggestedViews.model_validate(note.data) for note in state.notes if note.note == SUGGESTION)


def images_to_repeat(state: StepState, note: str) -> tuple[ImagesToRepeat, ...]:
    """The notes SPOILT or DEPARTING of a step, oldest first."""
    return tuple(ImagesToRepeat.model_validate(found.data) for found in state.notes if found.note == note)
