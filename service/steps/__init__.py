"""Steps: their kinds (in kinds/ and in plug-ins) and the parts that these share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from service.core.loading import KindsOnDemand
from service.core.step_params import StepParams
from service.steps.context import StepKind

GROUP = "orthocapture.steps"  # entry points of plug-ins; each names a StepKind


@cache
def step_kinds() -> Mapping[str, StepKind[Any]]:
    """Return all step kinds by name: those of service/steps/kinds, and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something that is not a StepKind; also
            when they are listed.
    """
    return KindsOnDemand[StepKind[Any]](f"{__name__}.kinds", GROUP, StepKind, lambda kind: kind.name)


class _ParamsModels(Mapping[str, type[StepParams]]):
    def __getitem__(self, name: str) -> type[StepParams]:
        return step_kinds()[name].params

    def __iter__(self) -> Iterator[str]:
        return iter(step_kinds())

    def __len__(self) -> int:
        return len(step_kinds())


def params_models() -> Mapping[str, type[StepParams]]:
    """Return the Params model of every step kind, for the protocol loader; raises what `step_kinds` does."""
    return _ParamsModels()
