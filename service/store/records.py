"""What callers hand to the store and get back from it, beside events: artefacts and jobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from service.core.jobs.priorities import WAITED
from service.core.records.events import ArtefactRef

SITE = "site"  # name of the chain that holds what happens outside of runs: sign-ins, accounts, keys, starts


@dataclass(frozen=True, slots=True)
class NewArtefact:
    """A stored file about to be recorded, and where it comes from. One of the payloads must refer to it.

    `who` is the actor of the event and the times are those of the event unless given.
    """

    ref: ArtefactRef
    device: str  # name in rig.yaml, or the process that computed it
    step: str | None = None
    attempt: int | None = None
    viewpoint: str | None = None
    who: str | None = None
    at_utc: str | None = None
    monotonic_s: float | None = None


@dataclass(frozen=True, slots=True)
class Artefact:
    """A recorded artefact: one row, as it stands in the evidence."""

    run_id: str
    seq: int  # of the event that brought it
    position: int
    ref: ArtefactRef
    device: str
    step: str | None
    attempt: int | None
    viewpoint: str | None
    who: str
    at_utc: str
    monotonic_s: float
    record_sha256: str


@dataclass(frozen=True, slots=True)
class NewJob:
    """Work for a worker. Enqueueing an `idempotency_key` that the run already has does nothing."""

    kind: str
    step: str
    attempt: int
    idempotency_key: str
    arguments: Mapping[str, Any] = field(default_factory=dict[str, Any])
    try_limit: int = 3
    priority: int = WAITED


@dataclass(frozen=True, slots=True)
class Job:
    """A job as it stood when it was read; `token` is the proof of the lease while it runs."""

    job_id: str
    run_id: str
    kind: str
    step: str
    attempt: int
    idempotency_key: str
    arguments: Mapping[str, Any]
    state: str  # queued, running, finished, failed
    tries: int
    try_limit: int
    worker: str | None
    token: str | None
    until_utc_s: float | None
    started_utc: str | None
    ended_utc: str | None
    ended_seq: int | None
    error: str | None
    priority: int


@dataclass(frozen=True, slots=True)
class RunRow:
    """A run of the data folder."""

    run_id: str
    created_utc: str
    simulated: bool
    root_sha256: str
    head_seq: int
    head_sha256: str


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A signature over a chain up to one event, and over the artefact rows up to there."""

    run_id: str
    seq: int  # of the last event that it covers
    sha256: str  # of that event
    artefacts_sha256: str  # over the rows' record_sha256
    site_seq: int  # where the site's chain was when it was signed; it says which key was valid
    site_sha256: str
    at_utc: str
    key_id: str
    signature: str  # base64


@dataclass(frozen=True, slots=True)
class Timestamp:
    """What a time-stamp authority says of a checkpoint (RFC 3161)."""

    run_id: str
    seq: int  # of the checkpoint
    authority: str  # address
    at_utc: str  # when it was asked; the authority's own time is in the token
    token: str  # base64 of the DER TimeStampResp
