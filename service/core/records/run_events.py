"""Events of a run: what happens in it, what people do in it, and what a photograph states of its camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from pydantic import Field

from service.core.records.base import ArtefactRef, Record
from service.core.records.entered import RunAbout

# Camera, lens and settings as a photograph states them, read from the field `camera` of a recorded photograph.
#
# Drivers of any version, bodies of any maker and other people's files wrote that field: any key may be missing,
# unknown or of another type, and an event must keep it as it is, because its hash was signed. So the field stays
# plain JSON, and it is read here and nowhere else (docs/decisions/0021-what-a-photograph-states.md).


Plain = Mapping[str, object]


@dataclass(frozen=True, slots=True)
class RecordedOptics:
    """Camera, lens and settings as a photograph states them; "" or None: not given."""

    make: str = ""
    model: str = ""
    body_serial: str = ""
    lens: str = ""
    lens_serial: str = ""
    focal_length_mm: float | None = None
    aperture_f: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    focus_mode: str = ""
    focus_distance_m: float | None = None
    focus_position: int | None = None  # of the focus motor, in its own steps
    width: int | None = None
    height: int | None = None
    exif_time: str = ""
    unread: str = ""  # what could not be read of the file's EXIF


def recorded_optics(camera: object) -> RecordedOptics:
    """Return what the `camera` of a recorded photograph states.

    Zero stands for a number that the camera does not know. Only the focus motor has a position zero.
    """
    fields = mapping_of(camera)
    focus_position = number_of(fields.get("focus_position"))
    return RecordedOptics(
        make=text_of(fields.get("make")),
        model=text_of(fields.get("model")),
        body_serial=text_of(fields.get("body_serial")),
        lens=text_of(fields.get("lens")),
        lens_serial=text_of(fields.get("lens_serial")),
        focal_length_mm=number_of(fields.get("focal_length_mm")) or None,
        aperture_f=number_of(fields.get("aperture_f")) or None,
        exposure_s=number_of(fields.get("exposure_s")) or None,
        iso=number_of(fields.get("iso")) or None,
        focus_mode=text_of(fields.get("focus_mode")),
        focus_distance_m=number_of(fields.get("focus_distance_m")) or None,
        focus_position=None if focus_position is None else int(focus_position),
        width=int(number_of(fields.get("width")) or 0) or None,
        height=int(number_of(fields.get("height")) or 0) or None,
        exif_time=text_of(fields.get("exif_time")),
        unread=text_of(fields.get("unread")),
    )


def mapping_of(value: object) -> Plain:
    """Return a recorded JSON object; an empty one in place of any other value."""
    return cast("Plain", value) if isinstance(value, Mapping) else {}


def text_of(value: object) -> str:
    """Return a recorded value as text; "" where nothing was given."""
    return "" if value is None else str(value)


def number_of(value: object) -> float | None:
    """Return a recorded number; None in place of any other value."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


class RunStarted(Record):
    """Root of the chain."""

    kind: Literal["run_started"] = "run_started"
    protocol_id: str
    protocol_version: str
    protocol_sha256: str
    protocol: ArtefactRef
    rig: ArtefactRef
    simulated: bool
    auto_confirm: bool
    operator: str
    software: dict[str, str]  # distribution → version
    # imported: the photographs were captured earlier, elsewhere; `rig` is then the list of what was imported
    origin: Literal["captured", "imported"] = "captured"
    about: RunAbout | None = None  # None: nothing was entered


class HostClock(Record):
    """The host clock's synchronisation; None stands for not known."""

    source: Literal["chrony", "kernel", ""]
    synchronised: bool | None  # true if synchronised with the network's time
    offset_s: float | None  # host minus network
    error_s: float | None = None  # the kernel's bound on the error


class SessionStarted(Record):
    """The runner's process started, for the first time or on resume; records versions and the host's clock."""

    kind: Literal["session_started"] = "session_started"
    resumed: bool
    software: dict[str, str]
    host: str
    pid: int
    host_clock: HostClock | None = None


