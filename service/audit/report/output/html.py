"""A report as one self-contained HTML file."""

from __future__ import annotations

import base64
from functools import cache
from html import escape
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup

from service.audit.report.blocks import Drawing, Picture, Report, TableCell
from service.audit.report.output.svg import drawing_svg
from service.audit.report.words import moment


def write_html(report: Report, path: Path) -> None:
    """Write the file; its folder is made if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render_html(report), encoding="utf-8")


def render_html(report: Report) -> str:
    """The report as HTML."""
    return _template().render(report=report)


@cache
def _template() -> Template:
    """The template, which takes longer to compile than to fill in."""
    environment = Environment(
        loader=PackageLoader("service.audit.report.output"),
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
