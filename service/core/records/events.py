"""Every event: the events of the site's own chain, the union of all payloads, and the envelope."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from service.core.records.base import ArtefactRef, Record
from service.core.records.entered import NoteTaken
from service.core.records.run_events import (
    ActionRefused,
    CaptureAsked,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
    EvidenceExported,
    FilesKept,
    GatesEvaluated,
    Identified,
    ItemTicked,
    JobEnqueued,
    JobFailed,
    JobFinished,
    LeaveLapsed,
    OperatorAction,
    OperatorVerb,
    RecordCorrected,
    RegionDrawn,
    RobotSeen,
    RunAborted,
    RunCompleted,
    RunReleased,
    RunStarted,
    SessionStarted,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
    ViewHeld,
    ViewImported,
    ViewpointCaptured,
    ViewpointFailed,
)


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
    unsigned_runs: tuple[str, ...]  # the runs with events after their last checkpoint
    open_runs: tuple[str, ...]


class AccountChanged(Record):
    """An account was made or changed; the event never holds a secret."""

    kind: Literal["account_changed"] = "account_changed"
    account: str
    field: str  # created, role, state, password, pin, badge, lock_out, link
    old: str
    new: str
    reason: str = ""
    full_name: str = ""  # the full name of a new account's holder
    # password_hash, pin_hash, badge_hash, token_sha256 → its SHA-256, which shows a secret not set by the software.
    stored: dict[str, str] = Field(default_factory=dict)


class SignInRecorded(Record):
    """Somebody signed in or out, or failed to."""

    kind: Literal["sign_in_recorded"] = "sign_in_recorded"
    account: str
    outcome: Literal["signed_in", "refused", "locked_out", "signed_out", "screen_locked", "screen_unlocked", "ended"]
    screen: str = ""
    address: str = ""
    session_sha256: str = ""  # the hash of the stored session, which shows one not made by the software


class KeyChanged(Record):
    """The key that signs checkpoints was made or replaced."""

    kind: Literal["key_changed"] = "key_changed"
    key_id: str  # SHA-256 of the raw public key
    public_key: str  # base64 of the 32 raw bytes (RFC 8032)
    previous_key_id: str  # "" for the first
    reason: str


class SignerNamed(Record):
    """The data folder that signs from here on, where several folders share the database of a site."""

    kind: Literal["signer_named"] = "signer_named"
    signer: str  # the folder's random name, in its file `signer`
    key_id: str  # the key in use
    host: str
    folder: str


class LeftoversRemoved(Record):
    """Files left over from crashes, to which no record refers, were removed."""

    kind: Literal["leftovers_removed"] = "leftovers_removed"
    files: dict[str, int]  # path within the data folder → bytes


class RunSigned(Record):
    """A run's chain was signed up to an event; recorded in the same transaction in the site's chain."""

    kind: Literal["run_signed"] = "run_signed"
    run: str
    seq: int
    sha256: str  # the hash of that event


class SignaturesWrittenAgain(Record):
    """Signatures had no line in the log of signatures beside the database; their lines are written again."""

    kind: Literal["signatures_written_again"] = "signatures_written_again"
    lines: int
    runs: tuple[str, ...]  # whose signatures these were, or the site's
    since_utc: str  # time of the first of them
    explained: bool  # true if one interrupted signature, as by a power failure, explains it


class TimeStampKept(Record):
    """A time-stamp authority stamped a checkpoint; this event shows if the stamp is removed later."""

    kind: Literal["time_stamp_kept"] = "time_stamp_kept"
    run: str
    seq: int  # the checkpoint's event
    authority: str
    at_utc: str  # the time of the request
    token_sha256: str  # the hash of the token's text


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
    at_utc: str  # the time of the backup
    folder: str  # the data folder that was backed up
    host: str


class RecordCopied(Record):
    """This record was copied from another database or folder; it goes on here, and no longer there."""

    kind: Literal["record_copied"] = "record_copied"
    source: str  # the data folder it was copied from
    database: str  # the database it was copied into, without its password
    runs: int  # runs, without the site's own chain
    events: int  # events of all chains
    files: int
    heads_sha256: str  # of the canonical JSON of {chain: SHA-256 of its last event}, the same in both


class RunMoved(Record):
    """A run goes on in another record; nothing is appended to its chain here until it comes back."""

    kind: Literal["run_moved"] = "run_moved"
    moved_run: str
    seq: int  # the last event of its chain
    sha256: str
    target: str  # the data folder it was moved to
    database: str  # the database of that folder, without its password


class RunReceived(Record):
    """A run came from another record, where nothing is appended to its chain any more; it goes on here."""

    kind: Literal["run_received"] = "run_received"
    moved_run: str
    seq: int  # the last event of its chain, the same in both
    sha256: str
    source: str  # the data folder it came from
    database: str  # the database of that folder, without its password
    events: int  # events that were new here
    files: int  # files that they and earlier events refer to
    signatures: ArtefactRef  # a JSON file of its signatures and time stamps there, and of what they rest on


class RecordRebuilt(Record):
    """Database or journal was overwritten, cut or lost, and was made again from the other; the old files remain."""

    kind: Literal["record_rebuilt"] = "record_rebuilt"
    made: Literal["database", "journal"]  # the part that was made again
    why: str  # the damage that was found
    events: int  # the number of events in all chains, when this was done
    restored_events: int  # the number of these that the old database did not hold any more
    kept: tuple[str, ...]  # files of the data folder that hold what was there before
    lost: tuple[str, ...] = ()  # descriptions of what could not be restored; () if nothing is known to be lost


Payload = Annotated[
    OperatorAction
    | ActionRefused
    | RunStarted
    | SessionStarted
    | DeviceOpened
    | DeviceTrouble
    | LeaveLapsed
    | StepStarted
    | StepNote
    | FilesKept
    | ViewpointCaptured
    | ViewImported
    | ViewHeld
    | CaptureAsked
    | RegionDrawn
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
    | RobotSeen
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
    | SignaturesWrittenAgain
    | TimeStampKept
    | LeftoversRemoved
    | ActionAfterEnd
    | ProtocolApproved
    | DataRestored
    | RecordRebuilt
    | RecordCopied
    | RunMoved
    | RunReceived
    | SignerNamed,
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
