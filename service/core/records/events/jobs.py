"""Events of jobs for the worker."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.core.records.base import ArtefactRef, Record


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
    version: int = 1  # of the computation (JobKind.version): 1 copies earlier results, later ones refer to them


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
