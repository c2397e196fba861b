"""The pictures of a report: outlines, scene, photographs with their originals, and the notes taken on its steps.

A report should be small enough to send: under 3 MB with 36 photographs and the scene. The originals are named by
their hashes, which are their names in the evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

import cv2

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import (
    Block,
    Column,
    Heading,
    Paragraph,
    Picture,
    Pictures,
    Section,
    Table,
    TableCell,
    utc,
)
from service.audit.report.scene import report_scene
from service.compute.images.photographs import decode_reduced
from service.core.errors import DataError, IntegrityError
from service.core.protocol import Step
from service.core.records.entered import NoteTaken, about_rows
from service.core.records.run_events import FurtherExposure, RecordedView, ViewpointCaptured

THUMBNAIL_PX = 240
LARGE_PX = 720
_QUALITY = 76  # so that a report of 36 photographs stays under 3 MB


def picture(run: RecordedRun, sha256: str, caption: str, width_px: int, *, upright: bool = False) -> Picture:
    """Return a JPEG copy of limited width without the camera's metadata; empty if the file is missing or altered.

    `upright`: rotate by the orientation tag. Images that are measured are never rotated.
    """
    try:
        path = run.files.artefact_path(sha256, verify=True)
    except IntegrityError:
        return Picture(f"{caption}: the file is missing or was altered", None)
    try:
        pixels, _ = decode_reduced(path.read_bytes(), width_px, path.name, upright=upright)
    except DataError:
        return Picture(f"{caption}: the file cannot be read as a picture", None)
    jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Picture(caption, jpeg, pixels.shape[1], pixels.shape[0], sha256)


_WIDTH_PX = 500
_PIECE_CHARACTERS = 900


def about_facts(run: RecordedRun) -> list[tuple[str, TableCell | str]]:
    """Return what was entered when the run began; it is empty for old runs, which did not ask."""
    rows: list[tuple[str, TableCell | str]] = []
    for name, value in about_rows(run.root.about):
        rows += [(name if part == 0 else "", text) for part, text in enumerate(_pieces(value))]
    return rows


def _pieces(text: str) -> list[str]:
    """Return a long text in parts, because a row of a table has to fit on a page."""
    return wrap(text, _PIECE_CHARACTERS, replace_whitespace=False, break_on_hyphens=False) or [""]


def notes_section(run: RecordedRun, *, with_pictures: bool) -> Section | None:
    """Return every note with its step, time and author, and the photographs; None without any."""
    titles = {step.id: step.title for step in run.protocol.steps}
    notes = [(event, event.payload) for event in run.events if isinstance(event.payload, NoteTaken)]
    if not notes:
        return None
    rows: list[tuple[str, ...]] = []
    for event, note in notes:
        head = (str(event.seq), utc(event.at_utc), titles.get(note.step, note.step), run.named(event.actor))
        text = " ".join([note.text, "[photograph]"] if note.photograph is not None else [note.text]).strip()
        rows += [(*(head if part == 0 else ("",) * 4), piece) for part, piece in enumerate(_pieces(text))]
    columns = (
        Column("event", 0.5, "number"),
        Column("time", 1.35),
        Column("step", 1.3),
        Column("who", 1.0),
        Column("note", 3.6),
    )
    blocks: list[Block] = [Table(columns, tuple(rows))]
    pictures = tuple(
        picture(
            run, note.photograph.sha256, f"event {event.seq}: {note.text[:120]}".rstrip(": "), _WIDTH_PX, upright=True
        )
        for event, note in notes
        if note.photograph is not None
    )
    if pictures and with_pictures:
        blocks += [Heading("Photographs of the notes"), Pictures(pictures, 3)]
    return Section("Notes", tuple(blocks))


_ORIGINALS = (
    Column("event", 0.5, "number"),
    Column("view", 0.9),
    Column("original file name", 1.4),
    Column("SHA-256, its name in the evidence", 4.2, "code"),
)


def pictures_section(run: RecordedRun, *, turning: bool) -> Section:
    """Return overlays of the evaluation, the scene, a contact sheet of the valid captures, and the list of originals.

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
    """Return a step's contact sheets, one for each camera, and a row of `_ORIGINALS` for each picture of them."""
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
    """Return the images of each further camera: event, viewpoint, exposure."""
    found: dict[str, list[tuple[int, str, FurtherExposure]]] = {}
    for seq, view in views:
        for one in view.further if isinstance(view, ViewpointCaptured) else ():
            found.setdefault(one.device, []).append((seq, view.viewpoint, one))
    return found


def _caption(capture: RecordedView) -> str:
    failed = [name for name, passed in capture.verdicts.items() if not passed]
    return capture.viewpoint + (f" ✗ {', '.join(failed)}" if failed else "")
