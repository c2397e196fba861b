"""Events of a step, from its start to the verdict of its gates."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.core.records.base import ArtefactRef, Record


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


class Uncertainty(Record):
    """How well a measured number is known, in the number's own unit."""

    sigma: float  # standard deviation
    lower: float  # the true value is above this with 99 % confidence (one-sided)
    upper: float  # the true value is below this with 99 % confidence (one-sided)


class ComputedBy(Record):
    """A job whose measures, and whose answer, a step gave as its own."""

    job: str
    prefix: str = ""  # what the step put before the names of the job's measures: `colmap_`


class StepMeasured(Record):
    """The work of a step is done: its numbers, before any gate (running → checking)."""

    kind: Literal["step_measured"] = "step_measured"
    step: str
    attempt: int
    measures: dict[str, float]
    artefacts: tuple[ArtefactRef, ...] = ()
    result: dict[str, Any] = Field(default_factory=dict)  # the step kind's Result as plain data
    uncertainties: dict[str, Uncertainty] = Field(default_factory=dict)  # of those measures that state one
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
