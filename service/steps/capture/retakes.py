"""Images that make a gate fail: a retry takes only those again and keeps the others."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from service.core.gates.verdict import describe, evaluate_gates
from service.core.records.events import RecordedView
from service.steps.capture.spoilt import CLEAN, spoilt_before
from service.steps.context import StepContext
from service.steps.notes import DEPARTING, images_to_repeat

#: Measure of how images were taken → what a person should do before images are taken again.
TAKEN_AGAIN: Mapping[str, str] = {
    "viewpoints_captured": "find out why the arm could not reach the missing viewpoints",
    "settings_departures": "set the camera as the protocol has it",
    "moved_during_exposure": "find out what shook the arm or its mount",
    "images_spoilt": "clean the lens, and check that nothing blocks its view or the light",
    "images_unexamined": "see why the analysis of images does not go on (is a worker running?)",
    "optics_departures": "set zoom, focus and lens as they were for the calibration, or redo the calibration",
}


def to_take_again(context: StepContext) -> set[str]:
    """SHA-256 of images that departed from the calibration's optics, or were spoilt, in an earlier attempt."""
    captures = context.evidence.captures(context.step.id)
    notes = images_to_repeat(context.state, DEPARTING)
    attempts = [(note.attempt, set(note.viewpoints)) for note in notes if note.attempt is not None]
    if not attempts or attempts[-1][0] >= context.attempt:
        return spoilt_before(context)
    attempt, departed = attempts[-1]
    departing = {c.artefacts[0].sha256 for c in captures if c.viewpoint in departed and c.attempt <= attempt}
    return departing | spoilt_before(context)


def taken_for_good(captures: Iterable[RecordedView], again: Collection[str]) -> set[str]:
    """The viewpoints that need no image any more: their newest is as required, and not one of `again` (SHA-256).

    All others are reached by a motion, so they belong to the plan.
    """
    newest = {capture.viewpoint: capture for capture in captures}
    return {
        name
        for name, capture in newest.items()
        if all(capture.verdicts.values()) and capture.artefacts[0].sha256 not in again
    }


def advise_retakes(context: StepContext, measures: Mapping[str, float], images: int) -> str:
    """If a gate on how images were taken fails, note which images a retry takes again.

    Args:
        context: of the step.
        measures: of the capture.
        images: how many will be taken again.

    Returns:
        the advice; "" if none is needed.
    """
    verdicts = evaluate_gates(context.step, context.attempt, measures, context.run.skipped).verdicts
    failed = [verdict for verdict in verdicts if not verdict.passed and verdict.measure in TAKEN_AGAIN]
    if not failed:
        return ""
    short = "; ".join(describe(verdict) for verdict in failed)
    words = "; ".join(TAKEN_AGAIN[verdict.measure] for verdict in failed)
    confirm = "No image has to be taken again: confirm to judge the step again"
    if images:
        confirm = f"Confirm to take {images} image{'s'[: images > 1]} again; all others are kept"
    advice = f"{short}. First {words}. {confirm}"
    hands = CLEAN if any(verdict.measure == "images_spoilt" for verdict in failed) else []
    context.note("retakes", advice=advice, images=images, hands=hands)
    context.tell(advice)
    return advice
