"""Records of a run: the event envelope and every event's payload, as frozen pydantic models."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from service.core.records.base import ArtefactRef, Record
from service.core.records.entered import NoteTaken, RunAbout

Matrix4 = tuple[tuple[float, float, float, float], ...]  # T_a_b row-major, metres

# --- operator ------------------------------------------------------------------------------------------

OperatorVerb = Literal["confirm", "sign", "redo", "skip", "accept", "pause", "resume", "abort"]
# How the person was identified: by a secret of the account, or only by claim (a site without accounts).
Identified = Literal["", "claimed", "password", "pin", "badge"]


class OperatorAction(Record):
    """What a person did. `automatic` marks a confirmation given by --auto-confirm on a simulated rig."""

    kind: Literal["operator_action"] = "operator_action"
    action: OperatorVerb
    step: str | None = None
    viewpoint: str | None = None  # redo of a single viewpoint
    reason: str = ""
    checklist: tuple[str, ...] = ()  # items ticked
    meaning: str = ""  # of a signature
    signed_sha256: str = ""  # hash of the event that was signed
    role: str = ""  # of the person, where the action demands one
    identified: Identified = ""
    via: Literal["cli", "web", "pedal", "auto"] = "cli"
    automatic: bool = False


class ActionRefused(Record):
    """An action that the lifecycle or the protocol did not allow; recorded without effect."""

    kind: Literal["action_refused"] = "action_refused"
    action: OperatorVerb
    step: str | None
    why: str


# --- run -------------------------------------------------------------------------------------------------


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
    """How well the host's clock is set; None stands for not known."""

    source: Literal["chrony", "kernel", ""]
    synchronised: bool | None  # with the network's time
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


# --- steps -----------------------------------------------------------------------------------------------


class StepStarted(Record):
    """The work of a step begins (ready → running)."""

    kind: Literal["step_started"] = "step_started"
    step: str
    attempt: int


class StepNote(Record):
    """Something a step found out that belongs in the record (station entered, timer started, …)."""

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


class View(Record):
    """What the record holds for every photograph, whether taken by robot, by hand or imported."""

    step: str
    attempt: int
    viewpoint: str  # name of the view, unique within its step
    station: str  # of the robot; "" without one
    artefacts: tuple[ArtefactRef, ...]  # the photograph first
    camera: dict[str, Any]  # EXIF settings, counter, time, lens
    environment: dict[str, float] = Field(default_factory=dict)  # light_lux, temperature_c
    verdicts: dict[str, bool] = Field(default_factory=dict)  # still, settings, sharp …


class ViewpointCaptured(View):
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
    ringing_s: float = 0.0  # how long the arm swung after the commanded motion; a loose mount shows here


class ViewImported(View):
    """One photograph that was captured earlier. The record proves only when and by whom it was imported."""

    kind: Literal["view_imported"] = "view_imported"
    imported_by: str
    file_name: str  # within the imported folder
    modified_utc: str  # modification time in the file system


class ViewHeld(View):
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


class Uncertainty(Record):
    """How well a measured number is known, in the number's own unit."""

    sigma: float  # standard deviation
    lower: float  # the true value is above this with 99 % confidence (one-sided)
    upper: float  # the true value is below this with 99 % confidence (one-sided)


class StepMeasured(Record):
    """The work of a step is done: its numbers, before any gate (running → checking)."""

    kind: Literal["step_measured"] = "step_measured"
    step: str
    attempt: int
    measures: dict[str, float]
    artefacts: tuple[ArtefactRef, ...] = ()
    result: dict[str, Any] = Field(default_factory=dict)  # the step kind's Result as plain data
    uncertainties: dict[str, Uncertainty] = Field(default_factory=dict)  # of those measures that state one


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
    sigma: float | None = None  # of the value, where it states its uncertainty
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


# --- jobs ---------------------------------------------------------------------------------------------------


class JobEnqueued(Record):
    """Work for the registration worker."""

    kind: Literal["job_enqueued"] = "job_enqueued"
    job: str
    job_kind: str
    step: str
    attempt: int
    idempotency_key: str
    arguments: dict[str, Any]
    priority: int = 1  # smaller goes first: see service.core.jobs.priorities
    version: int = 1  # of the arguments: 1 has copies of earlier results, 2 references to them


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
    late_s: float | None = None  # after the specimen's release, or the run's end; None: in time


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


# --- people --------------------------------------------------------------------------------------------------


class ItemTicked(Record):
    """A checklist item was ticked or unticked on a screen; all screens show the same ticks."""

    kind: Literal["item_ticked"] = "item_ticked"
    step: str
    attempt: int
    item: str
    ticked: bool


class ControlTaken(Record):
    """From now on only one screen may act on the run; the others may only watch."""

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


class RunReleased(Record):
    """A second person's signature that allows the export of a completed run."""

    kind: Literal["run_released"] = "run_released"
    meaning: str
    signed_sha256: str  # of the run_completed event


class EvidenceExported(Record):
    """A bundle, a data set or a report left the system."""

    kind: Literal["evidence_exported"] = "evidence_exported"
    what: Literal["bundle", "dataset", "report"]
    file_name: str
    sha256: str
    size_bytes: int
    head_sha256: str  # of the chain when it was made


# --- the site: events outside runs, in a chain of their own -------------------------------------------------------


class SiteOpened(Record):
    """Root of the site's chain."""

    kind: Literal["site_opened"] = "site_opened"
    software: dict[str, str]


