"""The pictures of a report: detected and predicted outlines, the scene, the photographs, and their originals.

A report should be small enough to send: under 3 MB with 36 photographs and the scene. The originals are named by
their hashes, which are their names in the evidence.
"""

from __future__ import annotations

from collections.abc import Sequence

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Block, Column, Heading, Paragraph, Pictures, Section, Table, TableCell
from service.audit.report.drawings.pictures import LARGE_PX, THUMBNAIL_PX, picture
from service.audit.report.drawings.scene import report_scene
from service.core.protocol.models import Step
from service.core.records.events import FurtherExposure, RecordedView, ViewpointCaptured

_ORIGINALS = (
    Column("event", 0.5, "number"),
    Column("view", 0.9),
    Column("original file name", 1.4),
    Column("SHA-256, its name in the evidence", 4.2, "code"),
)


def pictures_section(run: RecordedRun, *, turning: bool) -> Section:
    """Overlays of the evaluation, the scene, a contact sheet of the valid captures, and the list of originals.

    `turning`: include the scene that can be turned, which only HTML can show.
    """
    blocks: list[Block] = []
    overlays = run.summary().artefacts("overlay")
    if overlays:
        blocks += [
            Heading("Detected and predicted outlines"),
            Paragraph(
                "Green: registration spheres. Blue: control spheres, which took no part in the registration. Yellow, "
                "dashed: predicted by the registration."
            ),
            Pictures(tuple(picture(run, ref.sha256, ref.original_name, LARGE_PX) for ref in overlays), 2),
        ]
    scene = report_scene(run.summary(), turning=turning)
    if scene is not None:
        blocks += [Heading(scene.drawing.title), scene]
    originals: list[tuple[TableCell | str, ...]] = []
    for step in run.protocol.steps:
        sheets, of_step = _contact_sheets(run, step)
        blocks += sheets
        originals += of_step
    if originals:
        text = (
            "The pictures above are small copies. The original photographs are in the folder "
            "artefacts of the evidence, and of a bundle made from it, each under its SHA-256."
        )
        blocks += [Heading("Originals"), Paragraph(text), Table(_ORIGINALS, tuple(originals), small=True)]
    return Section("Pictures", tuple(blocks) or (Paragraph("No photograph was taken."),))


def _contact_sheets(run: RecordedRun, step: Step) -> tuple[list[Block], list[tuple[str, str, str, str]]]:
    """The contact sheets of a step, one for each camera, and a row of `_ORIGINALS` for each of their pictures."""
    blocks: list[Block] = []
    seqs = sorted(run.state.steps[step.id].captured.values())
    captures = [(seq, run.events[seq - 1].payload) for seq in seqs]
    views = [(seq, capture) for seq, capture in captures if isinstance(capture, RecordedView)]
    if views:
        sheet = tuple(picture(run, view.artefacts[0].sha256, _caption(view), THUMBNAIL_PX) for _, view in views)
        blocks += [Heading(f"Contact sheet: {step.title}"), Pictures(sheet, 5)]
    further = _further(views)
    for device, mine in further.items():
        sheet = tuple(picture(run, one.artefacts[0].sha256, caption, THUMBNAIL_PX) for _, caption, one in mine)
        blocks += [Heading(f"Contact sheet: {step.title}, {device}"), Pictures(sheet, 5)]
    shown = [(seq, view.viewpoint, view.artefacts[0]) for seq, view in views]
    shown += [(seq, f"{name}, {one.device}", one.artefacts[0]) for m in further.values() for seq, name, one in m]
    return blocks, [(str(seq), name, ref.original_name, ref.sha256) for seq, name, ref in shown]


def _further(views: Sequence[tuple[int, RecordedView]]) -> dict[str, list[tuple[int, str, FurtherExposure]]]:
    """The images of each further camera: event, viewpoint, exposure."""
    found: dict[str, list[tuple[int, str, FurtherExposure]]] = {}
    for seq, view in views:
        for one in view.further if isinstance(view, ViewpointCaptured) else ():
            found.setdefault(one.device, []).append((seq, view.viewpoint, one))
    return found


def _caption(capture: RecordedView) -> str:
    failed = [name for name, passed in capture.verdicts.items() if not passed]
    return capture.viewpoint + (f" ✗ {', '.join(failed)}" if failed else "")
