"""One exposure with a robot: takes the images of all cameras, judges them and the arm's pose, and records them."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict

import numpy as np

from drivers.errors import DeviceBusyError, DeviceUnavailableError
from drivers.interfaces import Camera, CameraSettings, CapturedImage, RobotArm, RobotSample, SettleReport
from drivers.stated_settings import agrees
from drivers.stillness import PoseSpread, pose_spread
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array, Transform
from service.core.records.base import ArtefactRef
from service.core.records.run_events import FurtherExposure, Matrix4, ViewpointCaptured
from service.steps.context import FurtherCamera, StepContext
from service.steps.motion import settle_criteria
from service.steps.viewpoints import Viewpoint
from service.store.records import NewArtefact

IMAGE_KIND = "further_image"  # artefact kind of their photographs
CALIBRATION_KIND = "camera_calibration"

Expose = Callable[[Camera, Path], CapturedImage]  # releases the shutter; the files arrive in the folder


@dataclass(frozen=True, slots=True)
class FurtherImage:
    """An image that has arrived from a further camera, and the settings that it should have been taken with."""

    taken_by: FurtherCamera
    image: CapturedImage
    wanted: CameraSettings

    @property
    def rigid(self) -> bool:
        """True if the camera moves with the arm."""
        return self.taken_by.section.mounted == "rigid"


def settings_of(camera: FurtherCamera, wanted: CameraSettings) -> CameraSettings:
    """Return the settings of a further camera: those of the protocol, except what its section in rig.yaml gives."""
    section = camera.section
    return replace(
        wanted,
        aperture_f=section.aperture_f or wanted.aperture_f,
        exposure_s=section.exposure_s or wanted.exposure_s,
        iso=section.iso or wanted.iso,
        image_quality=section.image_quality or wanted.image_quality,
    )


def exposing_at(context: StepContext, viewpoint: Viewpoint, cameras: Sequence[FurtherCamera]) -> list[FurtherCamera]:
    """Return the cameras that expose at a viewpoint: all but those that expose once at a station and have done so."""
    seen = {
        exposure.device
        for capture in context.evidence.captures(context.step.id)
        if isinstance(capture, ViewpointCaptured)
        and capture.station == viewpoint.station
        and capture.viewpoint != viewpoint.name  # whose images are taken again
        for exposure in capture.further
    }
    return [camera for camera in cameras if camera.section.every == "viewpoint" or camera.name not in seen]


def expose_further(
    cameras: Sequence[FurtherCamera], wanted: CameraSettings, folder: Path, expose: Expose
) -> tuple[FurtherImage, ...]:
    """Take one image with each camera, one after the other. Raises DeviceError of the first that fails."""
    images: list[FurtherImage] = []
    for camera in cameras:
        inside = folder / camera.name  # of its own, because cameras may give files the same names
        inside.mkdir()
        images.append(FurtherImage(camera, expose(camera.camera, inside), settings_of(camera, wanted)))
    return tuple(images)


def keep_further(context: StepContext, further: FurtherImage) -> tuple[tuple[ArtefactRef, ...], ArtefactRef]:
    """Put the files of a further camera's image into the store, and its calibration; returns both."""
    taken_by = further.taken_by
    images = put_image(context, further.image, IMAGE_KIND)
    calibration = context.evidence.put_file(
        taken_by.calibration,
        kind=CALIBRATION_KIND,
        media_type="application/json",
        original_name=taken_by.calibration.name,
    )
    return images, calibration


def files_of(context: StepContext, exposure: FurtherExposure) -> tuple[ArtefactRef, ...]:
    """Return the files of an exposure to be recorded with it; the calibration only the first time."""
    new = not context.evidence.holds(exposure.calibration.sha256)
    return (*exposure.artefacts, *((exposure.calibration,) if new else ()))


#: Pauses between tries while the camera is busy; nearly a minute in all.
_BUSY_PAUSES_S = (0.5, 1.0, 2.0, 4.0, *(8.0,) * 6)
_BUSY_AGAIN_PAUSES_S = _BUSY_PAUSES_S[:3]  # after the camera was reopened because it stayed busy


@dataclass(frozen=True, slots=True)
class Shot:
    """An image that has arrived from the camera, with everything to be recorded with it."""

    viewpoint: Viewpoint
    image: CapturedImage
    folder: tempfile.TemporaryDirectory[str]  # holds the files until they are in the store
    window: tuple[RobotSample, ...]  # the pose stream during the exposure
    pose: ExposurePose
    environment: dict[str, float]
    verdicts: dict[str, bool]
    image_kind: str
    ringing_s: float
    further: tuple[FurtherImage, ...] = ()