class DeviceOpened(Record):
    """A device was opened; `report` is its DeviceReport as plain data."""

    kind: Literal["device_opened"] = "device_opened"
    device: str  # name in rig.yaml
    report: dict[str, Any]


class DeviceTrouble(Record):
    """A device failed, stopped or was restarted."""

    kind: Literal["device_trouble"] = "device_trouble"
    device: str
    error: str
    message: str
    data_safe: bool = True
    # How the connection to an arm ended with it, or that none could be made; "" where it did not end.
    connection: Literal["", "died", "stalled", "broken", "refused"] = ""


class LeaveLapsed(Record):
    """A person's confirmation that the robot may move is over: nothing visible came of it for too long."""

    kind: Literal["leave_lapsed"] = "leave_lapsed"
    leave_seq: int  # the event that gave it
    idle_s: float  # without visible progress since then, or since the last progress
    limit_s: float  # the protocol's limit: motion.confirmed_for_s
    why: str = ""  # the thing that the run had waited for; "" if it is not known


class RunCompleted(Record):
    """Every step passed or was skipped."""

    kind: Literal["run_completed"] = "run_completed"
    deviations: int


class RunAborted(Record):
    """A person or a step's recovery policy ended the run early; what was captured stays."""

    kind: Literal["run_aborted"] = "run_aborted"
    reason: str


class StepStarted(Record):
    """The work of a step begins (ready → running)."""

    kind: Literal["step_started"] = "step_started"
    step: str
    attempt: int


class StepNote(Record):
    """A finding of a step that belongs in the record (station entered, timer started, …)."""

    kind: Literal["step_note"] = "step_note"
    step: str
    attempt: int
    note: str
    data: dict[str, Any] = Field(default_factory=dict)


class FilesKept(Record):
    """Files that arrived from a scanner or CT, or were decoded from such files, and are now in the evidence."""

    kind: Literal["files_kept"] = "files_kept"
    step: str
    attempt: int
    device: str
    note: str
    artefacts: tuple[ArtefactRef, ...]


class Uncertainty(Record):
    """The uncertainty of a measured number, in the number's own unit."""

    sigma: float  # standard deviation
    lower: float  # the true value is above this with 99 % confidence (one-sided)
    upper: float  # the true value is below this with 99 % confidence (one-sided)


class ComputedBy(Record):
    """A job whose measures, and whose answer, a step gave as its own."""

    job: str
    prefix: str = ""  # the text that the step put before the names of the job's measures: `colmap_`


class StepMeasured(Record):
    """The work of a step is done: its numbers, before any gate (running → checking)."""

    kind: Literal["step_measured"] = "step_measured"
    step: str
    attempt: int
    measures: dict[str, float]
    artefacts: tuple[ArtefactRef, ...] = ()
    result: dict[str, Any] = Field(default_factory=dict)  # the step kind's Result as plain data
    uncertainties: dict[str, Uncertainty] = Field(default_factory=dict)  # those of the measures that have one
    computed_by: tuple[ComputedBy, ...] | None = None  # None: recorded before events named the jobs


class StepFailed(Record):
    """The work of a step ended with an error; recovery says what happens next (running → recovering)."""

    kind: Literal["step_failed"] = "step_failed"
    step: str
    attempt: int
    error: str
    message: str
    recovery: Literal["retry", "ask", "abort"]


class StepRetried(Record):
    """A step is tried again, by the recovery policy or on the operator's confirmation (recovering → running)."""

    kind: Literal["step_retried"] = "step_retried"
    step: str
    attempt: int
    why: str


class GateVerdict(Record):
    """One measured number against its limit."""

    measure: str
    value: float | None  # None if the step did not measure it, which fails the gate
    minimum: float | None
    maximum: float | None
    unit: str
    passed: bool
    sigma: float | None = None  # the value's standard deviation, where it is known
    lower: float | None = None
    upper: float | None = None
    undecided: bool = False  # a limit lies between the bounds; `passed` is then false


