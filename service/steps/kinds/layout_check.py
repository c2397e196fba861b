"""Step kind `layout_check`: checks in hand-held photographs whether the layout of the spheres is too symmetric."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from drivers.errors import ReleasedElsewhereError
from service.computations import layout
from service.computations.records import Point
from service.core.gates import evaluate_gates
from service.core.records.base import ArtefactRef, Record
from service.core.records.run_events import GateVerdict
from service.core.step_params import NeededDevice, RepeatedStep, StepParams
from service.core.units import metres
from service.steps.arrivals import keep, layout_uncertainties
from service.steps.context import Announcement, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.exposure import wanted_settings
from service.steps.held_camera import awaited_images
from service.steps.measures import Count, LayoutMeasures
from service.steps.views import photograph

PHOTOGRAPH = "layout_photograph"
PHOTOGRAPH_WANTED = "layout_photograph_wanted"
MOVE_WANTED = "layout_move_wanted"
# Where to hold the camera for each photograph; the edges are those of the first photograph.
_SIDES: tuple[tuple[str, str], ...] = (
    ("above", "nearly above the scene"),
    ("left", "on the side of the left edge of the first photograph, about 30° lower than it was"),
    ("right", "on the side of the right edge of the first photograph, about 30° lower than at first"),
    ("near", "on the side of the lower edge of the first photograph, about 30° lower than at first"),
    ("far", "on the side of the upper edge of the first photograph, about 30° lower than at first"),
)


class Params(StepParams):
    """The number of photographs, and the way they are taken."""

    gives: ClassVar = "rough_spheres"
    repeated: ClassVar = RepeatedStep("Move the spheres as it says, then take another photograph")

    photographs: int = 1  # the photographs in the first attempt; the camera is moved in between
    most_photographs: int = 5  # most of one layout, while the measures are not certain enough for a decision
    between_s: float = 5.0  # time for moving the camera
    wait_s: Annotated[float, Field(gt=0)] = 600.0  # longest wait for a photograph that arrives as a file
    sensor_width_mm: float = 35.7  # gives nominal intrinsics, with the focal length in the file

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A camera."""
        return (NeededDevice("camera"),)


class Measures(LayoutMeasures):
    """The measures of the layout, and of the photographs that show it."""

    spheres_seen: Annotated[Count, "spheres found in the photographs"] = None
    photographs_used: Annotated[Count, "photographs that the layout was judged from"] = None


