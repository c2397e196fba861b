"""Records of a run: the event envelope and every event's payload, as frozen pydantic models."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from service.core.records.base import ArtefactRef, Record
from service.core.records.entered import NoteTaken, RunAbout

Matrix4 = tuple[tuple[float, float, float, float], ...]  # T_a_b row-major, metres

# --- operator ------------------------------------------------------------------------------------------

OperatorVerb = Literal["confirm", "sign", "redo", "skip", "accept", "pause", "resume", "abort"]
# How the program knows who acted: a secret of the account was asked, or it is a claim (a site without accounts).
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
    """An action that the lifecycle or the protocol does not allow now; recorded, without effect."""

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
    """How well the host's clock is set; None: not known."""

    source: Literal["chrony", "kernel", ""]
    synchronised: bool | None  # with the network's time
    offset_s: float | None  # host minus network
    error_s: float | None = None  # at most, as the kernel states it


class SessionStarted(Record):
    """The runner's process started (first start or resume): versions again, and the clocks."""

    kind: Literal["session_started"] = "session_started"
    resumed: bool
    software: dict[str, str]
    host: str
    pid: int
    host_clock: HostClock | None = None


class DeviceOpened(Record):
    """A device answered; `report` is its DeviceReport as plain data."""

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
    """Something that a step found out and that the record should hold (station entered, timer started, …)."""

    kind: Literal["step_note"] = "step_note"
    step: str
    attempt: int
    note: str
    data: dict[str, Any] = Field(default_factory=dict)


class FilesKept(Record):
    """Files that arrived from elsewhere (scanner, CT) or were decoded from such, now in the evidence."""

    kind: Literal["files_kept"] = "files_kept"
    step: str
    attempt: int
    device: str
    note: str
    artefacts: tuple[ArtefactRef, ...]


class View(Record):
    """What the record holds of every photograph, however it came to be."""

    step: str
    attempt: int
    viewpoint: str  # name of the view, unique within its step
    station: str  # where a robot stood; "" without one
    artefacts: tuple[ArtefactRef, ...]  # the photograph first
    camera: dict[str, Any]  # EXIF settings, counter, time, lens
    environment: dict[str, float] = Field(default_factory=dict)  # light_lux, temperature_c
    verdicts: dict[str, bool] = Field(default_factory=dict)  # still, settings, sharp …


class ViewpointCaptured(View):
    """One exposure of a camera that a robot carried, complete: files, pose, settings, environment."""

    kind: Literal["viewpoint_captured"] = "viewpoint_captured"
    T_base_flange: Matrix4  # mean over the exposure
    pose_sigma_m: float  # standard deviation of the position over the exposure
    pose_sigma_rad: float  # of the rotation vector; early runs recorded that of its length, which is less
    joints_rad: tuple[float, ...]
    pose_samples: int
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    controller_time_s: float
    clock_offset_s: float  # controller time minus host monotonic
    ringing_s: float = 0.0  # for which the arm swung after the commanded motion: a loose mount shows here


class ViewImported(View):
    """One photograph that was captured earlier. How is not in evidence: only when and by whom it was imported."""

    kind: Literal["view_imported"] = "view_imported"
    imported_by: str
    file_name: str  # within the imported folder
    modified_utc: str  # of the file, as the file system has it


class ViewHeld(View):
    """One exposure of a camera in a person's hands. Where it was the image itself tells, in the worker's answer."""

    kind: Literal["view_held"] = "view_held"
    # By the camera's own button, or by the software for a press on a screen or the pedal; or the image was found as a
    # file: the software was not there, and knows no more than what the file says.
    released_by: Literal["camera", "screen", "pedal", "elsewhere"]
    found_at: str = ""  # path of that file
    arrival_monotonic_s: float


class CaptureAsked(Record):
    """A person at a screen asks the step that works for a release of the shutter, or to end with what it has."""

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
    skipped: bool = False  # given up, goes on with the next (a deviation)


class Uncertainty(Record):
    """How well a measured number is known, in the number's own unit."""

    sigma: float  # standard deviation
    lower: float  # the true number is larger with 99 %
    upper: float  # the true number is smaller with 99 %


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
    """The recovery policy tries the step again without asking (recovering → running)."""

    kind: Literal["step_retried"] = "step_retried"
    step: str
    attempt: int
    why: str


class GateVerdict(Record):
    """One measured number against its limit."""

    measure: str
    value: float | None  # None when the step did not measure it: a fail
    minimum: float | None
    maximum: float | None
    unit: str
    passed: bool
    sigma: float | None = None  # of the value, where it states its uncertainty
    lower: float | None = None
    upper: float | None = None
    undecided: bool = False  # neither bound decides; `passed` is false then


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
    late_s: float | None = None  # after the specimen's release, or the run's end where nothing is released


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
    traceback: str = ""  # of an error that nobody had foreseen


# --- people --------------------------------------------------------------------------------------------------


