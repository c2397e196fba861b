"""The motion of a capture step before it begins: which viewpoints the arm can take, in which order, and how long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.compute.arm.inverse_kinematics import nearest_posture
from service.compute.arm.kinematics import ArmModel, arm_model
from service.compute.planning.collision import Capsule, Obstacles, universal_robot_body
from service.compute.planning.motion_plan import (
    MotionPlan,
    Order,
    PlannedView,
    Situation,
    infeasible_reason,
    plan_motion,
    travel_times_s,
)
from service.compute.planning.optics import depth_of_field
from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform
from service.core.protocol.models import Motion
from service.core.units import metres, metres_of_um
from service.rig import CollisionSection, OpticsSection
from service.steps.capture.plan.viewpoints import Viewpoint
from service.steps.context import StationLayout, StepContext
from service.steps.notes import MOTION_PLAN

_EXPOSURE_S = 3.0  # settling, exposure and download at each viewpoint, roughly
_ELBOW_UP_RAD = np.array([0.0, -1.6, 1.9, -1.9, -1.57, 0.0])


@dataclass(frozen=True, slots=True)
class StepPlan:
    """The viewpoints of a step as they will be taken, and those that will not, with the reason."""

    viewpoints: tuple[Viewpoint, ...]  # in order; refused ones last
    refused: Mapping[str, str]
    text: str
    record: Mapping[str, Any]


def plan_step(
    context: StepContext,
    viewpoints: Sequence[Viewpoint],
    T_flange_camera: Transform,
    order: Order,
    *,
    sharp_at_m: Array | None = None,
) -> StepPlan:
    """Plan from where the arm stands now, and record the plan. An arm without known kinematics is not checked.

    Args:
        sharp_at_m: (N, 3) points that must be sharp, base frame; None: the specimen.
    """
    collision, optics = context.devices.surroundings()
    plans: list[StepPlan] = []
    for station in dict.fromkeys(v.station for v in viewpoints):
        mine = [v for v in viewpoints if v.station == station]
        robot = context.devices.robot(station)
        model = known_arm(collision.arm or robot.report().identity.model)
        if model is None:
            why = "the arm's kinematics are not known: reach is asked of its controller at each viewpoint, no more"
            plans.append(StepPlan(tuple(mine), {}, f"{station}: {why}", {}))
            continue
        start = robot.state().sample.joints_rad
        layout = context.devices.layout(station)
        context.busy("planning the motions of the arm")
        plans.append(
            plan_station(
                mine, T_flange_camera, layout, model, collision, optics, context.protocol.motion, start, order,
                sharp_at_m=sharp_at_m,
            )
        )  # fmt: skip
    whole = StepPlan(
        tuple(v for plan in plans for v in plan.viewpoints),
        {name: reason for plan in plans for name, reason in plan.refused.items()},
        "; ".join(plan.text for plan in plans),
        {"stations": [dict(plan.record) for plan in plans if plan.record]},
    )
    if whole.record["stations"]:
        context.note(MOTION_PLAN, text=whole.text, **whole.record)
    if whole.text:
        context.tell(whole.text)
    return whole


def plan_station(
    viewpoints: Sequence[Viewpoint],
    T_flange_camera: Transform,
    layout: StationLayout,
    model: ArmModel,
    collision: CollisionSection,
    optics: OpticsSection | None,
    motion: Motion,
    start_rad: Array,
    order: Order,
    *,
    sharp_at_m: Array | None = None,
) -> StepPlan:
    """The same for one station and a known arm, without a device."""
    situation = situation_of(
        T_flange_camera, layout, model, collision, optics, motion, start_rad, sharp_at_m=sharp_at_m
    )
    answer = plan_motion([(v.name, v.T_base_camera) for v in viewpoints], situation, order)
    stations = {v.name: v.station for v in viewpoints}
    planned = tuple(
        Viewpoint(v.name, stations[v.name], v.T_base_camera, None if v.outcome == "refused" else v.joints_rad)
        for v in answer.views
    )
    return StepPlan(planned, {v.name: v.reason for v in answer.refused}, _text(answer), _record(answer, layout.name))


def feasible_extra(
    context: StepContext, viewpoints: Sequence[Viewpoint], T_flange_camera: Transform
) -> list[tuple[Viewpoint, float]]:
    """Those of further viewpoints of one station that the arm can take, with the time to get there from where it is.

    All of them, with no time, for an arm without known kinematics.
    """
    if not viewpoints:
        return []
    collision, optics = context.devices.surroundings()
    robot = context.devices.robot(viewpoints[0].station)
    model = known_arm(collision.arm or robot.report().identity.model)
    if model is None:
        return [(v, 0.0) for v in viewpoints]
    layout, motion = context.devices.layout(viewpoints[0].station), context.protocol.motion
    start = robot.state().sample.joints_rad
    situation = situation_of(T_flange_camera, layout, model, collision, optics, motion, start)
    out: list[tuple[Viewpoint, float]] = []
    for viewpoint in viewpoints:
        joints = nearest_posture(model, viewpoint.T_base_camera @ inverse(T_flange_camera), start)
        if joints is not None and not infeasible_reason(viewpoint.T_base_camera, joints, situation):
            out.append((viewpoint, float(travel_times_s(np.array([start, joints]), situation)[0, 1])))
    return out


def situation_of(
    T_flange_camera: Transform,
    layout: StationLayout,
    model: ArmModel,
    collision: CollisionSection,
    optics: OpticsSection | None,
    motion: Motion,
    start_rad: Array,
    *,
    sharp_at_m: Array | None = None,
) -> Situation:
    """Arm, surroundings and optics of a station as the planner takes them."""
    centre = np.array(layout.scene_centre_m)
    approach = np.array(layout.approach)
    up = np.array([0.0, 0.0, 1.0])
    T_base_scene = transform(np.column_stack([approach, np.cross(up, approach), up]), centre)
    half = 0.5 * np.array(collision.specimen_size_m)
    T_base_specimen = T_base_scene.copy()
    T_base_specimen[2, 3] += half[2] - collision.table_below_scene_m
    camera = Capsule(np.array(collision.camera_from_m), np.array(collision.camera_to_m), collision.camera_radius_m)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    sharp = None
    if optics is not None:
        sharp = depth_of_field(
            metres(optics.focal_length_mm), optics.aperture_f, optics.focus_distance_m, metres_of_um(optics.blur_um)
        )
    return Situation(
        body=universal_robot_body(model, T_flange_camera, camera),
        obstacles=Obstacles(float(centre[2]) - collision.table_below_scene_m, T_base_specimen, half),
        centre_m=centre,
        margin_m=collision.margin_m,
        start_rad=np.asarray(start_rad, dtype=np.float64),
        speed_rad_s=motion.speed_rad_s,
        acceleration_rad_s2=motion.acceleration_rad_s2,
        sharp=sharp,
        must_be_sharp_m=apply(T_base_specimen, corners) if sharp_at_m is None else sharp_at_m,
        pause_s=motion.dwell_s + _EXPOSURE_S,
    )


def usual_posture(model: ArmModel, layout: StationLayout, T_flange_camera: Transform) -> Array:
    """Joints (6,) with the elbow up and the camera above the scene: where a plan without a robot begins.

    Raises:
        ConfigurationError: the arm does not reach the scene of this station.
    """
    centre, approach = np.array(layout.scene_centre_m), np.array(layout.approach)
    T_base_camera = look_at(centre + np.array([0.0, 0.0, 0.62]) + 0.1 * approach, centre, -approach)
    near = _ELBOW_UP_RAD.copy()
    near[0] = np.arctan2(approach[1], approach[0])
    joints = nearest_posture(model, T_base_camera @ inverse(T_flange_camera), near)
    if joints is None:
        raise ConfigurationError(
            f"the {model.name} does not reach the scene of station {layout.name!r}",
            where=f"station {layout.name}",
            remedy="Check scene_centre_m and approach_azimuth_deg in the rig file",
        )
    return joints


def known_arm(name: str) -> ArmModel | None:
    """The kinematics of an arm by its controller's name for it; None for one that is not in the table."""
    try:
        return arm_model(name)
    except ConfigurationError:
        return None


