"""Writes a report as one self-contained HTML file, as PDF on A4, and its figures as SVG and CSV."""

from __future__ import annotations

import base64
import csv
import io
import itertools
import json
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import typst
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup

from service.audit.report_blocks import (
    Block,
    DescriptionList,
    Drawing,
    Drawings,
    Heading,
    Line,
    Paragraph,
    Picture,
    Pictures,
    Raster,
    Rectangle,
    Report,
    SceneBlock,
    Table,
    TableCell,
    moment,
)
from service.dataset.summary import RunSummary

_FONTS = "'DejaVu Sans', system-ui, sans-serif"


def drawing_svg(drawing: Drawing) -> str:
    """Return an svg element with title and description for screen readers."""
    parts: list[str] = []
    for shape in drawing.shapes:
        if isinstance(shape, Rectangle):
            place = f'x="{shape.x:.2f}" y="{shape.y:.2f}" width="{shape.width:.2f}" height="{shape.height:.2f}"'
            parts.append(f'<rect {place} fill="{shape.colour}"/>')
        elif isinstance(shape, Line):
            ends = f'x1="{shape.x1:.2f}" y1="{shape.y1:.2f}" x2="{shape.x2:.2f}" y2="{shape.y2:.2f}"'
            parts.append(f'<line {ends} stroke="{shape.colour}" stroke-width="{shape.width}"/>')
        elif isinstance(shape, Raster):
            place = f'x="{shape.x:.2f}" y="{shape.y:.2f}" width="{shape.width:.2f}" height="{shape.height:.2f}"'
            url = "data:image/png;base64," + base64.b64encode(shape.png).decode()
            parts.append(f'<image {place} href="{url}"/>')
        else:
            place = f'x="{shape.x:.2f}" y="{shape.y:.2f}" font-size="{shape.size}" text-anchor="{shape.anchor}"'
            parts.append(f'<text {place} fill="{shape.colour}">{escape(shape.text)}</text>')
    label = escape(f"{drawing.title}. {drawing.text}", quote=True)
    box = f'viewBox="0 0 {drawing.width:.2f} {drawing.height:.2f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {box} font-family="{_FONTS}" role="img" aria-label="{label}">'
        f"{''.join(parts)}</svg>"
    )


