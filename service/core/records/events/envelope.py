"""The envelope of every event, and the union of all payloads."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, TypeAdapter

from service.core.records.base import Record
from service.core.records.entered import NoteTaken
from service.core.records.events.operator import (
    ActionRefused,
    ControlTaken,
    EvidenceExported,
    ItemTicked,
    OperatorAction,
    RecordCorrected,
    RegionDrawn,
    RobotSeen,
    RunReleased,
)
from service.core.records.events.run import (
    CaptureAsked,
    DeviceOpened,
    DeviceTrouble,
    FilesKept,
    GatesEvaluated,
    JobEnqueued,
    JobFailed,
    JobFinished,
    LeaveLapsed,
    RunAborted,
    RunCompleted,
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
from service.core.records.events.site import (
    AccountChanged,
    ActionAfterEnd,
    DataRestored,
    KeyChanged,
    LeftoversRemoved,
    ProtocolApproved,
    RecordCopied,
    RecordRebuilt,
    RunMoved,
    RunReceived,
    RunSigned,
    ServiceStarted,
    SignaturesWrittenAgain,
    SignerNamed,
    SignInRecorded,
    SiteOpened,
    TimeStampKept,
)

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
