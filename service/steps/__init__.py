"""The kinds of steps: those of service/steps/kinds, and those of plug-ins."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from service.core.errors import ConfigurationError
from service.core.records.events import Record
from service.steps.context import StepKind

GROUP = "orthocapture.steps"  # entry points of plug-ins; each names a StepKind


@cache
def step_kinds() -> dict[str, StepKind[Any]]:
    """All step kinds by name: every module of service/steps/kinds, and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something else than a StepKind.
    """
    package = f"{__name__}.kinds"
    modules = pkgutil.iter_modules(importlib.import_module(package).__path__)
    declared: list[object] = [importlib.import_module(f"{package}.{module.name}").KIND for module in modules]
    declared += [point.load() for point in entry_points(group=GROUP)]
    kinds: dict[str, StepKind[Any]] = {}
    for kind in declared:
        if not isinstance(kind, StepKind):
            raise ConfigurationError(f"{kind!r} is no StepKind", where=f"entry points {GROUP}")
        if kind.name in kinds:
            raise ConfigurationError(f"two step kinds are called {kind.name!r}", where=f"entry points {GROUP}")
        kinds[kind.name] = kind
    return dict(sorted(kinds.items()))


def params_models() -> dict[str, type[Record]]:
    """The Params model of every step kind, for the protocol loader."""
    return {name: kind.params for name, kind in step_kinds().items()}
