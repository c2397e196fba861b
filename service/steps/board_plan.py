"""Plans board poses from estimates of camera, mount and board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.compute.calibration.board import Board
from service.compute.calibration.board_design import (
    NOTHING,
    CalibrationTargets,
    ChosenViews,
    DesignProblem,
    PlanPrediction,
    board_candidates,
    choose_poses,
)
from service.compute.calibration.board_knowledge import BoardKnowledge, Tolerances, nominal_knowledge
from service.compute.camera_model import CameraModel
from service.compute.photography import ViewRange
from service.core.geometry import Array, Transform, inverse
from service.core.units import metres
from service.rig import LensSection
from service.steps.context import StationLayout
from service.steps.notes import BoardPrediction
from service.steps.viewpoints import BoardPoses

Why = Literal["first", "start", "rest", "replacement", "mend"]
#: The first image is taken from farther away and nearly from above, because the board's place is only roughly known.
FIRST = ViewRange(tilts_deg=(8.0, 14.0, 24.0), distances_m=(0.78, 0.82, 0.86))
START = 6  # images after which camera, mount and board are known well enough to plan the rest
_DRAWS = 8  # of candidates, until the arm can reach enough of them: one with a short reach takes a small share
_USUAL_FOCAL = 1.2  # focal length over the image's longer side, if the rig file describes no lens
_UNKNOWN_FOCAL = 0.25  # relative standard deviation of that focal length


@dataclass(frozen=True, slots=True)
class PlannedBoard:
    """Camera poses T_base_camera (K, 4, 4) with the estimated mount, and the prediction with all images."""

    T_base_camera: Array
    prediction: PlanPrediction


@dataclass(frozen=True, slots=True)
class Planner:
    """Plans board poses at one station.

    Attributes:
        wanted: the protocol's section on board poses.
        board: the board to be photographed.
        aims: the calibrations that the images are for.
        approach: (3,) horizontal unit vector from the scene towards the arm's base.
        nominal_mount: T_flange_camera according to the drawing.
        feasible: says if the arm can reach a T_base_camera given for the nominal mount.
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
        enough: Callable[[PlanPrediction], bool] | None = None,
        seed: int = 0,
    ) -> PlannedBoard:
        """Plan up to `count` further poses; fewer if the arm can reach no others that show the board."""
        wishes = FIRST if why == "first" else self.wanted.wishes
        problem = self._problem(known)
        poses = np.zeros((0, 4, 4))
        predicted = problem.predict(taken)
        for draw in range(_DRAWS):
            candidates = board_candidates(known, self.board, wishes, self.approach, seed=seed, draw=draw)
            more = choose_poses(
                problem, candidates, count - len(poses), taken=self.with_planned(taken, poses, known),
                feasible=lambda T: self.feasible(self.sent(T, known)), enough=enough, seed=seed,
            )  # fmt: skip
            poses = np.concatenate([poses, more])
            predicted = problem.predict(self.with_planned(taken, poses, known))
            if len(poses) >= count or (enough is not None and enough(predicted)):
                break
        return PlannedBoard(poses, predicted)

    def prediction(self, taken: ChosenViews, known: BoardKnowledge) -> PlanPrediction:
        """Return the prediction without further images."""
        return self._problem(known).predict(taken)

    def with_planned(self, taken: ChosenViews, T_base_camera: Array, known: BoardKnowledge) -> ChosenViews:
        """Return the images with those added that are planned but not taken yet."""
        future = self._problem(known).as_taken(T_base_camera)
        return taken.plus(future.T_base_camera, future.pixels)

    def _problem(self, known: BoardKnowledge) -> DesignProblem:
        return DesignProblem(known, self.board, self.aims)

    def sent(self, T_base_camera: Transform, known: BoardKnowledge) -> Transform:
        """Return T_base_camera for the nominal mount that puts the camera at this one with the estimated mount."""
        return T_base_camera @ inverse(known.T_flange_camera) @ self.nominal_mount


def preview_board(planner: Planner, known: BoardKnowledge) -> PlannedBoard:
    """Return all poses as they would be planned if camera, mount and board were as given, before anything has moved.

    After the first pose, the place of the board counts as measured.
    """
    first = planner.next("first", 1, known)
    sure = _as_if_measured(known)
    taken = planner.with_planned(NOTHING, first.T_base_camera, known)
    rest = planner.next("rest", planner.wanted.count - len(first.T_base_camera), sure, taken)
    return PlannedBoard(np.concatenate([first.T_base_camera, rest.T_base_camera]), rest.prediction)


def _as_if_measured(known: BoardKnowledge) -> BoardKnowledge:
    return BoardKnowledge(
        known.camera, known.T_flange_camera, known.T_base_board, 0.1 * known.spread, 0.005, 0.003, START
    )


def nominal_board(
    wanted: BoardPoses, board: Board, layout: StationLayout, mount: Transform, camera: CameraModel, focal: float
) -> BoardKnowledge:
    """Return board, mount and lens as protocol and rig file give them."""
    tolerances = Tolerances(
        place_m=metres(wanted.place_tolerance_mm), turn_rad=float(np.radians(wanted.turn_tolerance_deg)), focal=focal
    )
    middle = np.array(layout.scene_centre_m) + np.array([0.0, 0.0, wanted.above_scene_m])
    across = wanted.long_side == "across"
    return nominal_knowledge(
        camera, mount, middle, np.array(layout.approach), board, long_side_across=across, tolerances=tolerances
    )


def nominal_camera(lens: LensSection | None, size: tuple[int, int] | None = None) -> tuple[CameraModel, float]:
    """Return nominal intrinsics without distortion, and the relative uncertainty of the focal length.

    Args:
        lens: the lens of the rig file; None: a common focal length with a large uncertainty.
        size: width and height of the images, px; None: as the rig file gives them.
    """
    width, height = size or (lens.image_px if lens is not None else (1800, 1200))
    if lens is None:
        focal_px, share = _USUAL_FOCAL * max(width, height), _UNKNOWN_FOCAL
    else:
        focal_px, share = lens.focal_px(width), lens.tolerance
    return CameraModel(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2), share


def prediction_record(prediction: PlanPrediction) -> BoardPrediction:
    """Return the prediction as it is recorded: rounded, and without NaN."""

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
    """Describe what a plan will give: `coverage 99 %, uncertainty of a projected point 0.006 mm, tilts to 40°`."""
    parts = [f"coverage {100 * predicted.coverage:.0f} %"]
    if "intrinsics" in solve and predicted.uncertainty_mm is not None:
        parts.append(f"uncertainty of a projected point {predicted.uncertainty_mm:.3f} mm")
    if "hand_eye" in solve and predicted.hand_eye_sigma_mm is not None:
        parts.append(f"σ of the hand-eye {predicted.hand_eye_sigma_mm:.2f} mm")
    parts.append(f"tilts to {predicted.tilt_deg:.0f}°")
    return ", ".join(parts)
