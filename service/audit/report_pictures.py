"""Pictures of a report: small copies of what the evidence holds, each file verified by its hash first, and the scene.

A report is sent by post: 36 photographs, the scene and all else are to stay under 3 MB. The photographs themselves
are named by their hashes, under which they lie in the evidence.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from service.audit.recorded import RecordedRun
from service.audit.report_blocks import Block, Cell, Column, Heading, Paragraph, Picture, Pictures, Section, Table
from service.audit.report_scene import report_scene
from service.core.errors import IntegrityError
from service.core.model import View

THUMBNAIL_PX = 240
LARGE_PX = 720
_QUALITY = 76


def pictures_section(run: RecordedRun, *, turning: bool) -> Section:
    """Overlays of the evaluation, the scene, then a contact sheet of every capture that counts, and the originals.

    `turning`: the scene can be turned, which only HTML can show.
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
            Pictures(tuple(_picture(run, ref.sha256, ref.original_name, LARGE_PX) for ref in overlays), 2),
        ]
    scene = report_scene(run.summary(), turning=turning)
    if scene is not None:
        blocks += [Heading(scene.drawing.title), scene]
    originals: list[tuple[Cell | str, ...]] = []
    for step in run.protocol.steps:
        seqs = sorted(run.state.steps[step.id].captured.values())
        captures = [(seq, run.events[seq - 1].payload) for seq in seqs]
        views = [(seq, capture) for seq, capture in captures if isinstance(capture, View)]
        if views:
            sheet = tuple(_picture(run, view.artefacts[0].sha256, _caption(view), THUMBNAIL_PX) for _, view in views)
            blocks += [Heading(f"Contact sheet: {step.title}"), Pictures(sheet, 5)]
        originals += [
            (str(seq), view.viewpoint, view.artefacts[0].original_name, view.artefacts[0].sha256)
            for seq, view in views
        ]
    if originals:
        columns = (
            Column("event", 0.5, "number"),
            Column("view", 0.9),
            Column("file as it came", 1.4),
            Column("SHA-256, its name in the evidence", 4.2, "code"),
        )
        text = (
            "What is shown above are small copies. The photographs as they came from the camera lie in the folder "
            "artefacts of the evidence, and of a bundle made from it, each under its SHA-256."
        )
        blocks += [Heading("Originals"), Paragraph(text), Table(columns, tuple(originals), small=True)]
    return Section("Pictures", tuple(blocks) or (Paragraph("No photograph was taken."),))


def _caption(capture: View) -> str:
    failed = [name for name, passed in capture.verdicts.items() if not passed]
    return capture.viewpoint + (f" ✗ {', '.join(failed)}" if failed else "")


def _picture(run: RecordedRun, sha256: str, caption: str, width_px: int) -> Picture:
    """A JPEG copy no wider than this, without the camera's own data; empty where the file is missing or altered."""
    try:
        path = run.files.artefact_path(sha256, verify=True)
    except IntegrityError:
        return Picture(f"{caption}: the file is missing or was altered", None)
    pixels = _read(path, width_px)
    if pixels is None:
        return Picture(f"{caption}: the file cannot be read as a picture", None)
    height, width = pixels.shape[:2]
    if width > width_px:
        size = (width_px, round(height * width_px / width))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Picture(caption, jpeg, pixels.shape[1], pixels.shape[0], sha256)


def _read(path: Path, width_px: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None:
    """Thumbnails are decoded at a quarter where the photograph is large enough: 60 MP take long otherwise."""
    if width_px <= THUMBNAIL_PX:
        small = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_4 | cv2.IMREAD_IGNORE_ORIENTATION)
        if small is not None and small.shape[1] >= width_px:
            return np.asarray(small, dtype=np.uint8)
    found = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if found is None else np.asarray(found, dtype=np.uint8)
