"""A report as one self-contained HTML file."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

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


def write_html(report: Report, path: Path) -> None:
    """Write the file; its folder is made if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render_html(report), encoding="utf-8")


def render_html(report: Report) -> str:
    """The report as HTML."""
    environment = Environment(
        loader=PackageLoader("service.audit.report.output"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"cell": _cell, "data_url": _data_url, "svg": _svg, "kind": _kind, "moment": moment}
    return environment.get_template("report.html.j2").render(report=report)


def _kind(block: Block) -> str:
    """The name by which the template knows this kind of block; pyright finds a kind that has none."""
    match block:
        case Paragraph():
            kind = "paragraph"
        case Heading():
            kind = "heading"
        case DescriptionList():
            kind = "description list"
        case Table():
            kind = "table"
        case Pictures():
            kind = "pictures"
        case Drawings():
            kind = "drawings"
        case SceneBlock():
            kind = "scene"
    return kind


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
