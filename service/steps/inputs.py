"""What earlier steps left behind, as plain job arguments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from service.core.errors import ConfigurationError
from service.core.model import ArtefactRef
from service.steps.context import StepContext


def result_of(context: StepContext, step_id: str) -> Mapping[str, Any]:
    """The Result of an earlier step, as plain data; ConfigurationError if it has none."""
    state = context.run.steps.get(step_id)
    if state is None or not state.result:
        raise ConfigurationError(
            f"step {context.step.id!r} needs the result of step {step_id!r}, which has none",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return state.result


def artefact_of(context: StepContext, step_id: str, kind: str) -> ArtefactRef:
    """The newest artefact of one kind that an earlier step produced."""
    state = context.run.steps.get(step_id)
    found = [ref for ref in (state.artefacts if state else ()) if ref.kind == kind]
    if not found:
        raise ConfigurationError(
            f"step {context.step.id!r} needs a {kind} of step {step_id!r}, which has none",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return found[-1]


def captured_images(context: StepContext, step_ids: Iterable[str]) -> list[dict[str, Any]]:
    """Every valid photograph of the given capture steps with its pose, in order of capture.

    Events recorded since this step began (its own images) are read through the evidence, not the stale state.
    """
    images: list[dict[str, Any]] = []
    for step_id in step_ids:
        for capture in context.evidence.captures(step_id):
            if not all(capture.verdicts.values()):
                continue
            photograph = capture.artefacts[0]
            images.append(
                {
                    "name": f"{capture.viewpoint}.jpg",
                    "step": step_id,
                    "viewpoint": capture.viewpoint,
                    "station": capture.station,
                    "sha256": photograph.sha256,
                    "T_base_flange": [list(row) for row in capture.T_base_flange],
                }
            )
    if not images:
        raise ConfigurationError(f"no usable image from {', '.join(step_ids)}", where=f"step {context.step.id}")
    return images
