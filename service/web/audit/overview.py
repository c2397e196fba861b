"""The auditor's first page of a run, and all its deviations."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.background import PartialProgress
from service.audit.overview import findings, first_page
from service.audit.overview.devices import bodies_of_run, opened_devices
from service.audit.overview.digest import Digest, failed_exposures_of, shots_of, together
from service.audit.overview.first_page import DEVIATION_GROUPS, GROUPS, NOTE_GROUPS
from service.audit.overview.signatures import RecordedSignature
from service.audit.overview.signatures import signatures as signatures_of
from service.audit.record import rows
from service.audit.record.rows import EventRow
from service.core.equipment.camera_bodies import CameraBodies
from service.core.equipment.recorded_devices import RecordedIdentity
from service.run_record import results_to_come
from service.web.audit.frame import AuditState, CurrentAudit, audit_frame, close_audit, link
from service.web.audit.gates import accuracy_of
from service.web.audit.protocol_identity import protocol_identity
from service.web.page.rendering import TEMPLATES, render
from service.web.security.guards import requires

if TYPE_CHECKING:
    from service.steps.poses.time_left import PendingResult


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncGenerator[None]:
    """Read the templates at the start, so that the first page of a run answers at once."""
    for name in TEMPLATES.list_templates(filter_func=lambda name: name.startswith(("audit/", "evidence/"))):
        TEMPLATES.get_template(name)
    yield
    close_audit(app)


router = APIRouter(tags=["audit"], lifespan=_lifespan)
_FIRST = 25  # of a list on the first page
_READ = [Depends(requires("read"))]


@dataclass(frozen=True, slots=True)
class _Recorded:
    """What the first page reads from the run's events and from the index of them.

    Attributes:
        root: first event of the run, None if it is missing.
        corrected: number of corrections.
        devices: as they were opened.
        session: last start of the program that drove the run.
        sessions: number of starts.
        exports: events of exports.
        signatures: of steps, and of the run's release.
        failures: number of failed exposures of each step.
        bodies: of the cameras.
    """

    root: EventRow | None
    corrected: int
    devices: dict[str, RecordedIdentity]
    session: EventRow | None
    sessions: int
    exports: list[EventRow]
    signatures: list[RecordedSignature]
    failures: dict[str, int]
    bodies: CameraBodies


def _recorded(audit: AuditState, run_id: str, digest: Digest | None) -> _Recorded:
    with audit.site.store.database.reading() as connection:
        root = rows.read_rows(connection, run_id, [1], whole=True)
        opened = opened_devices(findings.events_of(connection, run_id, "device_opened", newest=True))
        sessions = findings.events_of(connection, run_id, "session_started", newest=True)
        return _Recorded(
            root=root[0] if root else None,
            corrected=rows.count_of_kind(connection, run_id, "record_corrected"),
            devices={device.name: device.report.identity for device in opened},
            session=sessions[-1] if sessions else None,
            sessions=len(sessions),
            exports=findings.events_of(connection, run_id, "evidence_exported", newest=True),
            signatures=signatures_of(connection, run_id, digest),
            failures=failed_exposures_of(connection, run_id),
            bodies=bodies_of_run(connection, run_id, opened),
        )


@router.get("/audit/runs/{run_id}", name="audit_run", dependencies=_READ, response_class=HTMLResponse)
def run_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """The first page of a run: deviations first."""
    frame = audit_frame(audit, run_id, "")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    recorded = _recorded(audit, run_id, known)
    listed = first_page.findings(known) if known else []
    gates = first_page.failed_gates(known) if known else []
    return render(
        request,
        "audit/run.html.j2",
        recorded,
        identity=protocol_identity(audit.site.store, run_id, frame.run.protocol, frame.run.version),
        audit=frame,
        digest=known,
        progress=digest if isinstance(digest, PartialProgress) else None,
        counts=first_page.counts(known) if known else {},
        deviation_groups=DEVIATION_GROUPS,
        note_groups=NOTE_GROUPS,
        group_name=first_page.group_name,
        listed=listed[:_FIRST],
        deviations=len(listed),
        failed_gates=gates[:_FIRST],
        more_gates=len(gates) - _FIRST,
        accuracy=accuracy_of(known),
        dataset_exported=any(row.payload.get("what") == "dataset" for row in recorded.exports),
        shots=shots_of(known, recorded.failures),
        together=together,
        releases=[signature for signature in recorded.signatures if not signature.step],
        late=known.late if known else [],
        to_come=[left.text for left in _to_come(audit, run_id, known)],
    )


def _to_come(audit: AuditState, run_id: str, digest: Digest | None) -> list[PendingResult]:
    """Results that are still being computed, or that failed. The whole run is read only if there may be any."""
    failed = digest is not None and digest.facets.kinds.get("job_failed", 0) > 0
    if digest is None or digest.problem or not (failed or audit.site.store.open_jobs(run_id)):
        return []
    return results_to_come(audit.site.run(run_id))


@router.get(
    "/audit/runs/{run_id}/deviations", name="audit_deviations", dependencies=_READ, response_class=HTMLResponse
)
def deviations_page(request: Request, audit: CurrentAudit, run_id: str, group: str = "", page: int = 1) -> Response:
    """All deviations, or what is in one group of them or of what else is recorded."""
    frame = audit_frame(audit, run_id, "")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    group = group if group in GROUPS else ""
    listed = first_page.findings(known, group) if known else []
    pages = max(1, -(-len(listed) // rows.PAGE))
    page = min(max(page, 1), pages)
    return render(
        request,
        "audit/deviations.html.j2",
        audit=frame,
        progress=digest if isinstance(digest, PartialProgress) else None,
        groups=GROUPS,
        note_groups=NOTE_GROUPS,
        deviations=len(known.deviations) if known else 0,
        counts=first_page.counts(known) if known else {},
        group=group,
        listed=listed[(page - 1) * rows.PAGE : page * rows.PAGE],
        count=len(listed),
        page=page,
        pages=pages,
        href=lambda number: link(f"{frame.base}/deviations", {"group": group, "page": number}),
    )