def write_html(report: Report, path: Path) -> None:
    """Write the file; its folder is made if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render_html(report), encoding="utf-8")


def render_html(report: Report) -> str:
    """Return the report as HTML."""
    return _template().render(report=report)


@cache
def _template() -> Template:
    """Return the template, which takes longer to compile than to fill in."""
    environment = Environment(
        loader=PackageLoader("service.audit"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"cell": _cell, "data_url": _data_url, "svg": _svg, "moment": moment}
    return environment.get_template("report.html.j2")


def _cell(value: TableCell | str) -> Markup:
    if isinstance(value, str):
        return Markup(escape(value))
    if value.tone == "plain":
        return Markup(escape(value.text))
    return Markup('<span class="{}">{}</span>').format(value.tone, value.text)


def _data_url(picture: Picture) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(picture.jpeg or b"").decode()


def _svg(drawing: Drawing) -> Markup:
    return Markup(drawing_svg(drawing))


# A report as PDF on A4, for printing and filing.
#
# Typeset by Typst, which tags every part and checks PDF/UA-1, so that screen readers can read it.


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
    """Return the report as PDF; the same report and the same fonts give the same bytes.

    It conforms to PDF/UA-1, unless a text has characters that no font of this machine has. They are then shown as
    boxes, which the standard does not allow, and the document is tagged but does not claim the standard.
    """
    with tempfile.TemporaryDirectory(prefix="orthocapture-report-") as name:
        folder = Path(name)
        (folder / "report.json").write_text(json.dumps(_document(report, folder)), encoding="utf-8")
        source = (files("service.audit") / "templates" / "report.typ").read_bytes()
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
    """Return the report as plain data; pictures and drawings are written beside it as files."""
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
        "unreleased": _typst_cell(release) if release is not None and release.tone == "stop" else None,
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
    return _typst_cell(TableCell(cell.text + ("" if cell.text.endswith(".") else "."), cell.tone))


def _block(block: Block, folder: Path, numbers: Iterator[int]) -> dict[str, Any]:
    match block:
        case Heading(text):
            made: dict[str, Any] = {"kind": "heading", "text": text}
        case Paragraph(text, tone):
            made = {"kind": "paragraph", **_typst_cell(TableCell(text, tone))}
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
    return [{"name": name, **_typst_cell(value)} for name, value in facts.rows]


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
                    _typst_cell(value, code=column.style == "code", wide=column.share >= _WIDE * whole)
                    for value, column in zip(row, table.columns, strict=True)
                ],
            }
            for number, row in enumerate(table.rows)
        ],
        "small": table.small,
    }


def _typst_cell(value: TableCell | str, *, code: bool = False, wide: bool = True) -> dict[str, Any]:
    text, tone = (value, "plain") if isinstance(value, str) else (value.text, value.tone)
    if _is_hash(text):
        # A hash is easier to compare in a monospaced font, and is copied without line breaks.
        return {"parts": [text] if wide else [text[:32], text[32:]], "tone": tone, "code": True}
    return {"parts": _parts(text), "tone": tone, "code": code}


def _is_hash(text: str) -> bool:
    return len(text) == 64 and " " not in text


def _parts(text: str) -> list[str]:
    """Return parts of a text between which a line may break, for long names without spaces in narrow columns."""
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


_ERRORS = (
    "poses", "source", "resolution", "images", "evaluated_on", "control_outlines", "mean_radial_error_mm",
    "mean_reprojection_error_px", "predicted_error_mm", "control_error_mm", "control_normalised_chi2", "late",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FigureFile:
    """One file; `shows` says what is in it."""

    name: str
    shows: str
    text: str


def figure_files(report: Report, summary: RunSummary) -> list[FigureFile]:
    """Return every figure of a report, numbered by its section, then the tables of errors as CSV."""
    found: list[FigureFile] = []
    for number, section in enumerate(report.sections, 1):
        # If a run calibrates twice, two sections have figures of the same names.
        for drawing in _drawings(section.blocks):
            name = f"{number:02d}_{drawing.name}"
            shows = f"{section.title}. {drawing.title}"
            found.append(FigureFile(f"{name}.svg", shows, drawing_svg(drawing) + "\n"))
            found.append(FigureFile(f"{name}.csv", shows, _csv(drawing.rows)))
    table = summary.table()
    if table:
        rows = [_ERRORS, *(tuple(_text(row.plain(), name) for name in _ERRORS) for row in table)]
        found.append(FigureFile("registration_error.csv", "Registration error by source of camera poses", _csv(rows)))
    contributions = [
        (poses, item.name, f"{item.sigma_mm:.6f}", "yes" if item.counted else "no", item.how)
        for poses, budget in summary.budgets().items()
        for item in budget.contributions
    ]
    if contributions:
        head = ("poses", "source", "sigma_mm", "in_the_sum", "how")
        found.append(FigureFile("error_budget.csv", "Error budget", _csv([head, *contributions])))
    return found


def write_figures(files: Sequence[FigureFile], folder: Path) -> None:
    """Write the files; the folder is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        (folder / file.name).write_text(file.text, encoding="utf-8", newline="")


def _drawings(blocks: Sequence[object]) -> Iterator[Drawing]:
    for block in blocks:
        if isinstance(block, Drawings):
            yield from block.items
        elif isinstance(block, SceneBlock):
            yield block.drawing


def _csv(rows: Sequence[Sequence[str]]) -> str:
    out = io.StringIO()
    csv.writer(out).writerows([_plain(cell) for cell in row] for row in rows)
    return out.getvalue()


def _plain(cell: str) -> str:
    """Return the text, with an apostrophe in front if a spreadsheet would take it for a formula; numbers stay."""
    return f"'{cell}" if re.match(r"[=+@\t\r]|-(?![\d.])", cell) else cell


def _text(row: Mapping[str, Any], name: str) -> str:
    value = row.get(name)
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