class ItemTicked(Record):
    """A checklist item marked done, or not done after all, on the screen; every screen shows the same."""

    kind: Literal["item_ticked"] = "item_ticked"
    step: str
    attempt: int
    item: str
    ticked: bool


class ControlTaken(Record):
    """From here on one screen alone may act on the run; the others look on."""

    kind: Literal["control_taken"] = "control_taken"
    screen: str  # name of the sign-in whose screen it is; "" when control was given back
    previous: str  # person who had control before; "" for nobody
    how: Literal["free", "handed_over", "taken_over"]
    reason: str = ""


class RecordCorrected(Record):
    """A value of an earlier event was wrong. The original stays; readers see both."""

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


# --- the site: what happens outside of runs, in a chain of its own -----------------------------------------------


class SiteOpened(Record):
    """Root of the site's chain."""

    kind: Literal["site_opened"] = "site_opened"
    software: dict[str, str]


class ServiceStarted(Record):
    """A web process came up: what changed since the last time, and what is open."""

    kind: Literal["service_started"] = "service_started"
    host: str
    pid: int
    address: str
    software: dict[str, str]
    changed: dict[str, tuple[str, str]]  # distribution or file → before, now ("" for none)
    configuration: dict[str, str]  # rig and protocol files → SHA-256
    boot: str  # boot id, "" where the system has none
    clock_jump_s: float | None  # UTC against monotonic since the last start of this boot; None: cannot be told
    heads: dict[str, tuple[int, str]]  # run → number and hash of its last event, where it grew since the last start
    unsigned_runs: tuple[str, ...]  # with events after their last checkpoint
    open_runs: tuple[str, ...]


class AccountChanged(Record):
    """An account was made or changed; secrets are never in it."""

    kind: Literal["account_changed"] = "account_changed"
    account: str
    field: str  # created, role, state, password, pin, badge, lock_out, link
    old: str
    new: str
    reason: str = ""
    full_name: str = ""  # of an account that is made
    # password_hash, pin_hash, badge_hash, token_sha256 → SHA-256 of it: a secret put in past the software shows.
    stored: dict[str, str] = Field(default_factory=dict)


class SignInRecorded(Record):
    """Somebody signed in or out, or failed to."""

    kind: Literal["sign_in_recorded"] = "sign_in_recorded"
    account: str
    outcome: Literal["signed_in", "refused", "locked_out", "signed_out", "screen_locked", "screen_unlocked", "ended"]
    screen: str = ""
    address: str = ""
    session_sha256: str = ""  # of what is stored of the sign-in: one put in past the software shows


class KeyChanged(Record):
    """The key that signs checkpoints was made, or replaced by another."""

    kind: Literal["key_changed"] = "key_changed"
    key_id: str  # SHA-256 of the raw public key
    public_key: str  # base64 of the 32 raw bytes (RFC 8032)
    previous_key_id: str  # "" for the first
    reason: str


class LeftoversRemoved(Record):
    """Files to which no record refers, left over from crashes, were removed."""

    kind: Literal["leftovers_removed"] = "leftovers_removed"
    files: dict[str, int]  # path within the data folder → bytes


class RunSigned(Record):
    """A run's chain was signed up to an event: written down here as well, at once."""

    kind: Literal["run_signed"] = "run_signed"
    run: str
    seq: int
    sha256: str  # of that event


class TimeStampKept(Record):
    """An authority elsewhere said when a checkpoint existed: one that is taken away is missed."""

    kind: Literal["time_stamp_kept"] = "time_stamp_kept"
    run: str
    seq: int  # of the checkpoint
    authority: str
    at_utc: str  # when it was asked
    token_sha256: str  # of the token's text


class ActionAfterEnd(Record):
    """Somebody wanted something of a run that had ended; without effect, and no part of the run, which is sealed."""

    kind: Literal["action_after_end"] = "action_after_end"
    run: str
    action: OperatorVerb
    step: str | None
    why: str


class ProtocolApproved(Record):
    """A person lets runs be made by a protocol: by these bytes and no others."""

    kind: Literal["protocol_approved"] = "protocol_approved"
    protocol: str  # its id
    version: str
    sha256: str
    source: str  # the file's text: what another content under the same id and version is held against
    instead_of: str = ""  # SHA-256 of such a content, approved before, whose place it takes
    reason: str = ""  # needed for that
    identified: Identified = ""


class DataRestored(Record):
    """This data folder was made from a backup: what was recorded after it, in the folder of then, is not here."""

    kind: Literal["data_restored"] = "data_restored"
    state: str  # name of the backup's state
    at_utc: str  # when the backup was made
    folder: str  # of which it was made
    host: str


# --- end -----------------------------------------------------------------------------------------------------


class RunCompleted(Record):
    """Every step passed or was skipped by the protocol's leave."""

    kind: Literal["run_completed"] = "run_completed"
    deviations: int


class RunAborted(Record):
    """A person, or a step's recovery policy, ended the run; what was captured stays."""

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
    actor: str  # person, or device, or process
    payload: Payload
    previous_sha256: str  # 64 zeros for the root
    sha256: str
