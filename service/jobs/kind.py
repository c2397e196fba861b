"""JobKind: the one declaration of a kind of computation; and the base of the records that it takes and gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from service.core.errors import IntegrityError
from service.core.jobs.references import Jobs, resolve


class JobRecord(BaseModel):
    """Base of arguments and answers: frozen, and what an older or newer version had beside the fields is kept.

    Only fields that were set are written, so that a recorded answer and the same answer computed again are equal.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    def plain(self) -> dict[str, Any]:
        """As it is written into an event."""
        return self.model_dump(mode="json", exclude_unset=True)

    def set_fields(self) -> dict[str, Any]:
        """The fields that were set, as they are: to be added to another record."""
        return {name: getattr(self, name) for name in self.model_fields_set}


class NoAnswer(JobRecord):
    """Of a job that gives measures and files alone."""


_NO_JOBS: Jobs = {}
A = TypeVar("A", bound=JobRecord)
R = TypeVar("R", bound=JobRecord)
_T = TypeVar("_T", bound=JobRecord)


@dataclass(frozen=True, slots=True)
class JobKind(Generic[A, R]):
    """One kind of computation, declared once.

    Attributes:
        name: in the record.
        arguments: what a job is given, with references resolved.
        answer: the plain data that it gives beside measures and files.
        compute: `module:function`, imported at the first such job. The function takes a JobContext[arguments] and
            gives a JobAnswer[answer] (service/worker/job.py).
        words: what people read.
        version: of the arguments' form. 1 holds copies of earlier results, 2 references to them; both are read.
        order: its place among the kinds in lists and texts, as they follow one another in a run.
        replayed: whether a replay computes it unless it is asked for others. What only helps during a capture is not.
        aside: whether it is left out of the provenance drawing, because it leads to no result.
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

    def read_arguments(self, recorded: Mapping[str, Any], jobs: Jobs = _NO_JOBS) -> A:
        """The arguments of a recorded job of any version. Raises IntegrityError."""
        return self._read(self.arguments, resolve(recorded, jobs), "arguments")

    def read_answer(self, recorded: Mapping[str, Any]) -> R:
        """The answer of a recorded job of any version. Raises IntegrityError."""
        return self._read(self.answer, recorded, "answer")

    def _read(self, model: type[_T], data: Mapping[str, Any], what: str) -> _T:
        try:
            return model.model_validate(data)
        except ValidationError as error:
            first = error.errors()[0]
            path = "/".join(map(str, first["loc"]))
            raise IntegrityError(f"the {what} of a job {self.name}: {path}: {first['msg']}") from error
