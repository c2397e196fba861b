"""Finds images that are spoilt or depart from the calibration, and decides which are taken again."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from pydantic import BaseModel

from service.computations.records import image_of
from service.compute.photography import Optics, OpticsDeparture, compare_optics, summary
from service.core.errors import ImagesSpoiltError
from service.core.gates import describe, evaluate_gates
from service.core.records.run_events import RecordedView
from service.core.run.state import JobState
from service.steps.context import StepContext
from service.steps.notes import DEPARTING, SPOILT, images_to_repeat

# --- focus, zoom, aperture, lens and body as in the calibration ----------------------------------------------------


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


# --- spoilt images -------------------------------------------------------------------------------------------------


CLEAN: list[dict[str, str]] = [{"action": "clean_lens"}]  # for the simulated technician
IN_A_ROW = 3  # consecutive spoilt images: beyond chance, so they have a common cause
_MOST_STOPS = 2  # the most stops of one step; after that, only the gates judge the images
_FACTOR = 1.6  # the factor of the edge width in the sharpest image of the step
_WIDEST_PX, _WIDEST_SHARE = 7.0, 0.002  # the largest limit on an edge width, in px and as a share of the image width
_MOST_NAMES = 6


@dataclass(frozen=True, slots=True)
class ImageSharpness:
    """The sharpness of one image, as a job measured it.

    Attributes:
        viewpoint: the viewpoint's name.
        sha256: the photograph's SHA-256.
        edge_px: the width of its clearest edges; None if it has none.
        black: true if it is black.
        width: the image's width, px.
    """

    viewpoint: str
    sha256: str
    edge_px: float | None
    black: bool
    width: int

    @classmethod
    def of(cls, job: JobState, *, black: bool, width: int) -> ImageSharpness:
        """Read the sharpness from a finished job on one image; its answer gives `black` and `width`."""
        image = image_of(job)
        return cls(image.viewpoint, image.sha256, job.measures.get("image_edge_px"), black, width)


def why_spoilt(images: Sequence[ImageSharpness], others: Sequence[ImageSharpness] = ()) -> dict[str, str]:
    """Return the reason of each spoilt image by its SHA-256.

    Args:
        images: all images of one step.
        others: images of earlier steps that show the same scene, to compare the sharpness with.
    """
    edges = [image.edge_px for image in (*images, *others) if image.edge_px is not None]
    sharpest_px = min(edges, default=0.0)
    reasons: dict[str, str] = {}
    for image in images:
        limit_px = min(_FACTOR * sharpest_px, max(_WIDEST_PX, _WIDEST_SHARE * image.width))
        if image.black:
            reasons[image.sha256] = "the image is black"
        elif image.edge_px is not None and image.edge_px > limit_px:
            reasons[image.sha256] = f"blurred, its edges are {image.edge_px:.1f} px wide (limit {limit_px:.1f})"
    return reasons


def last_in_a_row(images: Sequence[ImageSharpness], reasons: Mapping[str, str]) -> list[ImageSharpness]:
    """Return the spoilt images at the end of a sequence, in the order of capture; none if fewer than IN_A_ROW."""
    row: list[ImageSharpness] = []
    for image in reversed(images):
        if image.sha256 not in reasons:
            break
        row.insert(0, image)
    return row if len(row) >= IN_A_ROW else []


def spoilt_before(context: StepContext) -> set[str]:
    """Return the SHA-256 of images that were spoilt in an earlier attempt and have not been taken again yet."""
    captures = context.evidence.captures(context.step.id)
    return {
        capture.artefacts[0].sha256
        for note in images_to_repeat(context.state, SPOILT)
        if note.attempt is not None and note.attempt < context.attempt
        for capture in captures
        if capture.viewpoint in note.viewpoints and capture.attempt <= note.attempt
    }


def row_to_stop_for(
    context: StepContext, images: Sequence[ImageSharpness], others: Sequence[ImageSharpness]
) -> list[ImageSharpness]:
    """Return the spoilt images in a row with which a step's images end, if they are to stop it; else none.

    Args:
        images: the step's images, in the order of capture.
        others: the images of earlier steps, to compare with.
    """
    if not may_stop(context):
        return []
    due = spoilt_before(context)
    return last_in_a_row([image for image in images if image.sha256 not in due], why_spoilt(images, others))


def may_stop(context: StepContext) -> bool:
    """Return whether spoilt images may still stop the step: not again and again, for then a person has seen them."""
    return sum(note.advice is not None for note in images_to_repeat(context.state, SPOILT)) < _MOST_STOPS


def stop_for_lens(context: StepContext, row: Sequence[ImageSharpness]) -> None:
    """Stop the capture: note what a person should do, and which images are taken again afterwards.

    Raises:
        ImagesSpoiltError: always, with the same advice.
    """
    names = [image.viewpoint for image in row]
    shown = ", ".join(names) if len(names) <= _MOST_NAMES else f"{names[0]} … {names[-1]}"
    dark = all(image.black for image in row)
    what = f"the last {len(row)} images are {'black' if dark else 'blurred'}: {shown}"
    first = "Check that the lens cap is off and the light is on" if dark else "Clean the lens"
    advice = f"{first}, then confirm: these {len(row)} images are taken again, all others are kept"
    context.note(SPOILT, advice=advice, hands=[] if dark else CLEAN, viewpoints=names, attempt=context.attempt)
    raise ImagesSpoiltError(what, where=f"step {context.step.id}", remedy=advice)


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
    """Return the SHA-256 of images that an earlier attempt spoilt, or took with other optics than the calibration."""
    captures = context.evidence.captures(context.step.id)
    notes = images_to_repeat(context.state, DEPARTING)
    attempts = [(note.attempt, set(note.viewpoints)) for note in notes if note.attempt is not None]
    if not attempts or attempts[-1][0] >= context.attempt:
        return spoilt_before(context)
    attempt, departed = attempts[-1]
    departing = {c.artefacts[0].sha256 for c in captures if c.viewpoint in departed and c.attempt <= attempt}
    return departing | spoilt_before(context)


def taken_for_good(captures: Iterable[RecordedView], again: Collection[str]) -> set[str]:
    """Return the viewpoints that need no image any more: the newest is as required and not one of `again` (SHA-256).

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
        context: the step's surroundings: devices, evidence, clock.
        measures: the capture's measures.
        images: the number of images that will be taken again.

    Returns:
        The advice; "" if none is needed.
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