class ServiceStarted(Record):
    """A web process started: what has changed since the last start, and which runs are open."""

    kind: Literal["service_started"] = "service_started"
    host: str
    pid: int
    address: str
    software: dict[str, str]
    changed: dict[str, tuple[str, str]]  # distribution or file → before, now ("" for none)
    configuration: dict[str, str]  # rig and protocol files → SHA-256
    boot: str  # boot id, "" where the system has none
    clock_jump_s: float | None  # UTC against monotonic since the last start of this boot; None: not known
    heads: dict[str, tuple[int, str]]  # run → number and hash of its last event, where it grew since the last start
    unsigned_runs: tuple[str, ...]  # with events after their last checkpoint
    open_runs: tuple[str, ...]


class AccountChanged(Record):
    """An account was made or changed; the event never holds a secret."""

    kind: Literal["account_changed"] = "account_changed"
    account: str
    field: str  # created, role, state, password, pin, badge, lock_out, link
    old: str
    new: str
    reason: str = ""
    full_name: str = ""  # of a new account
    # password_hash, pin_hash, badge_hash, token_sha256 → its SHA-256, which shows a secret not set by the software.
    stored: dict[str, str] = Field(default_factory=dict)


class SignInRecorded(Record):
    """Somebody signed in or out, or failed to."""

    kind: Literal["sign_in_recorded"] = "sign_in_recorded"
    account: str
    outcome: Literal["signed_in", "refused", "locked_out", "signed_out", "screen_locked", "screen_unlocked", "ended"]
    screen: str = ""
    address: str = ""
    session_sha256: str = ""  # of the stored session, which shows one not made by the software


class KeyChanged(Record):
    """The key that signs checkpoints was made or replaced."""

    kind: Literal["key_changed"] = "key_changed"
    key_id: str  # SHA-256 of the raw public key
    public_key: str  # base64 of the 32 raw bytes (RFC 8032)
    previous_key_id: str  # "" for the first
    reason: str


class LeftoversRemoved(Record):
    """Files left over from crashes, to which no record refers, were removed."""

    kind: Literal["leftovers_removed"] = "leftovers_removed"
    files: dict[str, int]  # path within the data folder → bytes


class RunSigned(Record):
    """A run's chain was signed up to an event; recorded in the same transaction in the site's chain."""

    kind: Literal["run_signed"] = "run_signed"
    run: str
    seq: int
    sha256: str  # of that event


class TimeStampKept(Record):
    """A time-stamp authority stamped a checkpoint; this event shows if the stamp is removed later."""

    kind: Literal["time_stamp_kept"] = "time_stamp_kept"
    run: str
    seq: int  # of the checkpoint
    authority: str
    at_utc: str  # when it was asked
    token_sha256: str  # of the token's text


class ActionAfterEnd(Record):
    """An action on a run that had ended. It has no effect and is not in the run's own chain, which is sealed."""

    kind: Literal["action_after_end"] = "action_after_end"
    run: str
    action: OperatorVerb
    step: str | None
    why: str


class ProtocolApproved(Record):
    """A person approved a protocol for runs: exactly these bytes."""

    kind: Literal["protocol_approved"] = "protocol_approved"
    protocol: str  # its id
    version: str
    sha256: str
    source: str  # the file's text, to compare with other content of the same id and version
    instead_of: str = ""  # SHA-256 of the content approved before under this id and version, which it replaces
    reason: str = ""  # required for a replacement
    identified: Identified = ""


class DataRestored(Record):
    """This data folder was restored from a backup; what was recorded after the backup is not in it."""

    kind: Literal["data_restored"] = "data_restored"
    state: str  # name of the backup's state
    at_utc: str  # when the backup was made
    folder: str  # the data folder that was backed up
    host: str


# --- end -----------------------------------------------------------------------------------------------------


class RunCompleted(Record):
    """Every step passed or was skipped."""

    kind: Literal["run_completed"] = "run_completed"
    deviations: int


class RunAborted(Record):
    """A person or a step's recovery policy ended the run early; what was captured stays."""

    kind: Literal["run_aborted"] = "run_aborted"
    reason: str


Payload = Annotated[
    OperatorAction
    | ActionRefused
    | RunStarted
    | SessionStarted
    | DeviceOpened
    | DeviceTrouble
    | StepStarted
    | StepNote
    | FilesKept
    | ViewpointCaptured
    | ViewImported
    | ViewHeld
    | CaptureAsked
    | ViewpointFailed
    | StepMeasured
    | StepFailed
    | StepRetried
    | GatesEvaluated
    | StepPassed
    | JobEnqueued
    | JobFinished
    | JobFailed
    | RunCompleted
    | RunAborted
    | ItemTicked
    | NoteTaken
    | ControlTaken
    | RecordCorrected
    | RunReleased
    | EvidenceExported
    | SiteOpened
    | ServiceStarted
    | AccountChanged
    | SignInRecorded
    | KeyChanged
    | RunSigned
    | TimeStampKept
    | LeftoversRemoved
    | ActionAfterEnd
    | ProtocolApproved
    | DataRestored,
    Field(discriminator="kind"),
]
PAYLOAD: TypeAdapter[Payload] = TypeAdapter(Payload)


class Event(Record):
    """One link of a run's chain.

    `sha256` is SHA-256 over the RFC 8785 canonical JSON of every other field, `previous_sha256` included.
    """

    seq: int  # 1, 2, 3 … within the run
    run_id: str
    at_utc: str  # ISO 8601 with microseconds and Z
    monotonic_s: float
    actor: str  # person, device or process
    payload: Payload
    previous_sha256: str  # 64 zeros for the root
    sha256: str
