"""The motion of an arm: what it reaches, in which order, how long it takes; moving and standing still."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.errors import ArmDepartedError, DeviceError, DeviceTimeoutError, SafetyStopError
from drivers.interfaces import RobotArm, SettleCriteria, SettleReport
from service.compute.arm_kinematics import nearest_posture
from service.compute.planning.collision import ArmBody, Capsule, Obstacles
from service.compute.planning.motion_plan import (
    MotionPlan,
    Order,
    PlannedView,
    PlanningScene,
    Progress,
    best_posture,
    depth_of_field,
    plan_motion,
    travel_times_s,
)
from service.core.arms import ArmModel, known_arm
from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform
from service.core.protocol import Motion, motion_problems
from service.core.run.state import MOTION_PLAN, NotedStation, NotedView
from service.core.units import metres, metres_of_um
from service.rig import CollisionSection, OpticsSection
from service.steps.context import StationLayout, StepContext, StepInterruptedError
from service.steps.viewpoints import Viewpoint

# --- the plan of a capture step ------------------------------------------------------------------------------------


_LOOK_S = 0.4  # between two checks of the buttons during planning
_NOT_PLANNED = "the kinematics of the arm are not known; its controller checks the reach at each viewpoint"
_OTHER_AXES = "no arm stands there; the driver of its axes checks the reach at each viewpoint"
_EXPOSURE_S = 3.0  # estimate of settling, exposure and download at each viewpoint


@dataclass(frozen=True, slots=True)
class StepPlan:
    """The viewpoints of a step in the order in which they will be visited, and why some cannot be."""

    viewpoints: tuple[Viewpoint, ...]  # in order; refused ones last
    refused: Mapping[str, str]
    text: str
    motions: tuple[NotedStation, ...]  # where the arm's kinematics are known
    starts_rad: Mapping[str, Array] = field(default_factory=dict[str, Array])  # joints at the start, by station


@dataclass(frozen=True, slots=True)
class ArmAtStation:
    """An arm of known kinematics at a station, with everything that a motion plan there depends on.

    Attributes:
        layout: the station's layout.
        model: the arm's kinematics.
        T_flange_camera: (4, 4) the best known mounting of the camera.
        collision: obstacles, and the size of the camera.
        optics: the lens, if the rig file describes it.
        motion: the protocol's speed, acceleration and pauses.
    """

    layout: StationLayout
    model: ArmModel
    T_flange_camera: Transform
    collision: CollisionSection
    optics: OpticsSection | None
    motion: Motion

    def scene(self, start_rad: Array, *, sharp_at_m: Array | None = None) -> PlanningScene:
        """Return the planner's problem for a motion that starts with the joints (N,) at `start_rad`.

        `sharp_at_m`: (N, 3) points that must be sharp, base frame; None: the specimen.
        """
        centre = np.array(self.layout.scene_centre_m)
        T_base_specimen, half = self._specimen()
        c = self.collision
        camera = Capsule(np.array(c.camera_from_m), np.array(c.camera_to_m), c.camera_radius_m)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        sharp = None
        if self.optics is not None:
            o = self.optics
            focal_m, blur_m = metres(o.focal_length_mm), metres_of_um(o.blur_um)
            sharp = depth_of_field(focal_m, o.aperture_f, o.focus_distance_m, blur_m)
        return PlanningScene(
            body=ArmBody(self.model, self.T_flange_camera, camera),
            obstacles=Obstacles(
                float(centre[2]) - c.table_below_scene_m, T_base_specimen, half, others=self._others()
            ),
            centre_m=centre,
            margin_m=c.margin_m,
            start_rad=np.asarray(start_rad, dtype=np.float64),
            speed_rad_s=min(self.motion.speed_rad_s, float(self.model.speeds_rad_s.min())),
            acceleration_rad_s2=self.motion.acceleration_rad_s2,
            sharp=sharp,
            must_be_sharp_m=apply(T_base_specimen, corners) if sharp_at_m is None else sharp_at_m,
            pause_s=self.motion.dwell_s + _EXPOSURE_S,
        )

    def _others(self) -> tuple[tuple[str, Capsule], ...]:
        return tuple(
            (name, Capsule(np.array(one.from_m), np.array(one.to_m), one.radius_m))
            for name, one in self.layout.obstacles
        )

    def _specimen(self) -> tuple[Transform, Array]:
        """Return T_base_specimen, origin in the middle of its bounding box, and the box's half sizes (3,)."""
        approach, up = np.array(self.layout.approach), np.array([0.0, 0.0, 1.0])
        axes = np.column_stack([approach, np.cross(up, approach), up])
        half = 0.5 * np.array(self.collision.specimen_size_m)
        T_base_specimen = transform(axes, np.array(self.layout.scene_centre_m))
        T_base_specimen[2, 3] += half[2] - self.collision.table_below_scene_m
        return T_base_specimen, half


