"""The plan of a capture step as it can be told before any device is opened: at the question that releases it."""

from __future__ import annotations

from collections.abc import Callable

from service.core.protocol import Protocol, Step
from service.rig import Rig
from service.steps.context import StationLayout
from service.steps.planning import StepPlan, known_arm, plan_station, usual_posture
from service.steps.viewpoint_capture import Params
from service.steps.viewpoints import plan_viewpoints


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
