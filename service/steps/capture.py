"""One image, from the shutter to the evidence: move, settle, expose, download, record, for each viewpoint."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    StaleImageError,
    UnreachablePoseError,
    UnreadableFileError,
)
from drivers.interfaces import Camera, CameraSettings, CapturedImage, RobotArm, RobotSample, SettleReport
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad
from service.core.model import ArtefactRef, Matrix4, ViewpointCaptured, ViewpointFailed
from service.steps.context import StepContext
from service.steps.motion import MotionLimits, move_and_settle, settle_criteria
from service.steps.viewpoints import Viewpoint, flange_target
from service.store.records import NewArtefact

#: Errors after which the same viewpoint may be tried again on a reopened device.
_WORTH_ANOTHER_TRY = (
    DeviceUnavailableError,
    DeviceTimeoutError,
    DeviceBusyError,
    StaleImageError,
    UnreadableFileError,
)
#: How long a busy camera is left alone before the next try: nearly a minute in all.
_BUSY_PAUSES_S = (0.5, 1.0, 2.0, 4.0, *(8.0,) * 6)
NONE_REFUSED: Mapping[str, str] = {}


@dataclass(frozen=True, slots=True)
class CaptureTotals:
    """What a capture loop came to, the earlier part of a resumed one included."""

    planned: int
    captured: int
    given_up: int
    settings_departures: int
    moved: int

    def measures(self) -> dict[str, float]:
        """As numbers for gates."""
        return {
            "viewpoints_planned": float(self.planned),
            "viewpoints_captured": float(self.captured),
            "viewpoints_given_up": float(self.given_up),
            "settings_departures": float(self.settings_departures),
            "moved_during_exposure": float(self.moved),
        }


def capture_viewpoints(
    context: StepContext,
    viewpoints: Sequence[Viewpoint],
    T_flange_camera: Transform,
    *,
    image_kind: str,
    refused: Mapping[str, str] = NONE_REFUSED,
    on_captured: Callable[[], None] = lambda: None,
) -> CaptureTotals:
    """Capture every viewpoint that this attempt has not captured yet, in order.

    Args:
        T_flange_camera: the best known mounting; decides only where the camera goes, not where it was.
        image_kind: artefact kind of the photographs (`image`, `board_image`, `control_image`).
        refused: viewpoints that the plan has given up, with the reason; recorded as such, not tried.
        on_captured: called after each image that is in the record; must return at once.

    Raises DeviceError when a viewpoint fails for good, StepInterruptedError on pause.
    """
    camera = context.devices.camera()
    wanted = wanted_settings(context)
    _apply(context, camera, wanted)
    given_up = set(context.state.skipped_viewpoints)
    taken: set[str] = set()  # in this execution, successful or not
    # Looked up anew each time: an operator may send a viewpoint back while the arm moves.
    while todo := _next(context, viewpoints, given_up, taken):
        context.checkpoint()
        context.progress("viewpoints", len(viewpoints) - len(todo), len(viewpoints))
        viewpoint = todo[0]
        if viewpoint.name in refused:
            refusal = UnreachablePoseError(f"the plan leaves it out: {refused[viewpoint.name]}")
            context.evidence.record(_failed(context, viewpoint, refusal, skipped=True))
            given_up.add(viewpoint.name)
            continue
        try:
            _capture_with_retries(context, camera, viewpoint, T_flange_camera, wanted, image_kind)
        except UnreachablePoseError as error:
            context.evidence.record(_failed(context, viewpoint, error, skipped=True))
            given_up.add(viewpoint.name)
        else:
            on_captured()
        taken.add(viewpoint.name)
    context.progress("viewpoints", len(viewpoints), len(viewpoints))
    captures = context.evidence.captures(context.step.id)
    return CaptureTotals(
        planned=len(viewpoints),
        captured=len(captures),
        given_up=len(given_up),
        settings_departures=sum(not capture.verdicts["settings"] for capture in captures),
        moved=sum(not capture.verdicts["still"] for capture in captures),
    )


def _next(
    context: StepContext, viewpoints: Sequence[Viewpoint], given_up: Set[str], taken: Set[str]
) -> list[Viewpoint]:
    """What is still to be captured, in order. An image whose verdicts failed is taken again, once an execution."""
    captures = {capture.viewpoint: capture for capture in context.evidence.captures(context.step.id)}
    done = {name for name, capture in captures.items() if name in taken or all(capture.verdicts.values())}
    return [viewpoint for viewpoint in viewpoints if viewpoint.name not in done and viewpoint.name not in given_up]


def _capture_with_retries(
    context: StepContext,
    camera: Camera,
    viewpoint: Viewpoint,
    T_flange_camera: Transform,
    wanted: CameraSettings,
    image_kind: str,
) -> None:
    robot = context.devices.robot(viewpoint.station)
    for tries_left in range(context.step.recovery.retries, -1, -1):
        arrived = False
        try:
            settled = _go_to(context, robot, viewpoint, T_flange_camera)
            arrived = True
            _expose(context, camera, robot, viewpoint, settled, wanted, image_kind)
        except _WORTH_ANOTHER_TRY as error:
            context.evidence.record(_failed(context, viewpoint, error, skipped=False))
            if tries_left == 0:
                raise
            context.checkpoint()
            if arrived:
                context.devices.reopen(camera)
                camera.apply(wanted)
            if not arrived or not _streams(robot):
                context.devices.reopen(robot)
        else:
            return


def photograph(context: StepContext, camera: Camera, wanted: CameraSettings, folder: Path) -> CapturedImage:
    """One exposure without a robot; repeated, on a reopened camera, as often as the step's recovery allows.

    Raises DeviceError when it fails for good, StepInterruptedError on pause.
    """
    for tries_left in range(context.step.recovery.retries, -1, -1):
        inside = folder / str(tries_left)  # what an earlier try has left behind is not in the way
        inside.mkdir()
        try:
            _apply(context, camera, wanted)
            return _expose_when_free(context, camera, inside)
        except _WORTH_ANOTHER_TRY as error:
            if tries_left == 0:
                raise
            context.note("photograph_repeated", why=str(error))
            context.checkpoint()
            context.devices.reopen(camera)
    raise AssertionError


def _expose_when_free(context: StepContext, camera: Camera, folder: Path) -> CapturedImage:
    """Release the shutter, and wait for a camera that is still busy with what came before."""
    for pause_s in _BUSY_PAUSES_S:
        try:
            return camera.capture(folder)
        except DeviceBusyError:
            context.checkpoint()
            context.progress("waiting for the camera, which is busy", 0, 1)
            context.wait(pause_s)
    return camera.capture(folder)


def _apply(context: StepContext, camera: Camera, wanted: CameraSettings) -> None:
    """Set the camera, which may have dropped its link since it was last used."""
    try:
        camera.apply(wanted)
    except _WORTH_ANOTHER_TRY:
        context.devices.reopen(camera)
        camera.apply(wanted)


def _streams(robot: RobotArm) -> bool:
    try:
        robot.state()
    except _WORTH_ANOTHER_TRY:
        return False
    return True


def _go_to(context: StepContext, robot: RobotArm, viewpoint: Viewpoint, T_flange_camera: Transform) -> SettleReport:
    near = robot.state().sample.joints_rad if viewpoint.joints_rad is None else viewpoint.joints_rad
    target = robot.solve_ik(flange_target(viewpoint.T_base_camera, T_flange_camera), near)
    motion = context.protocol.motion
    limits = MotionLimits(motion.speed_rad_s, motion.acceleration_rad_s2, context.protocol.settle.timeout_s)
    criteria = settle_criteria(context)
    report = move_and_settle(context, robot, target, limits, criteria)
    if motion.dwell_s > 0:
        context.wait(motion.dwell_s)
    return report


def _expose(
    context: StepContext,
    camera: Camera,
    robot: RobotArm,
    viewpoint: Viewpoint,
    settled: SettleReport,
    wanted: CameraSettings,
    image_kind: str,
) -> None:
    """Take the picture and write it down: files first, then one transaction with rows and event."""
    environment = _environment(context)
    with tempfile.TemporaryDirectory(prefix="orthocapture-") as folder:
        image = _expose_when_free(context, camera, Path(folder))
        window = robot.samples(image.trigger_monotonic_s, image.trigger_monotonic_s + wanted.exposure_s + 0.3)
        pose = _mean_pose(window, settled)
        refs = [
            context.evidence.put_file(
                file.path,
                kind=image_kind if file.media_type == "image/jpeg" else "raw",
                media_type=file.media_type,
                original_name=file.camera_name,
            )
            for file in image.files
        ]
    refs.append(_pose_log(context, viewpoint, window))
    criteria = settle_criteria(context)
    verdicts = {
        "still": pose.spread_m <= criteria.position_peak_to_peak_m
        and pose.spread_rad <= criteria.rotation_peak_to_peak_rad,
        "settings": settings_agree(image.exif, wanted),
    }
    rows = tuple(
        NewArtefact(
            ref=ref,
            device="robot" if ref.kind == "pose_log" else "camera",
            step=context.step.id,
            attempt=context.attempt,
            viewpoint=viewpoint.name,
            who=context.operator,
            monotonic_s=image.trigger_monotonic_s,
        )
        for ref in refs
    )
    context.evidence.record(
        ViewpointCaptured(
            step=context.step.id,
            attempt=context.attempt,
            viewpoint=viewpoint.name,
            station=viewpoint.station,
            artefacts=tuple(refs),
            T_base_flange=_rows(pose.T_base_flange),
            pose_sigma_m=pose.sigma_m,
            pose_sigma_rad=pose.sigma_rad,
            joints_rad=tuple(float(q) for q in pose.joints_rad),
            pose_samples=pose.samples,
            trigger_monotonic_s=image.trigger_monotonic_s,
            arrival_monotonic_s=image.arrival_monotonic_s,
            controller_time_s=pose.controller_time_s,
            clock_offset_s=pose.clock_offset_s,
            camera=_camera_record(image),
            environment=environment,
            verdicts=verdicts,
        ),
        artefacts=rows,
    )


@dataclass(frozen=True, slots=True)
class _ExposurePose:
    T_base_flange: Transform
    joints_rad: Array
    samples: int
    sigma_m: float
    sigma_rad: float
    spread_m: float
    spread_rad: float
    controller_time_s: float
    clock_offset_s: float


def _mean_pose(window: Sequence[RobotSample], settled: SettleReport) -> _ExposurePose:
    """Average the pose over the exposure; rotations average on the tangent of the settled pose."""
    if not window:
        raise DeviceUnavailableError(
            "the robot's pose stream has no sample during the exposure",
            remedy="The image cannot be used without its pose; the viewpoint is taken again",
        )
    reference = inverse(settled.T_base_flange)
    deltas = [reference @ s.T_base_flange for s in window]
    positions = np.array([s.T_base_flange[:3, 3] for s in window])
    angles = np.array([rotation_angle_rad(d) for d in deltas])
    middle = window[len(window) // 2]
    T = settled.T_base_flange.copy() if len(window) < 3 else middle.T_base_flange.copy()
    T[:3, 3] = positions.mean(axis=0)
    return _ExposurePose(
        T_base_flange=T,
        joints_rad=np.mean([s.joints_rad for s in window], axis=0),
        samples=len(window),
        sigma_m=float(np.sqrt(positions.var(axis=0).sum())),
        sigma_rad=float(angles.std()),
        spread_m=float(np.ptp(positions, axis=0).max()),
        spread_rad=float(np.ptp(angles)),
        controller_time_s=middle.controller_time_s,
        clock_offset_s=middle.controller_time_s - middle.monotonic_s,
    )


def settings_agree(actual: CameraSettings, wanted: CameraSettings) -> bool:
    """Whether an image's EXIF shows the protocol's settings (aperture and time to 2 %, ISO exactly)."""
    return (
        abs(actual.aperture_f / wanted.aperture_f - 1) < 0.02
        and abs(actual.exposure_s / wanted.exposure_s - 1) < 0.02
        and actual.iso == wanted.iso
    )


def wanted_settings(context: StepContext) -> CameraSettings:
    """The camera settings of the protocol."""
    camera = context.protocol.camera
    return CameraSettings(
        aperture_f=camera.aperture_f,
        exposure_s=camera.exposure_s,
        iso=camera.iso,
        focus_mode=camera.focus_mode,
        image_quality=camera.image_quality,
    )


def _environment(context: StepContext) -> dict[str, float]:
    lightbox = context.devices.lightbox()
    if lightbox is None:
        return {}
    try:
        reading = lightbox.read()
    except DeviceUnavailableError:
        context.devices.reopen(lightbox)
        reading = lightbox.read()
    return {"light_lux": reading.light_lux, "temperature_c": reading.temperature_c}


def _pose_log(context: StepContext, viewpoint: Viewpoint, window: Sequence[RobotSample]) -> ArtefactRef:
    """The pose stream over the exposure, as it was received."""
    lines = [
        json.dumps(
            {
                "controller_time_s": s.controller_time_s,
                "monotonic_s": s.monotonic_s,
                "joints_rad": s.joints_rad.tolist(),
                "T_base_flange": s.T_base_flange.tolist(),
                "tcp_speed_m_s": s.tcp_speed_m_s,
                "safety": s.safety.value,
            }
        )
        for s in window
    ]
    return context.evidence.put_bytes(
        ("\n".join(lines) + "\n").encode(),
        kind="pose_log",
        media_type="application/x-ndjson",
        original_name=f"{viewpoint.name}.poses.jsonl",
    )


def _camera_record(image: CapturedImage) -> dict[str, object]:
    return {
        **dataclasses.asdict(image.exif),
        "counter": image.counter,
        "exif_time": image.exif_time,
        "lens": image.lens,
        "focal_length_mm": image.focal_length_mm,
        "width": image.width,
        "height": image.height,
        "lens_serial": image.lens_serial,
        "body_serial": image.body_serial,
        "focus_distance_m": image.focus_distance_m,
    }


def _failed(context: StepContext, viewpoint: Viewpoint, error: DeviceError, *, skipped: bool) -> ViewpointFailed:
    return ViewpointFailed(
        step=context.step.id,
        attempt=context.attempt,
        viewpoint=viewpoint.name,
        error=type(error).__name__,
        message=str(error),
        skipped=skipped,
    )


def _rows(T: Transform) -> Matrix4:
    if T.shape != (4, 4):
        raise DataError(f"a pose is a 4×4 matrix, not {T.shape}")
    return tuple((float(r[0]), float(r[1]), float(r[2]), float(r[3])) for r in T)
