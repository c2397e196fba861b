"""A report as PDF on A4, for printing and filing.

Typeset by Typst, which tags every part and checks PDF/UA-1, so that screen readers can read it.
"""

from __future__ import annotations

import itertools
import json
import re
import tempfile
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import typst

from service.audit.report.blocks import (
    Block,
    DescriptionList,
    Drawing,
    Drawings,
    Heading,
    Paragraph,
    Picture,
    Pictures,
    Report,
    SceneBlock,
    Table,
    TableCell,
)
from service.audit.report.output.svg import drawing_svg
from service.audit.report.words import moment

# DejaVu has every character that a report writes. If it is not installed, Typst's own fonts are used.
_FONT_FOLDERS = (
    "/usr/share/fonts/truetype/dejavu",
    "/usr/share/fonts/dejavu",
    "/usr/share/fonts/dejavu-sans-fonts",
    "/usr/share/fonts/TTF",
    "/usr/local/share/fonts",
)
_FONT_FILE = "DejaVuSans.ttf"
# Then also with the fonts of the machine, and at last without the standard.
_TRIES: tuple[tuple[bool, Literal["ua-1"] | None], ...] = ((False, "ua-1"), (True, "ua-1"), (True, None))
_LONG_WORD = re.compile(r"\S{24,}")
_MEETING = re.compile(r"(?<=[_/.:,-])(?=[^_/.:,-]{2})")
_WIDE = 0.45  # of the page; in a narrower column a hash needs two lines


def write_pdf(report: Report, path: Path) -> None:
    """Write the file; its folder is made if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(render_pdf(report))


def render_pdf(report: Report) -> bytes:
    """The report as PDF; the same report and the same fonts give the same bytes.

    It conforms to PDF/UA-1, unless a text has characters that no font of this machine has. They are then shown as
    boxes, which the standard does not allow, and the document is tagged but does not claim the standard.
    """
    with tempfile.TemporaryDirectory(prefix="orthocapture-report-") as name:
        folder = Path(name)
        (folder / "report.json").write_text(json.dumps(_document(report, folder)), encoding="utf-8")
        source = (files("service.audit.report.output") / "templates" / "report.typ").read_bytes()
        found = [folder for folder in _FONT_FOLDERS if (Path(folder) / _FONT_FILE).is_file()][:1]
        for with_system, standard in _TRIES:
            fonts = typst.Fonts(include_system_fonts=with_system, font_paths=[*found])
            compiler = typst.Compiler(source, root=str(folder), font_paths=fonts)
            try:
                made = compiler.compile(format="pdf", pdf_standards=standard)
            except typst.TypstError:
                if standard is not None:
                    continue
                raise
            assert isinstance(made, bytes)
            return made
    raise AssertionError("the last try raises or returns")


def _document(report: Report, folder: Path) -> dict[str, Any]:
    """The report as plain data; pictures and drawings are written beside it as files."""
    numbers = itertools.count()
    at = report.made_at
    statements = [report.origin, report.verification, report.deviations, report.result]
    release = report.release
    return {
        "title": report.title,
        "run": report.run_id,
        "head": report.head_sha256,
        "made": moment(at),
        "date": {"year": at.year, "month": at.month, "day": at.day,
                 "hour": at.hour, "minute": at.minute, "second": at.second},
        "simulated": report.simulated,
        "unreleased": _cell(release) if release is not None and release.tone == "stop" else None,
        "statements": [
            _sentence(cell)
            for cell in (release if release is not None and release.tone != "stop" else None, *statements)
            if cell is not None
        ],
        "facts": _facts(report.facts),
        "sections": [
            {"title": section.title, "blocks": [_block(block, folder, numbers) for block in section.blocks]}
            for section in report.sections
        ],
    }  # fmt: skip


def _sentence(cell: TableCell) -> dict[str, Any]:
    return _cell(TableCell(cell.text + ("" if cell.text.endswith(".") else "."), cell.tone))


def _block(block: Block, folder: Path, numbers: Iterator[int]) -> dict[str, Any]:
    match block:
        case Heading(text):
            made: dict[str, Any] = {"kind": "heading", "text": text}
        case Paragraph(text, tone):
            made = {"kind": "paragraph", **_cell(TableCell(text, tone))}
        case DescriptionList():
            made = {"kind": "facts", "rows": _facts(block)}
        case Table():
            made = _table(block)
        case Pictures(items, columns):
            shown = [_picture(picture, folder, next(numbers)) for picture in items]
            made = {"kind": "pictures", "columns": columns, "items": shown}
        case Drawings(items):
            made = {"kind": "drawings", "items": [_drawing(one, folder, next(numbers)) for one in items]}
        case SceneBlock(drawing):
            made = {"kind": "scene", **_drawing(drawing, folder, next(numbers))}
    return made


def _facts(facts: DescriptionList) -> list[dict[str, Any]]:
    return [{"name": name, **_cell(value)} for name, value in facts.rows]


def _table(table: Table) -> dict[str, Any]:
    whole = sum(column.share for column in table.columns)
    return {
        "kind": "table",
        "headed": any(column.heading for column in table.columns),
        "columns": [{"heading": c.heading, "share": c.share, "style": c.style} for c in table.columns],
        "rows": [
            {
                "strong": number in table.strong,
                "spanning": number in table.spanning,
                "cells": [
                    _cell(value, code=column.style == "code", wide=column.share >= _WIDE * whole)
                    for value, column in zip(row, table.columns, strict=True)
                ],
            }
            for number, row in enumerate(table.rows)
        ],
        "small": table.small,
    }


def _cell(value: TableCell | str, *, code: bool = False, wide: bool = True) -> dict[str, Any]:
    text, tone = (value, "plain") if isinstance(value, str) else (value.text, value.tone)
    if _is_hash(text):
        # A hash is easier to compare in a monospaced font, and is copied without line breaks.
        return {"parts": [text] if wide else [text[:32], text[32:]], "tone": tone, "code": True}
    return {"parts": _parts(text), "tone": tone, "code": code}


def _is_hash(text: str) -> bool:
    return len(text) == 64 and " " not in text


def _parts(text: str) -> list[str]:
    """Parts of a text between which a line may break, for long names without spaces in narrow columns."""
    return [part for part in _LONG_WORD.sub(lambda found: _MEETING.sub("\n", found[0]), text).split("\n") if part]


def _picture(picture: Picture, folder: Path, number: int) -> dict[str, Any]:
    name = ""
    if picture.jpeg is not None:
        name = f"{number}.jpg"
        (folder / name).write_bytes(picture.jpeg)
    return {"caption": picture.caption, "file": name}


def _drawing(drawing: Drawing, folder: Path, number: int) -> dict[str, Any]:
    name = f"{number}.svg"
    (folder / name).write_text(drawing_svg(drawing), encoding="utf-8")
    return {"title": drawing.title, "text": drawing.text, "file": name}