class _Tool(TypedDict):
    """The fields of ViewpointCaptured that say which tool the controller held."""

    T_flange_tcp: Matrix4 | None
    payload_kg: float | None
    payload_centre_m: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class Exposure:
    """The devices and settings that an exposure at a viewpoint needs.

    Attributes:
        camera: the camera that takes the image.
        robot: the arm that holds the camera, and streams its pose.
        viewpoint: the viewpoint at which the arm stands.
        settled: the report on how it came to rest.
        environment: light and temperature before the exposure.
        wanted: the protocol's settings.
        image_kind: the artefact kind of the photograph.
        further: the cameras that expose after it, while the arm stands.
    """

    camera: Camera
    robot: RobotArm
    viewpoint: Viewpoint
    settled: SettleReport
    environment: dict[str, float]
    wanted: CameraSettings
    image_kind: str
    further: Sequence[FurtherCamera] = ()


def expose(context: StepContext, exposure: Exposure, *, was_busy: bool = False) -> Shot:
    """Take the images of all cameras and judge them. `record_shot` records them, while the arm moves on.

    Raises DeviceError of any camera, DeviceUnavailableError if no pose of the arm is known for the exposure.
    """
    wanted = exposure.wanted
    folder = tempfile.TemporaryDirectory(prefix="orthocapture-")
    try:
        image = expose_when_free(context, exposure.camera, Path(folder.name), was_busy=was_busy)
        window = _during(exposure.robot, image, wanted)
        further = expose_further(
            exposure.further,
            wanted,
            Path(folder.name),
            lambda camera, inside: expose_when_free(context, camera, inside, was_busy=was_busy),
        )
        for camera in further:
            if camera.rigid:  # it moved if the arm did
                window += _during(exposure.robot, camera.image, camera.wanted)
        pose = exposure_pose(window)
    except BaseException:
        folder.cleanup()
        raise
    verdicts = {
        "still": pose.spread.within(settle_criteria(context)),
        "settings": settings_agree(image.exif, wanted) and all(map(_as_wanted, further)),
    }
    return Shot(
        viewpoint=exposure.viewpoint,
        image=image,
        folder=folder,
        window=window,
        pose=pose,
        environment=exposure.environment,
        verdicts=verdicts,
        image_kind=exposure.image_kind,
        ringing_s=exposure.settled.ringing_s,
        further=further,
    )


def _during(robot: RobotArm, image: CapturedImage, wanted: CameraSettings) -> tuple[RobotSample, ...]:
    """Return the pose stream during an exposure."""
    began_s = image.trigger_monotonic_s
    return robot.samples(began_s, began_s + wanted.exposure_s + 0.3)


def _as_wanted(further: FurtherImage) -> bool:
    return settings_agree(further.image.exif, further.wanted)


def record_shot(context: StepContext, shot: Shot) -> None:
    """Record an image: first its files, then its rows and its event in one transaction."""
    with shot.folder:
        files = put_image(context, shot.image, shot.image_kind)
        further = tuple(_further_exposure(context, one) for one in shot.further)
    refs = [*files, _pose_log(context, shot.viewpoint, shot.window)]
    rows = [_row(context, shot, ref, "robot" if ref.kind == "pose_log" else "camera") for ref in refs]
    rows += [_row(context, shot, ref, one.device) for one in further for ref in files_of(context, one)]
    captured = _captured(context, shot, refs).model_copy(update={"further": further})
    context.evidence.record(captured, artefacts=tuple(rows))


def _further_exposure(context: StepContext, further: FurtherImage) -> FurtherExposure:
    files, calibration = keep_further(context, further)
    return FurtherExposure(
        device=further.taken_by.name,
        mounted=further.taken_by.section.mounted,
        artefacts=files,
        calibration=calibration,
        camera=camera_record(further.image),
        trigger_monotonic_s=further.image.trigger_monotonic_s,
        arrival_monotonic_s=further.image.arrival_monotonic_s,
        verdicts={"settings": _as_wanted(further)},
    )


def _row(context: StepContext, shot: Shot, ref: ArtefactRef, device: str) -> NewArtefact:
    return NewArtefact(
        ref=ref,
        device=device,
        step=context.step.id,
        attempt=context.attempt,
        viewpoint=shot.viewpoint.name,
        who=context.operator,
        monotonic_s=next(
            (one.image.trigger_monotonic_s for one in shot.further if one.taken_by.name == device),
            shot.image.trigger_monotonic_s,
        ),
    )


def _captured(context: StepContext, shot: Shot, refs: Sequence[ArtefactRef]) -> ViewpointCaptured:
    image, pose = shot.image, shot.pose
    return ViewpointCaptured(
        step=context.step.id,
        attempt=context.attempt,
        viewpoint=shot.viewpoint.name,
        station=shot.viewpoint.station,
        artefacts=tuple(refs),
        T_base_flange=_rows(pose.spread.T_base_flange),
        pose_sigma_m=pose.spread.position_sigma_m,
        pose_sigma_rad=pose.spread.rotation_sigma_rad,
        joints_rad=tuple(float(q) for q in pose.joints_rad),
        pose_samples=pose.spread.samples,
        trigger_monotonic_s=image.trigger_monotonic_s,
        arrival_monotonic_s=image.arrival_monotonic_s,
        controller_time_s=pose.controller_time_s,
        clock_offset_s=pose.clock_offset_s,
        ringing_s=shot.ringing_s,
        **_tool(shot.window[-1]),
        camera=camera_record(image),
        environment=shot.environment,
        verdicts=shot.verdicts,
    )


