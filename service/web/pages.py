"""Rendering: every page gets who looks, the theme, and the tokens that its forms need."""

from __future__ import annotations

from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

TEMPLATES = Environment(
    loader=PackageLoader("service.web"),
    autoescape=select_autoescape(["html", "j2"]),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(request: Request, template: str, *, status: int = 200, **context: Any) -> HTMLResponse:
    """A page, or a part of one. `person` is who is signed in, or None on the few public pages."""
    person = getattr(request.state, "person", None)
    text = TEMPLATES.get_template(template).render(request=request, person=person, **context)
    return HTMLResponse(text, status_code=status)
