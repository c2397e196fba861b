"""A protocol on paper: every step with its checklist, limits and room for times and initials, to print."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request
from fastapi.responses import HTMLResponse

from service.core.errors import ConfigurationError
from service.core.gates.measure_names import measure_name
from service.core.protocol.models import Protocol, irreversible_warning, load_protocol
from service.core.records.events import RunStarted
from service.steps import params_models
from service.web.page.rendering import render
from service.web.page.run_frame import run_frame
from service.web.page.run_words import limit
from service.web.security.guards import requires
from service.web.site import CurrentSite

router = APIRouter(tags=["checklist"])


@router.get("/protocols/{file}/checklist", name="protocol_checklist", dependencies=[Depends(requires("read"))])
def protocol_checklist(
    request: Request, site: CurrentSite, file: Annotated[str, Path(max_length=200)]
) -> HTMLResponse:
    """Show the checklist of a protocol that can be started. Raises ConfigurationError for any other file."""
    known = {path.name: path for path in site.protocol_files()}
    if file not in known:
        raise ConfigurationError(f"there is no protocol file {file!r}", where="protocols", remedy="Go to the runs")
    loaded = load_protocol(known[file], params_models())
    return _page(request, loaded.protocol, loaded.sha256)


@router.get("/runs/{run_id}/checklist", name="run_checklist", dependencies=[Depends(requires("read"))])
def run_checklist(request: Request, site: CurrentSite, run_id: Annotated[str, Path(max_length=64)]) -> HTMLResponse:
    """Show the checklist of the protocol that a run began with."""
    log = site.run(run_id)
    root = log.events[0].payload
    assert isinstance(root, RunStarted)  # checked when the run was read
    return _page(request, log.protocol, root.protocol_sha256, run_id=run_id, frame=run_frame(site, run_id))


def _page(
    request: Request, protocol: Protocol, sha256: str, *, run_id: str = "", frame: object = None
) -> HTMLResponse:
    steps = [
        {
            "step": step,
            "paragraphs": [" ".join(part.split()) for part in step.instructions.split("\n\n") if part.strip()],
            "limits": [
                f"{measure_name(gate.measure)} {limit(gate.min, gate.max, gate.unit)}"
                for gate in step.gates
                if gate.measure != "checklist_items_open"
            ],
            "warning": irreversible_warning(protocol, step) if step.irreversible else "",
        }
        for step in protocol.steps
    ]
    return render(
        request, "home/checklist.html.j2", frame=frame, protocol=protocol, sha256=sha256, steps=steps, run_id=run_id
    )
