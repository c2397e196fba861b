"""Compares images with those of the calibration: focus, zoom, aperture, lens and body must not have changed."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel

from service.compute.intrinsics.optics import Optics, OpticsDeparture, compare_optics, summary
from service.core.records.events import RecordedView
from service.steps.context import StepContext
from service.steps.notes import DEPARTING


def optics_departures(
    context: StepContext,
    captures: Sequence[RecordedView] | None = None,
    *,
    quiet: bool = False,
    against_itself: bool = False,
) -> tuple[OpticsDeparture, ...] | None:
    """Return how images of this step differ from those of the intrinsic calibration, by viewpoint.

    The reference is the last calibration up to this step that has images; None without one. Departures are noted and
    shown to the operator.

    Args:
        context: the step's surroundings: devices, evidence, clock.
        captures: the images of this step to compare; None: all.
        quiet: true to neither note departures nor show them to the operator.
        against_itself: true to compare the images with one another, because a later step calibrates from them.
    """
    mine = context.evidence.captures(context.step.id) if captures is None else captures
    reference = mine if against_itself else _calibration_images(context)
    if not mine or not reference:
        return None
    departures = compare_optics([_optics(c) for c in reference], [_optics(c) for c in mine]).departures
    if departures and not quiet:
        context.note(
            DEPARTING,
            departures=[str(departure) for departure in departures],
            attempt=context.attempt,
            viewpoints=sorted({departure.image for departure in departures}),
        )
        context.tell(f"the lens is not as it was calibrated: {'; '.join(summary(departures))}")
    return departures


def departing_images(departures: Sequence[OpticsDeparture]) -> int:
    """Return the number of images that differ."""
    return len({departure.image for departure in departures})


class _CalibrationParams(BaseModel):
    """The calibrations that a step solves, and the step whose images it uses if not its own."""

    solve: tuple[str, ...]
    images_of: str | None = None


def _calibration_images(context: StepContext) -> tuple[RecordedView, ...]:
    ids = [step.id for step in context.protocol.steps]
    until = ids.index(context.step.id) + 1
    for step in reversed(context.protocol.steps[:until]):
        if step.gives != "calibration":
            continue
        params = _CalibrationParams.model_validate(step.params.model_dump())
        if "intrinsics" in params.solve:
            images = context.evidence.captures(params.images_of or step.id)
            if images:
                return images
    return ()


def _optics(capture: RecordedView) -> Optics:
    stated = capture.optics
    return Optics(
        image=capture.viewpoint,
        width=stated.width,
        height=stated.height,
        focal_length_mm=stated.focal_length_mm,
        aperture_f=stated.aperture_f,
        focus_distance_m=stated.focus_distance_m,
        focus_mode=stated.focus_mode,
        focus_position=stated.focus_position,
        lens=stated.lens,
        lens_serial=stated.lens_serial,
        body_serial=stated.body_serial,
    )
