"""Board poses as a protocol asks for them, and their planning from what is known of camera, mount and board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from service.compute.calibration.board.board import Board
from service.compute.calibration.board_poses.candidates import ViewRange, board_candidates
from service.compute.calibration.board_poses.design import (
    NOTHING,
    CalibrationTargets,
    ChosenViews,
    Prediction,
    as_taken,
    choose_poses,
    predict,
)
from service.compute.calibration.board_poses.knowledge import BoardKnowledge, Tolerances, nominal_knowledge
from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform, inverse
from service.core.records.events import Record
from service.core.units import metres
from service.rig import LensSection
from service.steps.context import StationLayout
from service.steps.notes import BoardPrediction

Why = Literal["first", "start", "rest", "replacement", "mend"]
#: The first image is taken from further away and steeply: nobody knows yet where exactly the board lies.
FIRST = ViewRange(tilts_deg=(8.0, 14.0, 24.0), distances_m=(0.78, 0.82, 0.86))
START = 6  # images after which camera, mount and board are known well enough to plan the rest
_USUAL_FOCAL = 1.2  # focal length over the image's longer side, where the rig file does not tell
_UNKNOWN_FOCAL = 0.25


class BoardPoses(Record):
    """Board images that the software plans: how many, from where, and what they shall reach."""

    station: str  # where the images are taken
    prefix: str  # of the names of the views
    count: Annotated[int, Field(ge=4, le=300)]  # how many images
    # Of the camera from the vertical.
    tilts_deg: tuple[Annotated[float, Field(ge=0, le=60)], ...] = ViewRange().tilts_deg
    rolls_deg: tuple[float, ...] = ViewRange().rolls_deg  # of the camera about its axis
    # From the camera to the board.
    distances_m: tuple[Annotated[float, Field(ge=0.2, le=2)], ...] = ViewRange().distances_m
    above_scene_m: float = 0.09  # height of the board over the scene's centre, roughly
    long_side: Literal["across", "along"] = "across"  # how the board lies, seen from the robot
    place_tolerance_mm: Annotated[float, Field(gt=0, le=100)] = 30.0  # of the board's middle
    turn_tolerance_deg: Annotated[float, Field(gt=0, le=30)] = 10.0  # of the board's turn about the vertical
    coverage: Annotated[float, Field(gt=0, le=1)] = 0.97  # of the image, as planned
    replacements: Annotated[int, Field(ge=0, le=100)] = 12  # in one attempt, for images without a board

    @property
    def wishes(self) -> ViewRange:
        """As the planner takes them."""
        return ViewRange(self.tilts_deg, self.rolls_deg, self.distances_m)


@dataclass(frozen=True, slots=True)
class PlannedBoard:
    """Camera poses T_base_camera (K, 4, 4) at the estimated mount, and what they will come to with the others."""

    T_base_camera: Array
    prediction: Prediction


@dataclass(frozen=True, slots=True)
class Planner:
    """Plans board poses at one station.

    Attributes:
        feasible: whether the arm can take T_base_camera as the nominal mount puts it.
        nominal_mount: T_flange_camera of the drawing.
    """

    wanted: BoardPoses
    board: Board
    aims: CalibrationTargets
    approach: Array
    nominal_mount: Transform
    feasible: Callable[[Transform], bool]

    def next(
        self,
        why: Why,
        count: int,
        known: BoardKnowledge,
        taken: ChosenViews = NOTHING,
        *,
        enough: Callable[[Prediction], bool] | None = None,
        seed: int = 0,
    ) -> PlannedBoard:
        """Up to `count` further poses; fewer where the arm can take no others that hold the board."""
        wishes = FIRST if why == "first" else self.wanted.wishes
        candidates = board_candidates(known, self.board, wishes, self.approach, seed=seed)
        poses = choose_poses(
            candidates, count, known, self.board, self.aims,
            taken=taken, feasible=lambda T: self.feasible(self.sent(T, known)), enough=enough, seed=seed,
        )  # fmt: skip
        future = as_taken(known, self.board, poses)
        everything = taken.plus(future.T_base_camera, future.pixels)
        return PlannedBoard(poses, predict(everything, known, self.board, self.aims))

    def prediction(self, taken: ChosenViews, known: BoardKnowledge) -> Prediction:
        """What images will come to without further ones."""
        return predict(taken, known, self.board, self.aims)

    def with_planned(self, taken: ChosenViews, T_base_camera: Array, known: BoardKnowledge) -> ChosenViews:
        """With poses that are decided and not taken yet."""
        future = as_taken(known, self.board, T_base_camera)
        return taken.plus(future.T_base_camera, future.pixels)

    def sent(self, T_base_camera: Transform, known: BoardKnowledge) -> Transform:
        """Where the nominal mount would have the camera when the estimated one has it at T_base_camera."""
        return T_base_camera @ inverse(known.T_flange_camera) @ self.nominal_mount


def preview_board(planner: Planner, known: BoardKnowledge) -> PlannedBoard:
    """All poses as they would be if camera, mount and board were as stated: before anything has moved.

    The later ones as they will be planned once the first images have told where the board lies.
    """
    first = planner.next("first", 1, known)
    sure = _as_if_measured(known)
    taken = as_taken(known, planner.board, first.T_base_camera)
    rest = planner.next("rest", planner.wanted.count - len(first.T_base_camera), sure, taken)
    return PlannedBoard(np.concatenate([first.T_base_camera, rest.T_base_camera]), rest.prediction)


def _as_if_measured(known: BoardKnowledge) -> BoardKnowledge:
    return BoardKnowledge(
        known.camera, known.T_flange_camera, known.T_base_board, 0.1 * known.spread, 0.005, 0.003, START
    )


def nominal_board(
    wanted: BoardPoses, board: Board, layout: StationLayout, mount: Transform, camera: CameraModel, focal: float
) -> BoardKnowledge:
    """What protocol and rig file say of the board, the mount and the lens."""
    tolerances = Tolerances(
        place_m=metres(wanted.place_tolerance_mm), turn_rad=float(np.radians(wanted.turn_tolerance_deg)), focal=focal
    )
    middle = np.array(layout.scene_centre_m) + np.array([0.0, 0.0, wanted.above_scene_m])
    across = wanted.long_side == "across"
    return nominal_knowledge(
        camera, mount, middle, np.array(layout.approach), board, long_side_across=across, tolerances=tolerances
    )


def nominal_camera(lens: LensSection | None, size: tuple[int, int] | None = None) -> tuple[CameraModel, float]:
    """The lens as engraved, without distortion, and by what share its focal length may be off.

    Args:
        lens: of the rig file; None: a usual one, hardly known.
        size: of the images, px; None: as the rig file has it.
    """
    width, height = size or (lens.image_px if lens is not None else (1800, 1200))
    if lens is None:
        focal_px, share = _USUAL_FOCAL * max(width, height), _UNKNOWN_FOCAL
    else:
        focal_px, share = lens.focal_px(width), lens.tolerance
    return CameraModel(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2), share


def prediction_record(prediction: Prediction) -> BoardPrediction:
    """The prediction as it is recorded: rounded, and without NaN."""

    def number(value: float, digits: int = 4) -> float | None:
        return round(value, digits) if np.isfinite(value) else None

    return BoardPrediction(
        coverage=round(prediction.coverage, 4),
        coverage_map=prediction.coverage_map.tolist(),
        uncertainty_mm=number(prediction.uncertainty_mm, 5),
        tilt_deg=round(prediction.tilt_deg, 2),
        rotation_spread_deg=number(prediction.rotation_spread_deg, 2),
        hand_eye_sigma_mm=number(prediction.hand_eye_sigma_mm),
        hand_eye_sigma_deg=number(prediction.hand_eye_sigma_deg, 5),
    )


def describe_prediction(predicted: BoardPrediction, solve: Sequence[str]) -> str:
    """`coverage 99 %, uncertainty of a projected point 0.006 mm, tilts to 40°`: what a plan is predicted to give."""
    parts = [f"coverage {100 * predicted.coverage:.0f} %"]
    if "intrinsics" in solve and predicted.uncertainty_mm is not None:
        parts.append(f"uncertainty of a projected point {predicted.uncertainty_mm:.3f} mm")
    if "hand_eye" in solve and predicted.hand_eye_sigma_mm is not None:
        parts.append(f"σ of the hand-eye {predicted.hand_eye_sigma_mm:.2f} mm")
    parts.append(f"tilts to {predicted.tilt_deg:.0f}°")
    return ", ".join(parts)
