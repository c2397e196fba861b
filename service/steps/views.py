"""The capture loop: move, settle, expose, record, for each viewpoint; an image is recorded while the arm moves on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.errors import (
    ArmDepartedError,
    DeviceBusyError,
    DeviceError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    DriverKilledError,
    StaleImageError,
    UnreachablePoseError,
    UnreadableFileError,
)
from drivers.interfaces import Camera, CameraSettings, CapturedImage, RobotArm, SettleReport
from service.core.geometry import Array, Transform
from service.core.records.run_events import ViewpointFailed
from service.core.units import megapixels
from service.logs import at
from service.steps.context import FurtherCamera, StepContext
from service.steps.exposure import (
    Exposure,
    Shot,
    environment_now,
    expose,
    expose_when_free,
    exposing_at,
    record_shot,
    settings_of,
    wanted_settings,
)
from service.steps.motion import MotionLimits, StepPlan, move_and_settle, require_there, settle_criteria
from service.steps.retakes import taken_for_good
from service.steps.viewpoints import Viewpoint, flange_target

#: Errors after which a viewpoint is tried again with the device reopened; a DriverKilledError among them is not.
WORTH_ANOTHER_TRY = (
    DeviceUnavailableError,
    DeviceTimeoutError,
    DeviceBusyError,
    StaleImageError,
    UnreadableFileError,
)

# How far the arm may stand from where a way was planned to begin: its controller solves for joints by its own
# calibration.
_BEGINS_RAD = 0.03


@dataclass(frozen=True, slots=True)
class CaptureTotals:
    """The totals of a capture, including what was captured before the run was resumed."""

    planned: int
    captured: int
    given_up: int
    settings_departures: int
    moved: int

    def measures(self) -> dict[str, float]:
        """Return the totals under the names of measures."""
        return {
            "viewpoints_planned": float(self.planned),
            "viewpoints_captured": float(self.captured),
            "viewpoints_given_up": float(self.given_up),
            "settings_departures": float(self.settings_departures),
            "moved_during_exposure": float(self.moved),
        }


@dataclass(frozen=True, slots=True)
class CaptureTask:
    """The work of a capture loop.

    Attributes:
        plan: the plan of the motions: the viewpoints to capture, in order, and those that it leaves out, which are
            recorded as given up.
        taken: further viewpoints of the step, which have their image; a person may ask for another while it runs.
        plan_anew: plans the motions to these viewpoints, in this order, from where the arms stand. Called if an arm
            stands elsewhere than where its way was planned to begin, as after a viewpoint that could not be taken.
        T_flange_camera: (4, 4) the best known mounting. It decides where the camera goes; what is recorded is the
            measured pose of the flange.
        image_kind: the artefact kind of the photographs (`image`, `board_image`, `control_image`).
        on_captured: called after each image is recorded; must return at once.
        stop: called before each viewpoint; if it returns True, the rest is not captured.
        again: the SHA-256 of images to take again.
        all_cameras: true if the rig's further cameras expose as well.
    """

    plan: StepPlan
    taken: Sequence[Viewpoint]
    plan_anew: Callable[[Sequence[Viewpoint]], StepPlan]
    T_flange_camera: Transform
    image_kind: str
    on_captured: Callable[[], None] = lambda: None
    stop: Callable[[], bool] = lambda: False
    again: Collection[str] = ()
    all_cameras: bool = False

    @property
    def names(self) -> list[str]:
        """The names of all viewpoints of the step."""
        return [viewpoint.name for viewpoint in (*self.plan.viewpoints, *self.taken)]


def capture_viewpoints(context: StepContext, task: CaptureTask) -> CaptureTotals:
    """Capture every viewpoint of a task that this attempt has not captured yet.

    Raises DeviceError if a viewpoint fails for good, StepInterruptedError on pause.
    """
    camera = context.devices.camera()
    wanted = wanted_settings(context)
    apply_settings(context, camera, wanted)
    further = context.devices.further_cameras() if task.all_cameras else ()
    for one in further:
        apply_settings(context, one.camera, settings_of(one, wanted))
    loop = _CaptureLoop(context, camera, wanted, task, further)
    try:
        loop.run()
    finally:
        loop.keep()  # however the loop ends, an image that has arrived is recorded
        at(viewpoint="")
    context.progress("viewpoints", len(task.names), len(task.names))
    captures = context.evidence.captures(context.step.id)
    return CaptureTotals(
        planned=len(task.names),
        captured=len(captures),
        given_up=len(loop.given_up),
        settings_departures=sum(not capture.verdicts["settings"] for capture in captures),
        moved=sum(not capture.verdicts["still"] for capture in captures),
    )


@dataclass
class _CaptureLoop:
    """One pass over the viewpoints.

    Storing an image takes as long as moving a joint by a degree. An image is therefore held, and recorded while the
    arm moves to the next viewpoint.
    """

    context: StepContext
    camera: Camera
    wanted: CameraSettings
    task: CaptureTask
    further: Sequence[FurtherCamera] = ()
    given_up: set[str] = field(init=False)
    _tried: set[str] = field(init=False, default_factory=set[str])  # in this execution, successful or not
    _held: Shot | None = field(init=False, default=None)
    _size: str = field(init=False, default="")  # of an image, as text, once there is one
    _targets: dict[str, Array] = field(init=False, default_factory=dict[str, Array])  # joints (N,) solved ahead
    # By station, joints (N,) where the arm must stand when it is moved next: from where its motions were planned, and
    # then where it was sent last.
    _stands_rad: dict[str, Array] = field(init=False, default_factory=dict[str, Array])
    _planned: dict[str, Viewpoint] = field(init=False, default_factory=dict[str, Viewpoint])  # in order
    _refused: dict[str, str] = field(init=False, default_factory=dict[str, str])  # why the plan leaves them out

    def __post_init__(self) -> None:
        self.given_up = set(self.context.state.skipped_viewpoints)
        self._follow(self.task.plan)

    def run(self) -> None:
        """Capture what is missing. `keep` must be called afterwards, as the last image may still be held."""
        # Determined again each time, because an operator may have a viewpoint repeated while the arm moves.
        while todo := self._next():
            self.context.checkpoint()
            if self.task.stop():
                return
            self.context.evidence.require_space()
            self.context.progress("viewpoints", len(self.task.names) - len(todo), len(self.task.names))
            viewpoint = todo[0]
            try:
                shot = self._capture_with_retries(todo)
            except UnreachablePoseError as error:
                self._give_up(viewpoint, error)
            else:
                self._held = shot
                if not all(shot.verdicts.values()):
                    self.keep()  # it is taken again before the arm moves on
            self._tried.add(viewpoint.name)

    def keep(self) -> None:
        """Record the held image, if there is one."""
        shot, self._held = self._held, None
        if shot is not None:
            self._size = f", {megapixels(shot.image.width, shot.image.height):.0f} MP"
            self.context.busy(f"storing {shot.viewpoint.name}{self._size}")
            record_shot(self.context, shot)
            self.task.on_captured()

    def _next(self) -> list[Viewpoint]:
        """Return the viewpoints still to capture, in order.

        An image whose verdicts failed is taken again, once per execution.
        """
        captures = self.context.evidence.captures(self.context.step.id)
        done = taken_for_good(captures, self.task.again) | (self._tried & {one.viewpoint for one in captures})
        if self._held is not None:
            done.add(self._held.viewpoint.name)
        every = [*self._planned.values(), *(v for v in self.task.taken if v.name not in self._planned)]
        left = [v for v in every if v.name not in done and v.name not in self.given_up]
        if left or self._held is None:
            return left
        self.keep()
        return self._next()

    def _give_up(self, viewpoint: Viewpoint, error: DeviceError) -> None:
        self.keep()
        self._record_failure(viewpoint, error, skipped=True)
        self.given_up.add(viewpoint.name)

    def _follow(self, plan: StepPlan) -> None:
        """Take over the ways of a plan; what was planned before and is not in it comes last."""
        fresh = {viewpoint.name: viewpoint for viewpoint in plan.viewpoints}
        self._planned = fresh | {name: v for name, v in self._planned.items() if name not in fresh}
        self._refused = {name: why for name, why in self._refused.items() if name not in fresh} | dict(plan.refused)
        self._stands_rad |= plan.starts_rad
        self._targets.clear()

    def _capture_with_retries(self, todo: Sequence[Viewpoint]) -> Shot:
        """Capture the first of the viewpoints still to capture."""
        context, viewpoint = self.context, todo[0]
        at(viewpoint=viewpoint.name)
        if viewpoint.name in self._refused:
            raise self._left_out(viewpoint)
        robot = context.devices.robot(viewpoint.station)
        was_busy = False
        for tries_left in range(context.step.recovery.retries, -1, -1):
            arrived = False
            try:
                todo = self._planned_from_here(robot, todo)
                viewpoint = todo[0]
                settled = self._go_to(robot, viewpoint)
                arrived = True
                environment = self._dwell(robot, todo[1:])
                context.busy(f"taking {viewpoint.name} and fetching it from the camera{self._size}")
                further = exposing_at(context, viewpoint, self.further)
                exposure = Exposure(
                    self.camera, robot, viewpoint, settled, environment, self.wanted, self.task.image_kind, further
                )
                return expose(context, exposure, was_busy=was_busy)
            except WORTH_ANOTHER_TRY as error:
                was_busy = isinstance(error, DeviceBusyError)
                self.keep()
                self._record_failure(viewpoint, error, skipped=False)
                if isinstance(error, DriverKilledError):
                    self._open_killed(robot, arrived=arrived)
                    raise
                if tries_left == 0:
                    raise
                context.checkpoint()
                if arrived:
                    self._reopen_cameras()
                if not arrived or not _streams(robot):
                    context.devices.reopen(robot)
        raise AssertionError

    def _open_killed(self, robot: RobotArm, *, arrived: bool) -> None:
        """Restart the driver that was ended from outside, for the try after a person's answer."""
        with suppress(DeviceError):  # that try says it again, also that it is another device
            if arrived:
                self._reopen_cameras()
            if not arrived or not _streams(robot):
                self.context.devices.reopen(robot)

    def _reopen_cameras(self) -> None:
        """Open all cameras again, because an error does not say which of them it came from."""
        cameras = [(self.camera, self.wanted), *((one.camera, settings_of(one, self.wanted)) for one in self.further)]
        for camera, wanted in cameras:
            self.context.devices.reopen(camera)
            self.context.busy("setting the camera")
            camera.apply(wanted)

    def _planned_from_here(self, robot: RobotArm, todo: Sequence[Viewpoint]) -> Sequence[Viewpoint]:
        """Return the viewpoints still to capture; the way to the first was planned from where the arm stands.

        All are planned again if it was not: after a viewpoint that could not be taken, or if one is taken again.

        Raises:
            UnreachablePoseError: the arm cannot take the first of them from here.
        """
        first = todo[0]
        here_rad = robot.state().sample.joints_rad
        sent_rad = self._stands_rad.get(first.station)
        if sent_rad is not None:
            self._require_there(robot, self.context.devices.layout(first.station).robot, here_rad, sent_rad)
        unchecked = first.from_rad is None  # the arm's kinematics are not known
        at_an_end = _stands(first.from_rad, here_rad) or _stands(first.joints_rad, here_rad)
        if first.name in self._planned and (unchecked or at_an_end):
            return todo
        plan = self.task.plan_anew(todo)
        self._follow(plan)
        if first.name in plan.refused:
            raise self._left_out(first)
        return plan.viewpoints

    def _left_out(self, viewpoint: Viewpoint) -> UnreachablePoseError:
        return UnreachablePoseError(
            f"the plan leaves it out: {self._refused[viewpoint.name]}",
            where=viewpoint.name,
            remedy="Remove the obstacle, or choose another viewpoint",
        )

    def _go_to(self, robot: RobotArm, viewpoint: Viewpoint) -> SettleReport:
        context = self.context
        name = context.devices.layout(viewpoint.station).robot
        target = self._targets.pop(viewpoint.name, None)
        if target is None:
            target = self._solve(robot, viewpoint)
        motion = context.protocol.motion
        limits = MotionLimits(motion.speed_rad_s, motion.acceleration_rad_s2, context.protocol.settle.timeout_s)
        criteria = settle_criteria(context)

        def move(joints_rad: Array) -> SettleReport:
            settled = move_and_settle(context, robot, joints_rad, limits, criteria, meanwhile=self.keep)
            self._require_there(robot, name, settled.joints_rad, joints_rad)
            return settled

        self._stands_rad.pop(viewpoint.station, None)  # a motion that is cut short ends anywhere
        if len(viewpoint.way_rad) and not _stands(viewpoint.joints_rad, robot.state().sample.joints_rad):
            for joints_rad in viewpoint.way_rad[1:]:
                move(joints_rad)
        settled = move(target)
        self._stands_rad[viewpoint.station] = target
        return settled

    def _require_there(self, robot: RobotArm, name: str, joints_rad: Array, sent_rad: Array) -> None:
        """Hold the arm until a person has confirmed, if it does not stand where it was sent."""
        try:
            require_there(name, joints_rad, sent_rad, step=self.context.step.id)
        except ArmDepartedError:
            self.context.devices.reopen(robot)  # which revokes its leave to move
            raise

    def _dwell(self, robot: RobotArm, later: Sequence[Viewpoint]) -> dict[str, float]:
        """Let the arm rest before the exposure, and use that time; returns the environment."""
        dwell_s = self.context.protocol.motion.dwell_s
        ends_s = self.context.monotonic_s() + dwell_s
        if dwell_s > 0:
            self._solve_ahead(robot, later)
        environment = environment_now(self.context)
        self.context.wait(max(0.0, ends_s - self.context.monotonic_s()))
        return environment

    def _solve(self, robot: RobotArm, viewpoint: Viewpoint) -> Array:
        """Let the controller solve a viewpoint; return its joints (N,). Raises UnreachablePoseError."""
        target, near = flange_target(viewpoint.T_base_camera, self.task.T_flange_camera), viewpoint.joints_rad
        return robot.solve_ik(target, robot.state().sample.joints_rad if near is None else near)

    def _solve_ahead(self, robot: RobotArm, later: Sequence[Viewpoint]) -> None:
        """Solve for the next viewpoint's joints while the arm rests before the exposure, which takes 0.1 s."""
        following = next(iter(later), None)
        if following is None or self.context.devices.robot(following.station) is not robot:
            return
        with suppress(DeviceError):  # an error is handled when the viewpoint's turn comes and it is raised again
            self._targets[following.name] = self._solve(robot, following)

    def _record_failure(self, viewpoint: Viewpoint, error: DeviceError, *, skipped: bool) -> None:
        self.context.evidence.record(
            ViewpointFailed(
                step=self.context.step.id,
                attempt=self.context.attempt,
                viewpoint=viewpoint.name,
                error=type(error).__name__,
                message=str(error),
                skipped=skipped,
            )
        )