class GatesEvaluated(Record):
    """All gates of a step (checking → awaiting_operator or recovering)."""

    kind: Literal["gates_evaluated"] = "gates_evaluated"
    step: str
    attempt: int
    verdicts: tuple[GateVerdict, ...]
    passed: bool


class StepPassed(Record):
    """The step is done and the next one becomes ready (awaiting_operator → passed)."""

    kind: Literal["step_passed"] = "step_passed"
    step: str
    attempt: int


Matrix4 = tuple[tuple[float, float, float, float], ...]  # T_a_b row-major, metres


class RecordedView(Record):
    """The record of every photograph, whether taken by robot, by hand or imported."""

    step: str
    attempt: int
    viewpoint: str  # name of the view, unique within its step
    station: str  # the robot's station; "" without one
    artefacts: tuple[ArtefactRef, ...]  # the photograph first
    camera: dict[str, Any]  # as its driver or its file stated it; read by `optics`
    environment: dict[str, float] = Field(default_factory=dict)  # light_lux, temperature_c
    verdicts: dict[str, bool] = Field(default_factory=dict)  # still, settings, sharp …

    @property
    def optics(self) -> RecordedOptics:
        """Return what the photograph states of its camera, lens and settings."""
        return recorded_optics(self.camera)


class FurtherExposure(Record):
    """The exposure of a further camera at the same viewpoint, after the first one."""

    device: str  # name in rig.yaml
    mounted: Literal["fixed", "rigid"]  # in the room, or beside the first camera
    artefacts: tuple[ArtefactRef, ...]  # the photograph first
    calibration: ArtefactRef  # file with the intrinsics of this camera
    camera: dict[str, Any]  # as its driver or its file stated it; read by `optics`
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    verdicts: dict[str, bool] = Field(default_factory=dict[str, bool])  # settings; the view's own include them

    @property
    def optics(self) -> RecordedOptics:
        """Return what the photograph states of its camera, lens and settings."""
        return recorded_optics(self.camera)


class ViewpointCaptured(RecordedView):
    """One complete exposure of a camera carried by a robot: files, pose, settings, environment."""

    kind: Literal["viewpoint_captured"] = "viewpoint_captured"
    T_base_flange: Matrix4  # mean over the exposure
    pose_sigma_m: float  # standard deviation of the position over the exposure
    pose_sigma_rad: float  # 1σ of the rotation vector; early runs recorded that of its length, which is smaller
    joints_rad: tuple[float, ...]
    pose_samples: int
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    controller_time_s: float
    clock_offset_s: float  # controller time minus host monotonic
    further: tuple[FurtherExposure, ...] = ()  # the exposures of the rig's further cameras here
    ringing_s: float = 0.0  # the time for which the arm swung after the commanded motion; a loose mount shows here
    T_flange_tcp: Matrix4 | None = None  # the tool that the controller held; None: it did not report it
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


class JobEnqueued(Record):
    """Work for the registration worker."""

    kind: Literal["job_enqueued"] = "job_enqueued"
    job: str
    job_kind: str
    step: str
    attempt: int
    idempotency_key: str
    arguments: dict[str, Any]
    priority: int = 1  # smaller goes first: see service.core.run.state
    version: int = 1  # of the computation (JobKind.version): 1 copies earlier results, later ones refer to them


class ClusterHost(Record):
    """A machine of a cluster that computed parts of a job."""

    host: str
    processor: str  # model, as its system names it
    tasks: int


class ComputedOn(Record):
    """The processors that computed an answer: another model may give other last bits."""

    processor: str  # model of the worker's machine, as its system names it
    cluster: tuple[ClusterHost, ...] = ()  # () if the worker's machine computed everything


