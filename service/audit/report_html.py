"""A report as one HTML file that opens anywhere: nothing in it is fetched from elsewhere."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from service.audit.report_blocks import Box, Cell, Drawing, Line, Picture, Report


def write_html(report: Report, path: Path) -> None:
    """Write the file, and its folder where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render_html(report), encoding="utf-8")


def render_html(report: Report) -> str:
    """The whole document."""
    environment = Environment(
        loader=PackageLoader("service.audit"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"cell": _cell, "data_url": _data_url, "svg": _svg, "kind": _kind}
    return environment.get_template("report.html.j2").render(report=report)


def _kind(block: object) -> str:
    return type(block).__name__


def _cell(value: Cell | str) -> Markup:
    if isinstance(value, str):
        return Markup(escape(value))
    if value.tone == "plain":
        return Markup(escape(value.text))
    return Markup('<span class="{}">{}</span>').format(value.tone, value.text)


def _data_url(picture: Picture) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(picture.jpeg or b"").decode()


def _svg(drawing: Drawing) -> Markup:
    parts: list[str] = []
    for shape in drawing.shapes:
        if isinstance(shape, Box):
            place = f'x="{shape.x:.2f}" y="{shape.y:.2f}" width="{shape.width:.2f}" height="{shape.height:.2f}"'
            parts.append(f'<rect {place} fill="{shape.colour}"/>')
        elif isinstance(shape, Line):
            ends = f'x1="{shape.x1:.2f}" y1="{shape.y1:.2f}" x2="{shape.x2:.2f}" y2="{shape.y2:.2f}"'
            parts.append(f'<line {ends} stroke="{shape.colour}" stroke-width="{shape.width}"/>')
        else:
            place = f'x="{shape.x:.2f}" y="{shape.y:.2f}" font-size="{shape.size}" text-anchor="{shape.anchor}"'
            parts.append(f'<text {place} fill="{shape.colour}">{escape(shape.text)}</text>')
    label = escape(f"{drawing.title}. {drawing.text}", quote=True)
    box = f'viewBox="0 0 {drawing.width:.2f} {drawing.height:.2f}"'
    return Markup(f'<svg {box} role="img" aria-label="{label}">{"".join(parts)}</svg>')
