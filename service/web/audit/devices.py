"""The auditor's page of a run's devices: identities and versions, clocks, and faults."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.overview import findings
from service.audit.overview.devices import bodies_of_run, clock_offsets, opened_devices, sessions
from service.audit.record import rows
from service.core.equipment.clocks import clock_offset_words, clock_readings
from service.steps.notes import deidentified
from service.web.audit.frame import CurrentAudit, audit_frame
from service.web.page.rendering import render
from service.web.record.images import further_cameras_of
from service.web.security.guards import requires

router = APIRouter(tags=["audit"])


@router.get(
    "/audit/runs/{run_id}/devices",
    name="audit_devices",
    dependencies=[Depends(requires("read"))],
    response_class=HTMLResponse,
)
def devices_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Devices with versions, clocks, troubles; sessions and software."""
    frame = audit_frame(audit, run_id, "/devices")
    with audit.site.store.database.reading() as connection:
        opened = opened_devices(findings.events_of(connection, run_id, "device_opened", newest=True))
        started = findings.events_of(connection, run_id, "session_started", newest=True)
        troubles = findings.events_of(connection, run_id, "device_trouble", newest=True)
        trouble_count = rows.count_of_kind(connection, run_id, "device_trouble")
        clocks = clock_offsets(connection, run_id)
        bodies = bodies_of_run(connection, run_id, opened)
    log = audit.site.run(run_id)
    readings = clock_readings(log.events)
    return render(
        request,
        "audit/devices.html.j2",
        audit=frame,
        opened=opened,
        bodies=bodies,
        removed=[one.words for state in log.state.steps.values() for one in deidentified(state)],
        clock_offset_words=clock_offset_words,
        sessions=sessions(started),
        troubles=troubles[-50:],
        trouble_count=trouble_count,
        clocks=clocks,
        readings=readings,
        further=further_cameras_of(log),
    )