def arm_at_station(context: StepContext, station: str, T_flange_camera: Transform) -> ArmAtStation | None:
    """Return the arm at a station; None if its kinematics are not known, or if it is no arm."""
    layout = context.devices.layout(station)
    if not layout.is_arm:
        return None
    collision, optics = context.devices.surroundings()
    model = known_arm(collision.arm or context.devices.robot(station).report().identity.model)
    if model is None:
        return None
    _require_slow_enough(context, layout, model)
    return ArmAtStation(layout, model, T_flange_camera, collision, optics, context.protocol.motion)


def _require_slow_enough(context: StepContext, layout: StationLayout, model: ArmModel) -> None:
    """Refuse a motion faster than this arm may move, or than it can stop in time. Raises ConfigurationError."""
    for name, words in motion_problems(context.protocol.motion, [model], layout.abandoned):
        raise ConfigurationError(
            f"{name} of the protocol's motion is too large: {words}",
            where=f"station {layout.name}",
            remedy="Lower it in the protocol; docs/decisions/0013-leave-to-move.md says how fast an arm may move",
        )


def plan_step(
    context: StepContext,
    viewpoints: Sequence[Viewpoint],
    T_flange_camera: Transform,
    order: Order,
    *,
    sharp_at_m: Array | None = None,
) -> StepPlan:
    """Plan from where the arm stands now, and record the plan. An arm of unknown kinematics is not checked.

    Progress is shown meanwhile, and pause and abort are heeded.

    Args:
        context: the step's surroundings: devices, evidence, clock.
        viewpoints: the viewpoints to visit.
        T_flange_camera: (4, 4) the best known mounting of the camera.
        order: the order of the viewpoints: as listed, or the shortest way.
        sharp_at_m: (N, 3) points that must be sharp, base frame; None: the specimen.

    Raises:
        StepInterruptedError: the step was paused or aborted meanwhile.
    """
    plans: list[StepPlan] = []
    for station in dict.fromkeys(v.station for v in viewpoints):
        mine = [v for v in viewpoints if v.station == station]
        arm = arm_at_station(context, station, T_flange_camera)
        if arm is None:
            why = _NOT_PLANNED if context.devices.layout(station).is_arm else _OTHER_AXES
            plans.append(StepPlan(tuple(mine), {}, f"{station}: {why}", ()))
            continue
        context.busy("planning the motions of the arm")
        start_rad = context.devices.robot(station).state().sample.joints_rad
        if len(start_rad) != arm.model.axes:
            raise ConfigurationError(
                f"the arm of {station} has {len(start_rad)} axes, and the rig file has the planner take it for a "
                f"{arm.model.name} with {arm.model.axes}",
                where=f"rig file, station {station}",
                remedy="Take `arm` out of `collision`: each arm is then planned as its controller names it",
            )
        scene = arm.scene(start_rad, sharp_at_m=sharp_at_m)
        plan = plan_station(mine, arm, scene, order, _attending(context))
        plans.append(replace(plan, starts_rad={station: start_rad}))
    return _recorded(context, plans)


def _attending(context: StepContext) -> Progress:
    """Show how far the planning is and look at the buttons, at most every `_LOOK_S`."""
    due_s = context.monotonic_s()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal due_s
        now_s = context.monotonic_s()
        if now_s >= due_s:
            due_s = now_s + _LOOK_S
            context.checkpoint()
            context.progress(f"planning the motion: {what}", done, total)

    return progress


def plan_station(
    viewpoints: Sequence[Viewpoint],
    arm: ArmAtStation,
    scene: PlanningScene,
    order: Order,
    progress: Progress = lambda _what, _done, _total: None,
) -> StepPlan:
    """Plan the viewpoints of one station for an arm of known kinematics, without a device."""
    answer = plan_motion([(v.name, v.T_base_camera) for v in viewpoints], scene, order, progress)
    stations = {v.name: v.station for v in viewpoints}
    planned = tuple(
        Viewpoint(
            v.name,
            stations[v.name],
            v.T_base_camera,
            None if v.outcome == "refused" else v.joints_rad,
            v.way_rad,
            v.from_rad,
        )
        for v in answer.views
    )
    refused = {v.name: v.reason for v in answer.refused}
    return StepPlan(planned, refused, _text(answer), (_station(answer, arm.layout.name),))