def _stands(at_rad: Array | None, joints_rad: Array) -> bool:
    """Return whether an arm with these joints (N,) stands at an end of a planned way; False if none was planned."""
    return at_rad is not None and bool(np.abs(joints_rad - at_rad).max() <= _BEGINS_RAD)


def photograph(context: StepContext, camera: Camera, wanted: CameraSettings, folder: Path) -> CapturedImage:
    """Take a photograph without a robot; repeat it with the camera reopened as often as the step's recovery allows.

    Raises DeviceError if it fails for good, StepInterruptedError on pause.
    """
    was_busy = False
    for tries_left in range(context.step.recovery.retries, -1, -1):
        inside = folder / str(tries_left)  # of its own, because an earlier try may have left files
        inside.mkdir()
        try:
            apply_settings(context, camera, wanted)
            context.busy("taking a photograph and fetching it from the camera")
            return expose_when_free(context, camera, inside, was_busy=was_busy)
        except WORTH_ANOTHER_TRY as error:
            was_busy = isinstance(error, DeviceBusyError)
            if isinstance(error, DriverKilledError):
                with suppress(DeviceError):  # the try after a person's answer says it again
                    context.devices.reopen(camera)
                raise
            if tries_left == 0:
                raise
            context.note("photograph_repeated", why=str(error))
            context.checkpoint()
            context.devices.reopen(camera)
    raise AssertionError


def apply_settings(context: StepContext, camera: Camera, wanted: CameraSettings) -> None:
    """Apply the settings; the camera is reopened if its connection was lost since its last use.

    Raises DriverKilledError if its driver was ended from outside meanwhile; it is open again then.
    """
    context.busy("setting the camera")
    try:
        camera.apply(wanted)
    except WORTH_ANOTHER_TRY as error:
        context.devices.reopen(camera)
        if isinstance(error, DriverKilledError):
            raise
        camera.apply(wanted)


def _streams(robot: RobotArm) -> bool:
    try:
        robot.state()
    except WORTH_ANOTHER_TRY:
        return False
    return True
