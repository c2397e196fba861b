"""What happens in a run: it begins, devices open, steps work and are judged, images and answers arrive, it ends."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.core.records.base import ArtefactRef, Record
from service.core.records.entered import RunAbout
from service.core.records.optics import RecordedOptics, recorded_optics


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