def _tool(sample: RobotSample) -> _Tool:
    """Return the tool that the controller held, as the event has it; all samples of an exposure have the same."""
    tool, payload = sample.T_flange_tcp, sample.payload
    return {
        "T_flange_tcp": None if tool is None else _rows(tool),
        "payload_kg": None if payload is None else payload.mass_kg,
        "payload_centre_m": None if payload is None else payload.centre_of_gravity_m,
    }


def expose_when_free(context: StepContext, camera: Camera, folder: Path, *, was_busy: bool = False) -> CapturedImage:
    """Release the shutter. While the camera is busy with an earlier image, try again for up to a minute.

    Args:
        context: the step's surroundings: devices, evidence, clock.
        camera: the camera that takes the image.
        folder: the files' folder.
        was_busy: true if it was busy for a minute already: then try for a few seconds only.
    """
    for pause_s in _BUSY_AGAIN_PAUSES_S if was_busy else _BUSY_PAUSES_S:
        try:
            return camera.capture(folder)
        except DeviceBusyError:
            context.checkpoint()
            context.progress("waiting for the camera, which is busy", 0, 1)
            context.wait(pause_s)
    return camera.capture(folder)


@dataclass(frozen=True, slots=True)
class ExposurePose:
    """The mean pose of the flange during an exposure, its spread, and the clocks in the middle of the exposure."""

    spread: PoseSpread
    joints_rad: Array  # (N,), mean
    controller_time_s: float
    clock_offset_s: float  # controller time minus host monotonic time


def exposure_pose(window: Sequence[RobotSample]) -> ExposurePose:
    """Return the pose of the flange during an exposure, from its samples, oldest first.

    Raises DeviceUnavailableError if there are none.
    """
    if not window:
        raise DeviceUnavailableError(
            "the robot's pose stream has no sample during the exposure",
            where="robot",
            remedy="The image cannot be used without a pose; the viewpoint is captured again",
        )
    middle = window[len(window) // 2]
    return ExposurePose(
        spread=pose_spread(window),
        joints_rad=np.mean([s.joints_rad for s in window], axis=0),
        controller_time_s=middle.controller_time_s,
        clock_offset_s=middle.controller_time_s - middle.monotonic_s,
    )


def settings_agree(actual: CameraSettings, wanted: CameraSettings) -> bool:
    """Return whether an image's EXIF has the protocol's settings: ISO exactly, aperture and time up to rounding."""
    return (
        agrees(actual.aperture_f, wanted.aperture_f)
        and agrees(actual.exposure_s, wanted.exposure_s)
        and actual.iso == wanted.iso
    )


def wanted_settings(context: StepContext) -> CameraSettings:
    """Return the camera settings of the protocol. Raises ConfigurationError if it has none."""
    camera = context.protocol.camera
    if camera is None:
        raise ConfigurationError(
            "the protocol has no section `camera`",
            where=context.protocol.id,
            remedy="Add it, with aperture, exposure time and ISO",
        )
    return CameraSettings(
        aperture_f=camera.aperture_f,
        exposure_s=camera.exposure_s,
        iso=camera.iso,
        focus_mode=camera.focus_mode,
        image_quality=camera.image_quality,
    )


def environment_now(context: StepContext) -> dict[str, float]:
    """Read light and temperature from the light box; empty without one."""
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
    """Store the pose stream during the exposure as it was received."""
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


def camera_record(image: CapturedImage) -> dict[str, object]:
    """Return the camera's part of the event of an exposure."""
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
        "model": image.model,
        "focus_distance_m": image.focus_distance_m,
        "focus_position": image.focus_position,
    }


def _rows(T: Transform) -> Matrix4:
    if T.shape != (4, 4):
        raise DataError(
            f"a pose is a 4×4 matrix, not {T.shape}", where="robot", remedy="Report this error of the driver"
        )
    return tuple((float(r[0]), float(r[1]), float(r[2]), float(r[3])) for r in T)


def put_image(context: StepContext, image: CapturedImage, kind: str) -> tuple[ArtefactRef, ...]:
    """Put all files of an image into the store; `kind` is the artefact kind of its JPEG."""
    return tuple(
        context.evidence.put_file(
            file.path,
            kind=kind if file.media_type == "image/jpeg" else "raw",
            media_type=file.media_type,
            original_name=file.camera_name,
        )
        for file in image.files
    )
