"""What a machine has of what jobs need: a worker leaves the jobs that its machine cannot compute to other workers."""

from __future__ import annotations

import importlib
import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from service.computations import job_kinds
from service.computations.kind import JobKind
from service.computations.memory_grants import computes_alone
from service.core.errors import OrthocaptureError
from service.store.durable_effects import Clock
from service.store.records import Able

_log = logging.getLogger(__name__)
_AGAIN_S = 60.0  # after which it is looked again what is installed


class Abilities:
    """Finds out and remembers what this machine has of what jobs need.

    The queue is searched within a transaction, in which nothing may take long: what is not known yet counts there as
    lacking, and is remembered as a question that `look` answers.

    Attributes:
        able: says by kind and arguments which jobs this machine can compute.
        able_now: the same without those that are to be alone on their machine, while it computes such a job.
    """

    def __init__(self, data: Path, clock: Clock) -> None:
        """Take the data folder, in which all workers of this machine say what they compute."""
        self._data, self._clock = data, clock
        self._has: dict[tuple[str, str], tuple[bool, float]] = {}  # and when it was looked
        self._asked: set[tuple[str, str]] = set()
        kinds = {name: kind for name, kind in job_kinds().items() if kind.lacking}
        self.able: Able = {name: partial(self._can, kind) for name, kind in kinds.items()}
        self.able_now: Able = {name: partial(self._can_now, kind) for name, kind in kinds.items()}

    def look(self) -> bool:
        """Find out what was asked since the last look; return whether the machine has some of it."""
        found = False
        for kind, need in sorted(self._asked):
            lacks = self._lacking(kind, need)
            self._has[kind, need] = not lacks, self._clock.monotonic_s()
            found |= not lacks
            if lacks:
                _log.info("jobs %s that need %s are left to other machines: %s", kind, need, lacks)
        self._asked.clear()
        return found

    def _lacking(self, kind: str, need: str) -> str:
        module, _, function = job_kinds()[kind].lacking.partition(":")
        lacking: Callable[[str], str] = getattr(importlib.import_module(module), function)
        try:
            return lacking(need)
        except OrthocaptureError as error:  # such as two plug-ins of one name
            return str(error)

    def _can_now(self, kind: JobKind[Any, Any], arguments: Mapping[str, Any]) -> bool:
        """Say within a transaction whether this machine can begin a job."""
        return self._can(kind, arguments) and not (_is_alone(kind, arguments) and computes_alone(self._data))

    def _can(self, kind: JobKind[Any, Any], arguments: Mapping[str, Any]) -> bool:
        """Say within a transaction whether this machine can compute a job."""
        try:
            need = kind.needs(kind.read_arguments(arguments))
        except OrthocaptureError:
            return True  # whoever takes it records that its arguments cannot be read
        if not need:
            return True
        has, looked_s = self._has.get((kind.name, need), (False, -math.inf))
        if self._clock.monotonic_s() - looked_s <= _AGAIN_S:
            return has
        self._asked.add((kind.name, need))
        return False


def _is_alone(kind: JobKind[Any, Any], arguments: Mapping[str, Any]) -> bool:
    try:
        return kind.demand(kind.read_arguments(arguments)).alone
    except OrthocaptureError:
        return False
