"""The form with which a run begins: what it is of and for, and the protocol with its hash and approval."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse

from service.audit.runs.search import RunSearch, find_runs
from service.core.errors import ConfigurationError
from service.core.records.entered import LINE_CHARACTERS, TEXT_CHARACTERS, RunAbout
from service.web.home.pages import startable_of
from service.web.page.rendering import render
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite

router = APIRouter(tags=["start"])
_KNOWN = 20  # entries of earlier runs that a field offers


@router.get("/start", name="start_form", dependencies=[Depends(requires("read"))])
def start_form(
    request: Request, site: CurrentSite, person: SignedInPerson, protocol: Annotated[str, Query(max_length=200)]
) -> HTMLResponse:
    """Fields of a new run of one protocol file; the site is filled in as in the run before."""
    if protocol not in {path.name for path in site.protocol_files()}:
        raise ConfigurationError(
            f"there is no protocol file {protocol!r}",
            where=str(site.protocols),
            remedy="Choose one of the first page",
        )
    earlier = [run.about for run in find_runs(site.store, RunSearch())]
    return render(
        request,
        "home/start.html.j2",
        p=startable_of(protocol, site),
        rig=site.rig.section,
        place=next((about.site for about in earlier if about.site), ""),
        operator=person.full_name,
        known={field: _known(earlier, field) for field in ("specimen", "purpose", "site")},
        line=LINE_CHARACTERS,
        longest=TEXT_CHARACTERS,
    )


def _known(earlier: list[RunAbout], field: str) -> list[str]:
    """What was entered before, newest first, each once."""
    return list(dict.fromkeys(value for about in earlier if (value := str(getattr(about, field)))))[:_KNOWN]