def _recorded(context: StepContext, plans: Sequence[StepPlan]) -> StepPlan:
    """Join the plans of all stations into one, record it and report it to the operator."""
    whole = StepPlan(
        tuple(v for plan in plans for v in plan.viewpoints),
        {name: reason for plan in plans for name, reason in plan.refused.items()},
        "; ".join(plan.text for plan in plans),
        tuple(station for plan in plans for station in plan.motions),
        {station: start_rad for plan in plans for station, start_rad in plan.starts_rad.items()},
    )
    if whole.motions:
        stations = [station.model_dump(mode="json") for station in whole.motions]
        context.note(MOTION_PLAN, text=whole.text, stations=stations)
    if whole.text:
        context.tell(whole.text)
    return whole


def feasible_extra(
    context: StepContext, viewpoints: Sequence[Viewpoint], T_flange_camera: Transform
) -> list[tuple[Viewpoint, float]]:
    """Return the further viewpoints of one station that the arm can reach, with the travel time (s) from its place.

    All of them, with a time of 0, for an arm of unknown kinematics.
    """
    if not viewpoints:
        return []
    station = viewpoints[0].station
    arm = arm_at_station(context, station, T_flange_camera)
    if arm is None:
        return [(v, 0.0) for v in viewpoints]
    start = context.devices.robot(station).state().sample.joints_rad
    scene = arm.scene(start)
    out: list[tuple[Viewpoint, float]] = []
    for viewpoint in viewpoints:
        joints = best_posture(viewpoint.T_base_camera, scene)
        if joints is not None:
            out.append((viewpoint, float(travel_times_s(np.array([start, joints]), scene)[0, 1])))
    return out


def usual_posture(model: ArmModel, layout: StationLayout, T_flange_camera: Transform) -> Array:
    """Return joints (N,) with the elbow up and the camera above the scene, where a plan without a robot starts.

    Raises:
        ConfigurationError: the arm does not reach the scene of this station.
    """
    centre, approach = np.array(layout.scene_centre_m), np.array(layout.approach)
    T_base_camera = look_at(centre + np.array([0.0, 0.0, 0.62]) + 0.1 * approach, centre, -approach)
    near = model.usual_rad.copy()
    turned = near[0] + np.arctan2(-approach[1], -approach[0])
    near[0] = np.arctan2(np.sin(turned), np.cos(turned))
    joints = nearest_posture(model, T_base_camera @ inverse(T_flange_camera), near)
    if joints is None:
        raise ConfigurationError(
            f"the {model.name} does not reach the scene of station {layout.name!r}",
            where=f"station {layout.name}",
            remedy="Check scene_centre_m and approach_azimuth_deg in the rig file",
        )
    return joints


def _text(plan: MotionPlan) -> str:
    nudged = [f"{v.name} by {v.nudge_deg:+g}°" for v in plan.views if v.outcome == "nudged"]
    round_about = [v.name for v in plan.feasible if len(v.way_rad)]
    refused = [f"{v.name} ({v.reason})" for v in plan.refused]
    parts = [f"{len(plan.feasible)} of {len(plan.views)} viewpoints, about {max(1, round(plan.total_s / 60))} min"]
    if plan.order == "shortest":
        parts[0] += f" ({plan.listed_s - plan.total_s:.0f} s less than as listed)"
    if nudged:
        parts.append(f"turned along the arc: {', '.join(nudged)}")
    if round_about:
        parts.append(f"by a detour, because the straight way is blocked: {', '.join(round_about)}")
    if refused:
        parts.append(f"left out: {', '.join(refused)}")
    return "; ".join(parts)


def _station(plan: MotionPlan, station: str) -> NotedStation:
    return NotedStation(
        station=station,
        order=plan.order,
        estimated_s=round(plan.total_s, 1),
        views=tuple(_view(view) for view in plan.views),
    )


def _view(view: PlannedView) -> NotedView:
    refused = view.outcome == "refused"
    return NotedView(
        viewpoint=view.name,
        outcome=view.outcome,
        reason=view.reason,
        nudge_deg=view.nudge_deg,
        joints_rad=None if refused else tuple(round(float(q), 6) for q in view.joints_rad),
        travel_s=round(view.travel_s, 2),
        way_rad=tuple(tuple(round(float(q), 6) for q in joints) for joints in view.way_rad),
    )


