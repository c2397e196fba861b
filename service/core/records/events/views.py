"""Events of captures: images, and those that could not be taken."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.core.records.base import ArtefactRef, Record

Matrix4 = tuple[tuple[float, float, float, float], ...]  # T_a_b row-major, metres


class RecordedView(Record):
    """What the record holds for every photograph, whether taken by robot, by hand or imported."""

    step: str
    attempt: int
    viewpoint: str  # name of the view, unique within its step
    station: str  # of the robot; "" without one
    artefacts: tuple[ArtefactRef, ...]  # the photograph first
    camera: dict[str, Any]  # EXIF settings, counter, time, lens
    environment: dict[str, float] = Field(default_factory=dict)  # light_lux, temperature_c
    verdicts: dict[str, bool] = Field(default_factory=dict)  # still, settings, sharp …


class FurtherExposure(Record):
    """What a further camera exposed at the same viewpoint, after the first one."""

    device: str  # name in rig.yaml
    mounted: Literal["fixed", "rigid"]  # in the room, or beside the first camera
    artefacts: tuple[ArtefactRef, ...]  # the photograph first
    calibration: ArtefactRef  # file with the intrinsics of this camera
    camera: dict[str, Any]  # EXIF settings, counter, time, lens
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    verdicts: dict[str, bool] = Field(default_factory=dict[str, bool])  # settings; the view's own include them


class ViewpointCaptured(RecordedView):
    """One complete exposure of a camera carried by a robot: files, pose, settings, environment."""

    kind: Literal["viewpoint_captured"] = "viewpoint_captured"
    T_base_flange: Matrix4  # mean over the exposure
    pose_sigma_m: float  # standard deviation of the position over the exposure
    pose_sigma_rad: float  # of the rotation vector; early runs recorded that of its length, which is smaller
    joints_rad: tuple[float, ...]
    pose_samples: int
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    controller_time_s: float
    clock_offset_s: float  # controller time minus host monotonic
    further: tuple[FurtherExposure, ...] = ()  # of the rig's further cameras that exposed here
    ringing_s: float = 0.0  # how long the arm swung after the commanded motion; a loose mount shows here
    T_flange_tcp: Matrix4 | None = None  # the tool that the controller held; None: it did not tell
    payload_kg: float | None = None  # that the controller reckoned with
    payload_centre_m: tuple[float, float, float] | None = None  # its centre of gravity in the flange frame


class ViewImported(RecordedView):
    """One photograph that was captured earlier. The record proves only when and by whom it was imported."""

    kind: Literal["view_imported"] = "view_imported"
    imported_by: str
    file_name: str  # within the imported folder
    modified_utc: str  # modification time in the file system


class ViewHeld(RecordedView):
    """One exposure of a hand-held camera. The worker estimates its pose from the image (its answer to the job)."""

    kind: Literal["view_held"] = "view_held"
    # `camera`: its own button; `screen`, `pedal`: the software released it. `elsewhere`: the image was found as a
    # file, and only what the file says is known.
    released_by: Literal["camera", "screen", "pedal", "elsewhere"]
    found_at: str = ""  # path of that file
    arrival_monotonic_s: float


class CaptureAsked(Record):
    """A person at a screen asks the running step to release the shutter, or to finish with the images it has."""

    kind: Literal["capture_asked"] = "capture_asked"
    step: str
    attempt: int
    what: Literal["release", "finish"]


class ViewpointFailed(Record):
    """A viewpoint could not be captured this time."""

    kind: Literal["viewpoint_failed"] = "viewpoint_failed"
    step: str
    attempt: int
    viewpoint: str
    error: str
    message: str
    skipped: bool = False  # given up, and the step continues with the next one (a deviation)
