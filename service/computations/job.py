"""The interface of the functions that compute jobs: their context and their answer."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.core.errors import IntegrityError
from service.core.records.base import ArtefactRef
from service.core.records.events import Event

A = TypeVar("A")


class ArtefactStore(Protocol):
    """The part of the store that a job needs; in a replay it reads the evidence but writes elsewhere."""

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return the read-only file of an artefact.

        Raises IntegrityError if it is missing or, with `verify`, altered.
        """
        ...

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Store bytes; returns the reference to them."""
        ...

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Store a copy of a file; returns the reference to it."""
        ...


@dataclass(frozen=True, slots=True)
class JobAnswer:
    """Measures, files (already in the store) and the kind's answer."""

    measures: Mapping[str, float]
    artefacts: tuple[ArtefactRef, ...] = ()
    answer: JobRecord = field(default_factory=NoAnswer)

    @property
    def result(self) -> dict[str, Any]:
        """The answer as it is written into the event."""
        return self.answer.plain()


def _no_record(run_id: str) -> Sequence[Event]:
    raise IntegrityError("this job was given no record to read", where=run_id)


@dataclass(frozen=True, slots=True)
class JobContext(Generic[A]):
    """A job's surroundings: its arguments, verified inputs, a scratch folder and the store for its outputs.

    `begin` surrounds the computation: a worker waits there until the machine has what the job demands. `events`
    returns the events of the job's run, for the few kinds that need the whole record.
    """

    arguments: A
    store: ArtefactStore
    scratch: Path
    progress: Callable[[str, int, int], None]
    begin: Callable[[Demand], AbstractContextManager[None]] = lambda _demand: nullcontext()
    events: Callable[[str], Sequence[Event]] = _no_record

    def input(self, sha256: str) -> Path:
        """Return an artefact's file after its hash was verified."""
        return self.store.artefact_path(sha256, verify=True)

    def input_json(self, sha256: str) -> Any:
        """Return an artefact's JSON content."""
        return json.loads(self.input(sha256).read_bytes())

    def keep_json(self, data: Any, *, kind: str, name: str) -> ArtefactRef:
        """Store a JSON artefact."""
        text = json.dumps(data, indent=1, sort_keys=True).encode()
        return self.store.put_bytes(text, kind=kind, media_type="application/json", original_name=name)

    def keep_bytes(self, data: bytes, *, kind: str, media_type: str, name: str) -> ArtefactRef:
        """Store an artefact."""
        return self.store.put_bytes(data, kind=kind, media_type=media_type, original_name=name)

    def keep_file(self, path: Path, *, kind: str, media_type: str) -> ArtefactRef:
        """Store a file of the scratch folder as an artefact of its name; a large one is never in memory."""
        return self.store.put_file(path, kind=kind, media_type=media_type, original_name=path.name)


def finite(measures: Mapping[str, float]) -> dict[str, float]:
    """Return the measures that are numbers: those not measured are NaN or infinite, and left out of an answer."""
    return {name: value for name, value in measures.items() if math.isfinite(value)}


RecordedContext = JobContext[Mapping[str, Any]]  # with arguments as plain data, references resolved
Handler = Callable[[RecordedContext], JobAnswer]


def handler_of(kind: JobKind[Any, Any]) -> Handler:
    """Return the function that computes a kind, from arguments with references resolved.

    Its module is imported at the first such job, so that a worker starts at once.
    """

    def handle(context: RecordedContext) -> JobAnswer:
        module, _, function = kind.compute.partition(":")
        compute: Callable[[JobContext[Any]], JobAnswer] = getattr(importlib.import_module(module), function)
        arguments = kind.read_arguments(context.arguments)
        with context.begin(kind.demand(arguments)):
            return compute(replace(context, arguments=arguments))

    return handle
