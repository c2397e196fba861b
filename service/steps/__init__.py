"""One file a step kind: its Params, its Result, its execute(). A module with a KIND is a step kind."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any

from service.core.records.events import Record
from service.steps.context import StepKind


@cache
def step_kinds() -> dict[str, StepKind[Any]]:
    """All step kinds by name: every module of this package that defines KIND."""
    modules = (importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__))
    kinds: list[StepKind[Any]] = [m.KIND for m in modules if hasattr(m, "KIND")]
    return {kind.name: kind for kind in sorted(kinds, key=lambda k: k.name)}


def params_models() -> dict[str, type[Record]]:
    """The Params model of every step kind, for the protocol loader."""
    return {name: kind.params for name, kind in step_kinds().items()}
