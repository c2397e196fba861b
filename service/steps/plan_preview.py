"""The plan of a capture step before any device is opened, for the question that confirms the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from service.compute.calibration.board import Board
from service.compute.calibration.board_design import CalibrationTargets
from service.compute.planning.motion_plan import best_posture
from service.core.arms import known_arm
from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform, apply
from service.core.protocol import Protocol, Step
from service.core.units import metres
from service.rig import Rig
from service.steps.board_plan import (
    Planner,
    describe_prediction,
    nominal_board,
    nominal_camera,
    prediction_record,
    preview_board,
)
from service.steps.context import StationLayout
from service.steps.kinds import calibration
from service.steps.kinds.viewpoint_capture import Params
from service.steps.motion import ArmAtStation, StepPlan, plan_station, usual_posture
from service.steps.notes import BoardPrediction
from service.steps.viewpoints import plan_viewpoints


@dataclass(frozen=True, slots=True)
class BoardPreview:
    """The board images of a calibration as they will be planned if board, mount and lens are as described."""

    T_base_camera: Array  # (K, 4, 4)
    prediction: BoardPrediction
    text: str


def preview_board_poses(
    protocol: Protocol, step: Step, rig: Rig, layout: Callable[[str], StationLayout]
) -> BoardPreview | None:
    """Preview the board poses of a step; None if the software does not plan them.

    Raises ConfigurationError if protocol or rig file do not have what a plan needs, or the scene is out of reach.
    """
    if not isinstance(step.params, calibration.Params) or step.params.board_poses is None or protocol.board is None:
        return None
    wanted, solve = step.params.board_poses, step.params.solve
    board = Board(protocol.board.columns, protocol.board.rows, metres(protocol.board.square_mm))
    mount, there = rig.nominal_T_flange_camera(), layout(wanted.station)
    known = nominal_board(wanted, board, there, mount, *nominal_camera(rig.section.lens))
    feasible = _feasible(_arm(protocol, rig, there), apply(known.T_base_board, board.points()))
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
    """Return one plan for each station, from the arm's usual posture above the scene.

    Empty for steps of other kinds, and if the rig file names no arm of known kinematics. Stations without an arm are
    left out.

    Raises ConfigurationError for a station that the rig does not have, and for a scene out of reach.
    """
    if not isinstance(step.params, Params):
        return ()
    plans: list[StepPlan] = []
    for station in dict.fromkeys(one.station for one in step.params.viewpoints):
        there = layout(station)
        if not there.is_arm:
            continue
        arm = _arm(protocol, rig, there)
        if arm is None:
            return ()
        views = [v for one in step.params.viewpoints if one.station == station for v in plan_viewpoints(one, there)]
        scene = arm.scene(usual_posture(arm.model, there, arm.T_flange_camera))
        plans.append(plan_station(views, arm, scene, step.params.order))
    return tuple(plans)


def _arm(protocol: Protocol, rig: Rig, layout: StationLayout) -> ArmAtStation | None:
    """Return the arm that the rig file names; None if it names none or is not there, or for unknown kinematics."""
    collision = rig.section.collision
    model = known_arm(collision.arm) if collision.arm is not None and layout.is_arm else None
    if model is None:
        return None
    nominal = rig.nominal_T_flange_camera()
    load = rig.section.payload
    if load is not None and load.mass_kg > model.payload_kg:
        raise ConfigurationError(
            f"the payload of {load.mass_kg:g} kg is more than a {model.name} carries, {model.payload_kg:g} kg",
            where=str(rig.path),
            remedy="Correct mass_kg, or choose another arm",
        )
    return ArmAtStation(layout, model, nominal, collision, rig.section.optics, protocol.motion)


def _feasible(arm: ArmAtStation | None, sharp_at_m: Array) -> Callable[[Transform], bool]:
    """Return a test if the arm can reach T_base_camera; it is always true for an unknown arm."""
    if arm is None:
        return lambda _T: True
    scene = arm.scene(usual_posture(arm.model, arm.layout, arm.T_flange_camera), sharp_at_m=sharp_at_m)
    return lambda T: best_posture(T, scene) is not None