class JobFinished(Record):
    """The worker's result."""

    kind: Literal["job_finished"] = "job_finished"
    job: str
    job_kind: str
    step: str
    attempt: int
    worker: str
    measures: dict[str, float]
    artefacts: tuple[ArtefactRef, ...] = ()
    result: dict[str, Any] = Field(default_factory=dict)
    duration_s: float
    late_s: float | None = None  # after the specimen was freed, or the run's end; None: in time
    computed_on: ComputedOn | None = None  # None in records of earlier versions


class JobFailed(Record):
    """The worker gave up on a job."""

    kind: Literal["job_failed"] = "job_failed"
    job: str
    job_kind: str
    step: str
    attempt: int
    worker: str
    error: str
    message: str
    traceback: str = ""  # only of an unexpected error


OperatorVerb = Literal["confirm", "sign", "redo", "skip", "accept", "pause", "resume", "abort"]
# How the person was identified: by a secret of the account, or only by claim (a site without accounts).
Identified = Literal["", "claimed", "password", "pin", "badge"]


class OperatorAction(Record):
    """A person's action. `automatic` marks a confirmation given by --auto-confirm on a simulated rig."""

    kind: Literal["operator_action"] = "operator_action"
    action: OperatorVerb
    step: str | None = None
    viewpoint: str | None = None  # redo of a single viewpoint
    reason: str = ""
    checklist: tuple[str, ...] = ()  # items ticked
    meaning: str = ""  # the meaning of a signature
    signed_sha256: str = ""  # hash of the event that was signed
    role: str = ""  # the person's role, where the action demands one
    identified: Identified = ""
    via: Literal["cli", "web", "pedal", "auto"] = "cli"
    automatic: bool = False


class ActionRefused(Record):
    """An action that the lifecycle or the protocol did not allow; recorded without effect."""

    kind: Literal["action_refused"] = "action_refused"
    action: OperatorVerb
    step: str | None
    why: str


class ItemTicked(Record):
    """A checklist item was ticked or unticked on a screen; all screens show the same ticks."""

    kind: Literal["item_ticked"] = "item_ticked"
    step: str
    attempt: int
    item: str
    ticked: bool


class RobotSeen(Record):
    """A person has looked at an arm whose connection was lost: it stands still, and nobody is within its reach."""

    kind: Literal["robot_seen"] = "robot_seen"
    device: str  # name in rig.yaml
    lost_seq: int = 0  # the event that reported the loss; 0: the program had ended, which no event had reported


class ControlTaken(Record):
    """One screen took control of the run: from now on only it may act on the run; the others may only watch."""

    kind: Literal["control_taken"] = "control_taken"
    screen: str  # name of the sign-in whose screen it is; "" when control was given back
    previous: str  # person who had control before; "" for nobody
    how: Literal["free", "handed_over", "taken_over"]
    reason: str = ""


class RecordCorrected(Record):
    """A value of an earlier event is corrected. The original stays, and readers see both."""

    kind: Literal["record_corrected"] = "record_corrected"
    of_seq: int
    field: str  # path in the payload: environment.light_lux
    old: Any
    new: Any
    reason: str


class RegionDrawn(Record):
    """A person drew a polygon on the 3D view in which one source of the ground truth counts; used by the next fusion.

    In the frame of the scan, metres; `seen_along` points from the surface to the viewer.
    """

    kind: Literal["region_drawn"] = "region_drawn"
    step: str  # whose next fusion uses it
    source: Literal["ct", "scan"]
    corners_m: tuple[tuple[float, float, float], ...]
    seen_along: tuple[float, float, float]


class RunReleased(Record):
    """A second person's signature that allows the export of a completed run."""

    kind: Literal["run_released"] = "run_released"
    meaning: str
    signed_sha256: str  # the hash of the run_completed event
    identified: Literal["", "claimed", "password"] = ""  # the way of identification; "" in older records


class EvidenceExported(Record):
    """A bundle, a data set or a report left the system."""

    kind: Literal["evidence_exported"] = "evidence_exported"
    what: Literal["bundle", "dataset", "report"]
    file_name: str
    sha256: str
    size_bytes: int
    head_sha256: str  # the chain's hash when it was made
