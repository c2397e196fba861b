"""The plan of a capture step as it can be told before any device is opened: at the question that releases it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from service.compute.calibration.board.board import Board
from service.compute.calibration.board_poses.design import CalibrationTargets
from service.compute.planning.motion_plan import able_postures
from service.core.geometry import Array, Transform, apply
from service.core.protocol.models import Protocol, Step
from service.core.units import metres
from service.rig import Rig
from service.steps.board.plan import (
    Planner,
    describe_prediction,
    nominal_board,
    nominal_camera,
    prediction_record,
    preview_board,
)
from service.steps.capture.plan.planning import StepPlan, known_arm, plan_station, situation_of, usual_posture
from service.steps.capture.plan.viewpoints import plan_viewpoints
from service.steps.context import StationLayout
from service.steps.kinds import calibration
from service.steps.kinds.viewpoint_capture import Params
from service.steps.notes import BoardPrediction


@dataclass(frozen=True, slots=True)
class BoardPreview:
    """The board images of a calibration as they will be planned if everything lies as stated."""

    T_base_camera: Array  # (K, 4, 4)
    prediction: BoardPrediction
    text: str


def preview_board_poses(
    protocol: Protocol, step: Step, rig: Rig, layout: Callable[[str], StationLayout]
) -> BoardPreview | None:
    """None for steps whose board poses the software does not plan.

    Raises ConfigurationError where protocol or rig file lack what a plan needs, or the scene is out of reach.
    """
    if not isinstance(step.params, calibration.Params) or step.params.board_poses is None or protocol.board is None:
        return None
    wanted, solve = step.params.board_poses, step.params.solve
    board = Board(protocol.board.columns, protocol.board.rows, metres(protocol.board.square_mm))
    mount, there = rig.nominal_T_flange_camera(), layout(wanted.station)
    known = nominal_board(wanted, board, there, mount, *nominal_camera(rig.section.lens))
    collision = rig.section.collision
    model = None if collision.arm is None else known_arm(collision.arm)
    feasible: Callable[[Transform], bool] = lambda _T: True  # noqa: E731 - replaced below for a known arm
    if model is not None:
        start = usual_posture(model, there, mount)
        points = apply(known.T_base_board, board.points())
        situation = situation_of(
            mount, there, model, collision, rig.section.optics, protocol.motion, start, sharp_at_m=points
        )
        feasible = lambda T: bool(able_postures(T, situation))  # noqa: E731
    aims = CalibrationTargets("intrinsics" in solve, "hand_eye" in solve, wanted.coverage)
    planned = preview_board(Planner(wanted, board, aims, np.array(there.approach), mount, feasible), known)
    record = prediction_record(planned.prediction)
    text = (
        f"{len(planned.T_base_camera)} of {wanted.count} board poses; predicted {describe_prediction(record, solve)}"
    )
    return BoardPreview(planned.T_base_camera, record, text)


def preview_plans(
    protocol: Protocol, step: Step, rig: Rig, layout: Callable[[str], StationLayout]
) -> tuple[StepPlan, ...]:
    """One plan a station, from the arm's usual posture over the scene.

    None for other step kinds, and where the rig file does not name an arm whose kinematics are known.

    Raises ConfigurationError for a station that the rig has not, or a scene out of reach.
    """
    collision = rig.section.collision
    model = None if collision.arm is None else known_arm(collision.arm)
    if model is None or not isinstance(step.params, Params):
        return ()
    plans: list[StepPlan] = []
    nominal = rig.nominal_T_flange_camera()
    for station in dict.fromkeys(one.station for one in step.params.viewpoints):
        there = layout(station)
        views = [v for one in step.params.viewpoints if one.station == station for v in plan_viewpoints(one, there)]
        start = usual_posture(model, there, nominal)
        plans.append(
            plan_station(
                views, nominal, there, model, collision, rig.section.optics, protocol.motion, start, step.params.order
            )
        )
    return tuple(plans)
