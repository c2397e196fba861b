"""Blurred and black images: a single one is taken again at once; after several in a row, the capture stops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from service.core.errors import ImagesSpoiltError
from service.core.run.state import JobState
from service.jobs.looks import image_of
from service.steps.context import StepContext
from service.steps.notes import SPOILT, images_to_repeat

CLEAN: list[dict[str, str]] = [{"action": "clean_lens"}]  # for the simulated technician
IN_A_ROW = 3  # consecutive spoilt images: beyond chance, so they have a common cause
_MOST_STOPS = 2  # of one step; after that, only the gates judge the images
_FACTOR = 1.6  # of the edge width in the sharpest image of the step
_WIDEST_PX, _WIDEST_SHARE = 7.0, 0.002  # the largest limit on an edge width, in px and as a share of the image width
_MOST_NAMES = 6


@dataclass(frozen=True, slots=True)
class ImageSharpness:
    """The sharpness of one image, as a job measured it.

    Attributes:
        viewpoint: its name.
        sha256: of the photograph.
        edge_px: width of its clearest edges; None if it has none.
        black: whether it is black.
        width: of the image, px.
    """

    viewpoint: str
    sha256: str
    edge_px: float | None
    black: bool
    width: int

    @classmethod
    def of(cls, job: JobState, *, black: bool, width: int) -> ImageSharpness:
        """From a finished job on one image, with what its answer says of the image."""
        image = image_of(job)
        return cls(image.viewpoint, image.sha256, job.measures.get("image_edge_px"), black, width)


def why_spoilt(images: Sequence[ImageSharpness], others: Sequence[ImageSharpness] = ()) -> dict[str, str]:
    """The reason of each spoilt image by its SHA-256.

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
    """The spoilt images at the end of a sequence, in the order of capture; empty if there are fewer than IN_A_ROW."""
    row: list[ImageSharpness] = []
    for image in reversed(images):
        if image.sha256 not in reasons:
            break
        row.insert(0, image)
    return row if len(row) >= IN_A_ROW else []


def spoilt_before(context: StepContext) -> set[str]:
    """SHA-256 of images that were spoilt in an earlier attempt and have not been taken again yet."""
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
    """The spoilt images in a row with which a step's images end, where they are to stop it; else none.

    Args:
        images: of the step, in the order of capture.
        others: of earlier steps, to compare with.
    """
    if not may_stop(context):
        return []
    due = spoilt_before(context)
    return last_in_a_row([image for image in images if image.sha256 not in due], why_spoilt(images, others))


def may_stop(context: StepContext) -> bool:
    """Whether spoilt images may still stop the step: not again and again, for then a person has seen them."""
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