class Result(Record):
    """The spheres in the frame of the photograph that shows most of them, metres."""

    spheres_m: tuple[Point, ...]
    details: layout.LayoutDetails


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Take photographs, locate the spheres in all of this layout, and search for near-symmetries; nothing moves.

    The first attempt takes `photographs`, each further one takes one more. After a sphere was moved, it starts over.
    """
    images = _earlier(context)
    kept: list[ArtefactRef] = []
    needed = max(len(images) + 1, params.photographs)
    while len(images) < needed:
        context.checkpoint()
        context.progress("photographs of the spheres", len(images), needed)
        if kept:
            context.wait(params.between_s)
        kept += _photographs(context, images, params.wait_s)
    spheres = context.protocol.spheres
    arguments = layout.Arguments(
        images=tuple(images),
        sensor_width_mm=params.sensor_width_mm,
        radius_m=metres(spheres.radius_mm),
        expected=spheres.registration + spheres.control,
        control=spheres.control,
    )
    (answer,) = context.evidence.run_jobs(JobRequest.of(layout.KIND, arguments))
    result = Result.model_validate(answer.result)
    uncertainties = layout_uncertainties(result.details)
    judged = evaluate_gates(
        context.step, context.attempt, answer.measures, context.run.skipped, uncertainties
    ).verdicts
    _advise(context, judged, result.details, len(images), params)
    measures = Measures.read(answer.measures)
    return StepOutcome(measures, (*kept, *answer.artefacts), result, uncertainties, (answer.source,))


def _earlier(context: StepContext) -> list[layout.LayoutPhotograph]:
    """Return the photographs of the present layout: those taken since a sphere was last moved."""
    images: list[layout.LayoutPhotograph] = []
    for note in context.state.notes:
        if note.note == MOVE_WANTED:
            images = []
        elif note.note == PHOTOGRAPH:
            images.append(layout.LayoutPhotograph(sha256=note.data["sha256"], focal_mm=note.data["focal_mm"]))
    return images


def _photographs(context: StepContext, images: list[layout.LayoutPhotograph], wait_s: float) -> list[ArtefactRef]:
    """Take one, or wait for those of a camera without a cable; store, note and add them to `images`."""
    camera = context.devices.camera()
    refs: list[ArtefactRef] = []
    with tempfile.TemporaryDirectory(prefix="orthocapture-") as name:
        folder = Path(name)
        try:
            taken = (photograph(context, camera, wanted_settings(context), folder),)
        except ReleasedElsewhereError:
            taken = awaited_images(context, camera, folder, wait_s)
        for image in taken:
            media_type = image.jpeg.media_type
            ref = keep(context, image.jpeg.path, device="camera", kind="layout_image", media_type=media_type)
            found = {"found_at": image.found_at} if image.found_at else {}
            context.note(PHOTOGRAPH, sha256=ref.sha256, focal_mm=image.focal_length_mm, **found)
            images.append(layout.LayoutPhotograph(sha256=ref.sha256, focal_mm=image.focal_length_mm))
            refs.append(ref)
    return refs


def _advise(
    context: StepContext,
    verdicts: Sequence[GateVerdict],
    details: layout.LayoutDetails,
    images: int,
    params: Params,
) -> None:
    """If the layout fails its gates, advise one more photograph while that may decide, or a move."""
    short = [verdict for verdict in verdicts if not verdict.passed]
    if not short:
        return
    unseen = any(verdict.measure == "spheres_seen" for verdict in short)
    bad = [v for v in short if not v.undecided and v.measure != "spheres_seen"]
    if not bad and images < params.most_photographs:
        _ask_for_photograph(context, images, unseen=unseen)
        return
    if not details.moves:
        remedy = "; ".join(details.problems) or "the photographs do not decide it"
        advice = f"{remedy[0].upper()}{remedy[1:]}. Set the spheres up less regularly and photograph them again"
        context.note(MOVE_WANTED, advice=advice)
    else:
        steps = "; then ".join(move.words for move in details.moves)
        advice = (
            f"{steps}. The picture of this step shows the spheres with their numbers, and arrows. Then hold the "
            "camera nearly above the scene again and confirm"
        )
        hands = [_move_hand(move) for move in details.moves]
        context.note(MOVE_WANTED, advice=advice, hands=[*hands, {"action": "hold_camera", "side": "above"}])
    context.tell(advice)


def _ask_for_photograph(context: StepContext, taken: int, *, unseen: bool) -> None:
    side, where = _SIDES[taken % len(_SIDES)]
    why = "Not every sphere is seen so far" if unseen else "The photographs do not decide it yet"
    advice = (
        f"Hold the camera {where}, so that it shows all spheres, and confirm. {why}; what was photographed before is "
        "kept"
    )
    context.note(
        PHOTOGRAPH_WANTED,
        advice=advice,
        title="One more photograph",
        does=f"Take photograph {taken + 1}",
        hands=[{"action": "hold_camera", "side": side}],
    )
    context.tell(advice)


def _move_hand(move: layout.SphereMove) -> dict[str, object]:
    """Return an action that shows the simulated technician where in the photograph the sphere is."""
    return {
        "action": "move_sphere",
        "from": list(move.old_place),
        "to": list(move.new_place),
        "higher_m": metres(move.higher_mm),
    }


KIND = StepKind(
    "layout_check",
    Params,
    Measures,
    Result,
    execute,
    words=lambda params, _before: Announcement(
        f"the camera takes {params.photographs} {'photograph' if params.photographs == 1 else 'photographs'}"
    ),
    drawing="layout_photo",
)
