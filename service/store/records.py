"""Records that callers pass to the store and get back from it, other than events, and the errors of the store."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from service.core.errors import StoreError
from service.core.records.base import ArtefactRef
from service.core.run.state import WAITED


class UnknownRunError(StoreError):
    """No run, or more than one, matches this name."""


class LeaseHeldError(StoreError):
    """Another process drives this run."""


class LeaseLostError(StoreError):
    """The lease on a run or a job now belongs to another process; nothing was written."""


class StoreVersionError(StoreError):
    """The database was written by another version of the software."""


class RecordDamagedError(StoreError):
    """Database and journal no longer agree: one of them was overwritten, cut, replaced or removed."""


class SigningKeyError(StoreError):
    """The private key that signs checkpoints is missing, unusable or readable by others; the record is unaffected."""


class SignsElsewhereError(SigningKeyError):
    """Another of the data folders that share a site's database signs; the record is unaffected."""


class TimestampError(StoreError):
    """A time-stamp authority cannot be reached or its answer does not verify; the evidence is valid without it."""


SITE = "site"  # name of the chain for events outside runs: sign-ins, accounts, keys, starts


@dataclass(frozen=True, slots=True)
class NewArtefact:
    """A stored file that is about to be recorded, with its origin. One of the payloads must refer to it.

    `who`, `at_utc` and `monotonic_s` default to the actor and the times of the event.
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
    """A recorded artefact: one row of the evidence."""

    run_id: str
    seq: int  # number of the event that brought it
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
    """Work for a worker. A job whose `idempotency_key` the run already has is not enqueued again."""

    kind: str
    step: str
    attempt: int
    idempotency_key: str
    arguments: Mapping[str, Any] = field(default_factory=dict[str, Any])
    try_limit: int = 3
    priority: int = WAITED
    version: int = 1  # version of the arguments' format


# Says by kind whether a machine can compute a job with these arguments; kinds that are not in it, every machine can.
# It is asked within a transaction, and so must not take long.
Able = Mapping[str, Callable[[Mapping[str, Any]], bool]]
EVERY_JOB: Able = {}


@dataclass(frozen=True, slots=True)
class Job:
    """A job as it was when it was read; `token` proves the lease while the job runs."""

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
    """A run in the data folder, with the end of its chain."""

    run_id: str
    created_utc: str
    simulated: bool
    root_sha256: str
    head_seq: int
    head_sha256: str


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A signature over a chain, and over its artefact rows, up to one event."""

    run_id: str
    seq: int  # number of the last event that it covers
    sha256: str  # hash of that event
    artefacts_sha256: str  # hash over the rows' record_sha256
    site_seq: int  # end of the site's chain at the time of signing, which tells the valid key
    site_sha256: str
    at_utc: str
    key_id: str
    signature: str  # base64


@dataclass(frozen=True, slots=True)
class Timestamp:
    """A time-stamp authority's stamp on a checkpoint (RFC 3161)."""

    run_id: str
    seq: int  # number of the checkpoint's event
    authority: str  # its address
    at_utc: str  # time of the request; the authority's own time is in the token
    token: str  # base64 of the DER TimeStampResp
