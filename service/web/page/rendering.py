"""Rendering: every page gets who looks, the theme, how the robots stand, and the tokens that its forms need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Any, cast

from fastapi import Path, Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader, PrefixLoader, StrictUndefined, select_autoescape
from pydantic import ValidationError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from service.audit.record.rows import EventRow

from service.core.records.entered import RunAbout, about_rows
from service.core.text.clock_time import local_time
from service.core.text.counts import counted
from service.web.page.robot_banner import LOST
from service.web.page.run_frame import driven_frames

_FOLDERS = (
    "audit",
    "calibration",
    "capture",
    "dataset",
    "evidence",
    "handheld",
    "home",
    "page",
    "people",
    "run",
    "scene",
)

# Templates lie beside their pages: "run/run.html.j2" is service/web/run/templates/run.html.j2.
TEMPLATES = Environment(
    loader=PrefixLoader({folder: PackageLoader(f"service.web.{folder}") for folder in _FOLDERS}),
    autoescape=select_autoescape(["html", "j2"]),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def kept_in_a_row(rows: Sequence[EventRow], start: int) -> int:
    """How many events from `start` on keep files for the same step."""
    first = rows[start]
    return sum(1 for _ in takewhile(lambda row: (row.kind, row.step) == (first.kind, first.step), rows[start:]))


def entered_of(root: EventRow) -> list[tuple[str, str]]:
    """What was entered when a run began, read from its first event in the database."""
    try:
        return about_rows(RunAbout.model_validate(root.payload.get("about") or {}))
    except ValidationError:  # altered: the verification says so
        return []


# Its type names its own names only.
cast("dict[str, Any]", TEMPLATES.globals).update(kept_in_a_row=kept_in_a_row, about_rows=entered_of, counted=counted)
TEMPLATES.filters["local_time"] = local_time


def part_names(*names: str) -> Any:
    """Path parameter that names one or more of a page's parts, between commas."""
    one = f"({'|'.join(names)})"
    return Path(pattern=f"^{one}(,{one}){{0,{len(names) - 1}}}$")


def render(
    request: Request, template: str, shown: DataclassInstance | None = None, /, *, status: int = 200, **more: object
) -> HTMLResponse:
    """A page, or a part of one.

    Args:
        request: whose `person` is who is signed in, or None on the few public pages.
        template: `run/run.html.j2` is service/web/run/templates/run.html.j2.
        shown: record of what the page shows; the template has its fields as variables.
        status: of the response.
        more: further variables of the template.
    """
    own: Mapping[str, object] = {} if shown is None else {f.name: getattr(shown, f.name) for f in fields(shown)}
    person = getattr(request.state, "person", None)
    text = TEMPLATES.get_template(template).render(
        request=request,
        person=person,
        robots=partial(driven_frames, request.app.state.site),  # asked by whole pages, not by parts
        robots_lost=LOST,
        second_place_away=request.app.state.site.second_place.away,
        **own,
        **more,
    )
    return HTMLResponse(text, status_code=status)