# --- moving, and waiting until the arm stands still; stops at once if the operator pauses the run ------------------


# How far each joint may be from where it was sent. Controllers hold a thousandth of a radian, stepper motors several.
STANDS_RAD = 0.005
_POLL_S = 0.02
_POLL_AT_THE_END_S = 0.004  # when the arm may have settled: waiting longer delays the viewpoint


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Limits on the motion of an arm in a run."""

    speed_rad_s: float
    acceleration_rad_s2: float
    settle_timeout_s: float
    travel_timeout_s: float = 120.0


def settle_criteria(context: StepContext) -> SettleCriteria:
    """Return the protocol's definition of standing still."""
    settle = context.protocol.settle
    return SettleCriteria(
        window_s=settle.window_s,
        joint_speed_rad_s=settle.joint_speed_rad_s,
        tcp_speed_m_s=settle.tcp_speed_m_s,
        position_peak_to_peak_m=settle.position_peak_to_peak_m,
        rotation_peak_to_peak_rad=settle.rotation_peak_to_peak_rad,
    )


def move_and_settle(
    context: StepContext,
    robot: RobotArm,
    target_rad: Array,
    limits: MotionLimits,
    criteria: SettleCriteria,
    *,
    meanwhile: Callable[[], None] = lambda: None,
) -> SettleReport:
    """Move to joints (N,) and return when the pose stream is quiet. `meanwhile` is called after the motion started.

    Raises SafetyStopError, DeviceTimeoutError (the arm is stopped), StepInterruptedError (the arm stands still; it
    did not set out if the confirmation was too long ago).
    """
    with context.motion():
        try:
            robot.move_joints(
                target_rad, speed_rad_s=limits.speed_rad_s, acceleration_rad_s2=limits.acceleration_rad_s2
            )
            meanwhile()
            return _wait_settled(context, robot, limits, criteria)
        except StepInterruptedError:
            _stand_still(context, robot, criteria)
            raise
        except BaseException:  # also for defects and Ctrl-C, because the arm would move on unsupervised
            with suppress(DeviceError):
                robot.stop()
            raise


def require_there(robot_name: str, joints_rad: Array, sent_rad: Array, *, step: str) -> None:
    """Refuse to go on with an arm whose joints (N,) are not where they were sent.

    Poses and paths were checked for where it was sent, and for nowhere else. Raises ArmDepartedError.
    """
    away_rad = np.abs(np.asarray(joints_rad) - np.asarray(sent_rad))
    joint = int(np.argmax(away_rad))
    if away_rad[joint] > STANDS_RAD:
        raise ArmDepartedError(
            f"joint {joint + 1} of {robot_name} stands {away_rad[joint]:.3f} rad from where it was sent",
            where=step,
            remedy="Look at what moved it, and whether anybody is in reach; the step goes on after you confirm, and "
            "plans the motions anew from where the arm stands",
        )


def _wait_settled(
    context: StepContext, robot: RobotArm, limits: MotionLimits, criteria: SettleCriteria
) -> SettleReport:
    deadline_s = context.monotonic_s() + limits.travel_timeout_s + limits.settle_timeout_s
    stopped_s: float | None = None
    while True:
        context.checkpoint()
        safety = robot.state().sample.safety
        if not safety.may_move:
            raise SafetyStopError(
                f"the robot reports {safety.value.replace('_', ' ')}",
                where=context.step.id,
                remedy="Find and clear the cause at the robot; the step goes on after you confirm",
            )
        if stopped_s is None and not robot.is_moving():
            stopped_s = context.monotonic_s()
        if stopped_s is not None:
            report = robot.settle(criteria)
            if report.settled:
                return report
        now_s = context.monotonic_s()
        if now_s > deadline_s:
            raise DeviceTimeoutError(
                "the robot did not arrive and settle in time",
                where=context.step.id,
                remedy="Check for a vibrating mount or a drifting joint",
            )
        # The stop is noticed up to three polls after it happened.
        near_the_end = stopped_s is not None and now_s > stopped_s + criteria.window_s - 3 * _POLL_S
        context.wait(_POLL_AT_THE_END_S if near_the_end else _POLL_S)


def _stand_still(context: StepContext, robot: RobotArm, criteria: SettleCriteria) -> None:
    """Stop the arm and wait until it stands still, because only then may pages show 'paused'."""
    robot.stop()
    deadline_s = context.monotonic_s() + 10.0
    while not robot.settle(criteria).settled and context.monotonic_s() < deadline_s:
        context.wait(_POLL_S)
