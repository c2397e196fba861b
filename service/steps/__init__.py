"""Steps: their kinds (in kinds/ and in plug-ins) and the parts that these share."""

from __future__ import annotations

from functools import cache
from typing import Any

from service.core.declared_kinds import declared_kinds
from service.core.loading import loading
from service.core.protocol.step_params import StepParams
from service.steps.context import StepKind

GROUP = "orthocapture.steps"  # entry points of plug-ins; each names a StepKind


@cache
def step_kinds() -> dict[str, StepKind[Any]]:
    """All step kinds by name: every module of service/steps/kinds, and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something that is not a StepKind.
    """
    with loading():
        kinds: dict[str, StepKind[Any]] = declared_kinds(f"{__name__}.kinds", GROUP, StepKind)
    return dict(sorted(kinds.items()))


def params_models() -> dict[str, type[StepParams]]:
    """The Params model of every step kind, for the protocol loader."""
    return {name: kind.params for name, kind in step_kinds().items()}
