"""JobKind, the declaration of a kind of computation, and the base class of its arguments and answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from service.core.errors import IntegrityError
from service.core.jobs import Jobs, resolve


class JobRecord(BaseModel):
    """Base of arguments and answers: frozen; fields of older or newer versions stay.

    Only fields that were set are written, so that a recorded answer and its recomputation are equal.
    """

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)

    def plain(self) -> dict[str, Any]:
        """Return the record as it is written into an event."""
        return self.model_dump(mode="json", exclude_unset=True)

    def set_fields(self) -> dict[str, Any]:
        """Return the fields that were set, unconverted, for use in another record."""
        return {name: getattr(self, name) for name in self.model_fields_set}


class NoAnswer(JobRecord):
    """The answer of a job that yields only measures and files."""


@dataclass(frozen=True, slots=True)
class Demand:
    """The memory and the time that a job takes from the machine that computes it.

    Attributes:
        memory_mb: the most that it and the processes that it starts need together.
        limit_s: the time after which it is ended: many times what it takes on a slow machine.
        alone: true if no other such job is computed beside it on its machine, because its seconds are a result.
    """

    memory_mb: float
    limit_s: float
    alone: bool = False


def usual_demand(_arguments: JobRecord) -> Demand:
    """Return the demand of a kind that declares none, such as one of a plug-in."""
    return Demand(memory_mb=1000, limit_s=7200)


def _nothing(_record: JobRecord) -> str:
    return ""


_NO_JOBS: Jobs = {}
_FIRST_NUMBERS = 2  # versions up to this one differ in their arguments alone
A = TypeVar("A", bound=JobRecord)
R = TypeVar("R", bound=JobRecord)
_T = TypeVar("_T", bound=JobRecord)


@dataclass(frozen=True, slots=True)
class JobKind(Generic[A, R]):
    """One kind of computation, declared once.

    Attributes:
        name: the kind's name, as it is recorded.
        arguments: the type of a job's arguments, with references resolved.
        answer: the type of the plain data that it yields in addition to measures and files.
        compute: `module:function`, imported at the first such job. The function takes a JobContext[arguments] and
            returns a JobAnswer (service/computations/job.py).
        words: its label, for people.
        version: the computation's version. In version 1 the arguments hold copies of earlier results, since then
            references to them; all are read. From version 3 on, each gives other numbers than the one before.
        order: its position among the kinds in lists and texts, as a run uses them.
        replayed: true if a replay recomputes it by default; not for kinds that only help during a capture.
        aside: true if the provenance drawing omits it, because no result depends on it.
        demand: returns what a job with these arguments takes: measured for surfaces
            (bench/results/job_memory-*.json), estimated for images.
        needs: names what a machine must have to compute a job with these arguments, such as a program.
        lacking: `module:function`, imported when such a job waits in the queue. The function takes a name that
            `needs` gives, and says what of it is missing on this machine, where the job is then left to others; ""
            if nothing is. "" instead of a function: every machine can compute this kind.
        circumstances: the fields of the answer that say how it was computed, not what: a replay compares the others.
        unrepeatable: says why a replay has nothing to compare a recorded answer with; "" if it has.
    """

    name: str
    arguments: type[A]
    answer: type[R]
    compute: str
    words: str
    version: int = 2
    order: int = 100
    replayed: bool = True
    aside: bool = False
    demand: Callable[[A], Demand] = usual_demand
    needs: Callable[[A], str] = _nothing
    lacking: str = ""
    circumstances: tuple[str, ...] = ()
    unrepeatable: Callable[[R], str] = _nothing

    def other_numbers(self, recorded_version: int) -> str:
        """Say that another version computed a recorded job, with other numbers or fewer; "" if this one did."""
        if max(recorded_version, _FIRST_NUMBERS) == max(self.version, _FIRST_NUMBERS):
            return ""
        return (
            f"computed by version {recorded_version} of the {self.words}; this program has version {self.version}, "
            "whose numbers differ or are more"
        )

    def not_compared(self, recorded: Mapping[str, Any]) -> str:
        """Say why a replay has nothing to compare this recorded answer with; "" if it has. Raises IntegrityError."""
        return "" if self.unrepeatable is _nothing else self.unrepeatable(self.read_answer(recorded))

    def read_arguments(self, recorded: Mapping[str, Any], jobs: Jobs = _NO_JOBS) -> A:
        """Return the arguments of a recorded job of any version. Raises IntegrityError."""
        return _read(self.arguments, resolve(recorded, jobs), f"the arguments of a job {self.name}")

    def read_answer(self, recorded: Mapping[str, Any]) -> R:
        """Return the answer of a recorded job of any version. Raises IntegrityError."""
        return _read(self.answer, recorded, f"the answer of a job {self.name}")


def read_part(part: type[_T], recorded: Mapping[str, Any], jobs: Jobs = _NO_JOBS) -> _T:
    """Return some fields of a job's recorded arguments; references in its other fields are not resolved.

    Args:
        part: a record with only these fields.
        recorded: arguments of a job of any kind that has them, and of any version.
        jobs: the run's jobs, for references.

    Raises:
        IntegrityError: the arguments do not have these fields, or a reference has no value.
    """
    fields = {name: resolve(recorded[name], jobs) for name in part.model_fields if name in recorded}
    return _read(part, fields, "the arguments of a job")


def _read(model: type[_T], data: Mapping[str, Any], what: str) -> _T:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        path = "/".join(map(str, first["loc"]))
        remedy = (
            "Verify the record with `orthocapture audit verify`; it should hold what this version or an earlier wrote"
        )
        raise IntegrityError(f"{what}: {path}: {first['msg']}", where=path or what, remedy=remedy) from error
