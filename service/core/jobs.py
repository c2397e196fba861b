"""Jobs of a run: their keys, references to parts of their answers, and which of them computed a step.

In the JSON of an event a reference is an object with one key. `{"$from": {"job": "…", "field": "result/camera"}}` is
one part of one answer. `{"$each": {"jobs": ["capture/0/live_view/"], "upto_seq": 81, "field": "artefacts/0/sha256",
"without": []}}` is the same part of the answer of every job whose key begins with one of `jobs` and that had finished
by event `upto_seq`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, cast

from service.core.errors import IntegrityError
from service.core.records.run_events import ComputedBy
from service.core.run.state import JobState, RunState, StepState


def arguments_name(arguments: Mapping[str, Any]) -> str:
    """Return a hash of the arguments, 16 hexadecimal digits: equal arguments have the same name."""
    return hashlib.sha256(json.dumps(arguments, sort_keys=True).encode()).hexdigest()[:16]


def key_stem(state: RunState, step: str, kind: str) -> str:
    """Return the common prefix of the keys of all jobs of this kind that were enqueued since the step's last redo."""
    generation = sum(past.step == step and past.viewpoint is None for past in state.superseded)
    return f"{step}/{generation}/{kind}/"


def job_key(state: RunState, step: str, kind: str, name: str) -> str:
    """Return the key under which a job would be enqueued now.

    A redo of the step begins a new generation of keys; a failed job is tried again under a new key.
    """
    stem = f"{key_stem(state, step, kind)}{name}/"
    jobs = state.steps[step].jobs.values()
    return stem + str(sum(job.idempotency_key.startswith(stem) and job.status == "failed" for job in jobs))


def newest_job(state: RunState, step: str, kind: str, name: str) -> JobState | None:
    """Return the last job for this work enqueued since the step's last redo, or None."""
    stem = f"{key_stem(state, step, kind)}{name}/"
    jobs = [job for job in state.steps[step].jobs.values() if job.idempotency_key.startswith(stem)]
    return max(jobs, key=lambda job: job.enqueued_seq, default=None)


FROM, EACH = "$from", "$each"
Jobs = Mapping[str, JobState]
_PLAIN = (str, float, int, NoneType)


@dataclass(frozen=True, slots=True)
class Reference:
    """A part of an earlier job's answer.

    Attributes:
        job: the job's id.
        field: keys and indices down to the part, separated by `/`, from `measures`, `artefacts` or `result`; `*`
            stands for every item of a list (`result/details/spheres/*/covariance_m2`).
    """

    job: str
    field: str

    def record(self) -> dict[str, Any]:
        """Return the reference as it stands in a job's arguments."""
        return {FROM: {"job": self.job, "field": self.field}}


@dataclass(frozen=True, slots=True)
class Each:
    """One part of each of many earlier answers, in the order in which their jobs were enqueued.

    It names the jobs by prefix, so its recorded size does not grow with their number.

    Attributes:
        jobs: prefixes of the jobs' keys (`step/generation/kind/`); the answers follow in the order of these prefixes.
        upto_seq: the event by which jobs must have finished to count.
        field: the field of each answer, as in `Reference`.
        without: the ids of jobs to leave out, such as those of images that were taken again.
    """

    jobs: tuple[str, ...]
    upto_seq: int
    field: str
    without: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """Return the reference as it stands in a job's arguments."""
        fields = {"jobs": list(self.jobs), "upto_seq": self.upto_seq, "field": self.field}
        return {EACH: {**fields, "without": list(self.without)}}

    def members(self, jobs: Jobs) -> list[JobState]:
        """Return the jobs that it stands for."""
        without = frozenset(self.without)
        chosen = [
            job
            for job in jobs.values()
            if job.idempotency_key.startswith(self.jobs)
            and job.status == "finished"
            and job.ended_seq <= self.upto_seq
            and job.job not in without
        ]
        chosen.sort(key=lambda job: job.enqueued_seq)
        return [job for key in self.jobs for job in chosen if job.idempotency_key.startswith(key)]


def jobs_of(state: RunState) -> dict[str, JobState]:
    """Return every job of a run that still counts, by id."""
    return {name: job for step in state.steps.values() for name, job in step.jobs.items()}