def _text(plan: MotionPlan) -> str:
    nudged = [f"{v.name} by {v.nudge_deg:+g}°" for v in plan.views if v.outcome == "nudged"]
    refused = [f"{v.name} ({v.reason})" for v in plan.refused]
    parts = [f"{len(plan.feasible)} of {len(plan.views)} viewpoints, about {max(1, round(plan.total_s / 60))} min"]
    if plan.order == "shortest":
        parts[0] += f" ({plan.listed_s - plan.total_s:.0f} s less than as listed)"
    if nudged:
        parts.append(f"turned along the arc: {', '.join(nudged)}")
    if refused:
        parts.append(f"left out: {', '.join(refused)}")
    return "; ".join(parts)


def _record(plan: MotionPlan, station: str) -> dict[str, Any]:
    def view(v: PlannedView) -> dict[str, Any]:
        joints = None if v.outcome == "refused" else [round(float(q), 6) for q in v.joints_rad]
        return {
            "viewpoint": v.name,
            "outcome": v.outcome,
            "reason": v.reason,
            "nudge_deg": v.nudge_deg,
            "joints_rad": joints,
            "travel_s": round(v.travel_s, 2),
        }

    return {
        "station": station,
        "order": plan.order,
        "estimated_s": round(plan.total_s, 1),
        "views": [view(v) for v in plan.views],
    }
