"""References: where a job uses part of an earlier job's answer, its arguments name that part and do not copy it.

In the JSON of an event a reference is an object with one key. `{"$from": {"job": "…", "field": "result/camera"}}` is
one part of one answer. `{"$each": {"jobs": ["capture/0/live_view/"], "upto_seq": 81, "field": "artefacts/0/sha256",
"without": []}}` is the same part of the answer of every job whose key begins with one of `jobs` and that had finished
by event `upto_seq`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, cast

from service.core.errors import IntegrityError
from service.core.run.state import JobState, RunState

FROM, EACH = "$from", "$each"
Jobs = Mapping[str, JobState]
_PLAIN = (str, float, int, NoneType)


@dataclass(frozen=True, slots=True)
class Reference:
    """A part of an earlier job's answer.

    Attributes:
        job: id of the job.
        field: keys and indices down to the part, separated by `/`, from `measures`, `artefacts` or `result`; `*`
            stands for every item of a list (`result/details/spheres/*/covariance_m2`).
    """

    job: str
    field: str

    def record(self) -> dict[str, Any]:
        """The reference as it stands in a job's arguments."""
        return {FROM: {"job": self.job, "field": self.field}}


@dataclass(frozen=True, slots=True)
class Each:
    """One part of each of many earlier answers, in the order in which their jobs were enqueued.

    It names the jobs by prefix, so its recorded size does not grow with their number.

    Attributes:
        jobs: prefixes of the jobs' keys (`step/generation/kind/`); the answers follow in the order of these prefixes.
        upto_seq: only jobs that had finished by this event count.
        field: as in `Reference`.
        without: ids of jobs to leave out, such as those of images that were taken again.
    """

    jobs: tuple[str, ...]
    upto_seq: int
    field: str
    without: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """The reference as it stands in a job's arguments."""
        fields = {"jobs": list(self.jobs), "upto_seq": self.upto_seq, "field": self.field}
        return {EACH: {**fields, "without": list(self.without)}}

    def members(self, jobs: Jobs) -> list[JobState]:
        """The jobs that it stands for."""
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
    """Every job of a run that still counts, by id."""
    return {name: job for step in state.steps.values() for name, job in step.jobs.items()}


def read_reference(value: object) -> Reference | Each | None:
    """The reference that a value of recorded arguments is; None for any other value."""
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


def references_in(value: object) -> Iterator[Reference | Each]:
    """Every reference anywhere within recorded arguments."""
    found = read_reference(value)
    if found is not None:
        yield found
    elif isinstance(value, Mapping):
        for item in cast("Mapping[str, Any]", value).values():
            yield from references_in(item)
    elif isinstance(value, list | tuple):
        for item in cast("Sequence[Any]", value):
            yield from references_in(item)


def resolve(value: Any, jobs: Jobs) -> Any:
    """Recorded arguments with every reference replaced by the value it refers to.

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
    """A part of a finished job's answer. Raises IntegrityError where it has none of this name."""
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