def read_reference(value: object) -> Reference | Each | None:
    """Return the reference that a value of recorded arguments is; None for any other value."""
    # `dict` first: the test for a Mapping takes five times as long, and a record holds thousands of values.
    if not isinstance(value, dict | Mapping) or len(cast("Mapping[str, Any]", value)) != 1:
        return None
    (key, fields), *_ = cast("Mapping[str, Any]", value).items()
    if key == FROM:
        return Reference(str(fields["job"]), str(fields["field"]))
    if key == EACH:
        return Each(
            tuple(fields["jobs"]), int(fields["upto_seq"]), str(fields["field"]), tuple(fields.get("without", ()))
        )
    return None


def references_in(value: object, at: str = "") -> Iterator[tuple[str, Reference | Each]]:
    """Yield every reference anywhere within recorded arguments, after its field (`further_arms/0/arm_correction`)."""
    found = read_reference(value)
    if found is not None:
        yield at, found
        return
    items: Iterable[tuple[object, Any]] = ()
    if isinstance(value, Mapping):
        items = cast("Mapping[str, Any]", value).items()
    elif isinstance(value, list | tuple):
        items = enumerate(cast("Sequence[Any]", value))
    for name, item in items:
        if isinstance(item, Mapping | list | tuple):
            yield from references_in(item, f"{at}/{name}" if at else str(name))


def resolve(value: Any, jobs: Jobs) -> Any:
    """Return recorded arguments with every reference replaced by the value it refers to.

    Raises:
        IntegrityError: a job is not among `jobs`, has not finished, or its answer has no such part.
    """
    if isinstance(value, _PLAIN):
        return value
    found = read_reference(value)
    if isinstance(found, Reference):
        job = jobs.get(found.job)
        if job is None or job.status != "finished":
            raise IntegrityError(f"the arguments of a job refer to job {found.job}, which has no answer that counts")
        return part_of(job, found.field)
    if isinstance(found, Each):
        return [part_of(job, found.field) for job in found.members(jobs)]
    if isinstance(value, dict | Mapping):
        return {key: resolve(item, jobs) for key, item in cast("Mapping[str, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [resolve(item, jobs) for item in cast("Sequence[Any]", value)]
    return value


def part_of(job: JobState, field: str) -> Any:
    """Return a part of a finished job's answer. Raises IntegrityError where it has none of this name."""
    answer = {
        "measures": job.measures,
        "result": job.result,
        "artefacts": [ref.model_dump(mode="json") for ref in job.artefacts],
    }
    try:
        return _walk(answer, field.split("/"))
    except (LookupError, TypeError, ValueError) as error:
        raise IntegrityError(
            f"the arguments of a job refer to {field} of {job.kind}, which its answer does not have", where=job.job
        ) from error


def _walk(value: Any, path: Sequence[str]) -> Any:
    for position, key in enumerate(path):
        if key == "*":
            return [_walk(item, path[position + 1 :]) for item in value]
        value = value[int(key)] if isinstance(value, list | tuple) else value[key]
    return value


def computed_by(state: StepState) -> tuple[ComputedBy, ...]:
    """Return the jobs whose figures a step reported as its own, as its event names them.

    Events of older versions do not name them; there, a job is recognised by the values that it shares with the step.
    """
    return tuple(_by_values(state)) if state.computed_by is None else state.computed_by


def answered_by(state: StepState) -> JobState | None:
    """Return the newest job whose answer is part of the step's result; None if no job computed it."""
    found = [state.jobs[source.job] for source in computed_by(state) if source.job in state.jobs]
    for job in sorted(found, key=lambda job: job.enqueued_seq, reverse=True):
        if job.result and job.result.keys() <= state.result.keys():
            return job
    return None


def _by_values(state: StepState) -> Iterator[ComputedBy]:
    for job in state.jobs.values():
        if job.status != "finished":
            continue
        if job.result and all(state.result.get(name) == value for name, value in job.result.items()):
            yield ComputedBy(job=job.job)
        elif (prefix := _prefix(state, job)) is not None:
            yield ComputedBy(job=job.job, prefix=prefix)


def _prefix(state: StepState, job: JobState) -> str | None:
    """Return what precedes the job's names of measures in the step's; None if these are not the job's measures."""
    first = next(iter(job.measures), None)
    if first is None:
        return None
    for name in state.measures:
        prefix = name.removesuffix(first)
        if name.endswith(first) and all(
            state.measures.get(prefix + own) == job.measures[own] for own in job.measures
        ):
            return prefix
    return None
