"""A drawing of a report as SVG, for pages, PDF and files."""

from __future__ import annotations

import base64
from html import escape

from service.audit.report.blocks import Drawing, Line, Raster, Rectangle

_FONTS = "'DejaVu Sans', system-ui, sans-serif"


def drawing_svg(drawing: Drawing) -> str:
    """An svg element with title and description for screen readers."""
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
