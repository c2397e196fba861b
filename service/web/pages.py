"""Rendering: every page gets who looks, the theme, how the robots stand, and the tokens that its forms need."""

from __future__ import annotations

from functools import partial
from typing import Any

from fastapi import Path, Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from service.web.run_frame import LOST, driven_frames

TEMPLATES = Environment(
    loader=PackageLoader("service.web"),
    autoescape=select_autoescape(["html", "j2"]),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def part_names(*names: str) -> Any:
    """Path parameter that names one or more of a page's parts, between commas."""
    one = f"({'|'.join(names)})"
    return Path(pattern=f"^{one}(,{one}){{0,{len(names) - 1}}}$")


def render(request: Request, template: str, *, status: int = 200, **context: Any) -> HTMLResponse:
    """A page, or a part of one. `person` is who is signed in, or None on the few public pages."""
    person = getattr(request.state, "person", None)
    text = TEMPLATES.get_template(template).render(
        request=request,
        person=person,
        robots=partial(driven_frames, request.app.state.site),  # asked by whole pages, not by parts
        robots_lost=LOST,
        **context,
    )
    return HTMLResponse(text, status_code=status)
