"""The auditor's list of runs, the first page of a run with its deviations, and whether its protocol was approved."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Depends, FastAPI, Query, Request
from fastapi.responses import HTMLResponse, Response
from sqlalchemy import text

from service.audit import findings, overview, queries
from service.audit.background import PartialProgress
from service.audit.devices import bodies_of_run, opened_devices
from service.audit.filters import RunSearch
from service.audit.findings import RecordedSignature
from service.audit.findings import signatures as signatures_of
from service.audit.overview import (
    DEVIATION_GROUPS,
    GROUPS,
    NOTE_GROUPS,
    Digest,
    ListedRun,
    failed_exposures_of,
    shots_of,
    together,
)
from service.audit.queries import EventRow
from service.audit.runs import find_runs
from service.core.errors import OrthocaptureError
from service.core.recorded_devices import CameraBodies, RecordedIdentity
from service.people.approvals import Approval, approvals, difference
from service.run_record import results_to_come
from service.store.event_index import facet_value
from service.store.records import SITE
from service.store.store import Store
from service.web.audit import AuditState, CurrentAudit, RunQuery, accuracy_of, audit_frame, close_audit, link
from service.web.rendering import TEMPLATES, render
from service.web.security import requires

if TYPE_CHECKING:
    from service.steps.due_jobs import PendingResult


@dataclass(frozen=True, slots=True)
class DifferingContent:
    """Different content under the same id and version: its runs, who approved it, and the lines that differ."""

    sha256: str
    runs: tuple[str, ...]
    by: str
    changes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ProtocolIdentity:
    """The content of a run's protocol, who approved it, and the others under its name."""

    sha256: str
    approval: Approval | None
    others: tuple[DifferingContent, ...]


_CONTENTS = text(
    "SELECT p.run_id, s.value AS sha256 FROM event_facets AS p "
    "JOIN event_facets AS v ON v.run_id = p.run_id AND v.seq = 1 AND v.name = 'protocol_version' "
    "JOIN event_facets AS s ON s.run_id = p.run_id AND s.seq = 1 AND s.name = 'protocol_sha256' "
    "WHERE p.seq = 1 AND p.run_id <> :site AND p.name = 'protocol_id' AND p.value = :protocol "
    "AND v.value = :version ORDER BY p.run_id"
)


def protocol_identity(store: Store, run_id: str, protocol: str, version: str) -> ProtocolIdentity:
    """Look up the contents that runs used under this protocol's name, and who approved each of them."""
    known = approvals(store, protocol, version)
    with store.database.reading() as connection:
        rows = connection.execute(
            _CONTENTS, {"site": SITE, "protocol": facet_value(protocol), "version": facet_value(version)}
        )
        by_run = {str(row.run_id): str(row.sha256 or "") for row in rows}
    mine = by_run.get(run_id, "")
    approved = {one.payload.sha256: one for one in known}
    hashes = dict.fromkeys(sha256 for sha256 in (*by_run.values(), *approved) if sha256 not in ("", mine))
    source = _source(store, approved, mine)
    others = [
        DifferingContent(
            sha256,
            tuple(run for run, its in by_run.items() if its == sha256),
            approved[sha256].by if sha256 in approved else "",
            tuple(difference(_source(store, approved, sha256), source)) if source else (),
        )
        for sha256 in hashes
    ]
    return ProtocolIdentity(mine, approved.get(mine), tuple(others))


def _source(store: Store, approved: dict[str, Approval], sha256: str) -> str:
    """Return the text of a content: from its approval, else from the evidence of a run; "" if neither can be read."""
    if sha256 in approved:
        return approved[sha256].payload.source
    try:
        return store.artefact_path(sha256).read_text("utf-8")
    except (OSError, UnicodeDecodeError, OrthocaptureError):
        return ""


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncGenerator[None]:
    """Read the templates at the start, so that the first page of a run answers at once."""
    for name in TEMPLATES.list_templates(filter_func=lambda name: name.startswith("audit/")):
        TEMPLATES.get_template(name)
    yield
    close_audit(app)


router = APIRouter(tags=["audit"], lifespan=_lifespan)
_FIRST = 25  # of a list on the first page
_READ = [Depends(requires("read"))]


@dataclass(frozen=True, slots=True)
class _Recorded:
    """The data that the first page reads from the run's events and from the index of them.

    Attributes:
        root: first event of the run; None if it is missing.
        corrected: number of corrections.
        devices: the devices' identities, as they were opened.
        session: last start of the program that drove the run.
        sessions: number of starts.
        exports: events of exports.
        signatures: the signatures of steps, and of the run's release.
        failures: number of failed exposures of each step.
        bodies: the bodies of the cameras.
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
        root = queries.read_rows(connection, run_id, [1], whole=True)
        opened = opened_devices(findings.events_of(connection, run_id, "device_opened", newest=True))
        sessions = findings.events_of(connection, run_id, "session_started", newest=True)
        return _Recorded(
            root=root[0] if root else None,
            corrected=queries.count_of_kind(connection, run_id, "record_corrected"),
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
    """Show the first page of a run: deviations first."""
    frame = audit_frame(audit, run_id, "")
    digest = audit.digests.get(run_id)
    known = overview.known(digest)
    recorded = _recorded(audit, run_id, known)
    listed = overview.findings(known) if known else []
    gates = overview.failed_gates(known) if known else []
    return render(
        request,
        "audit/run.html.j2",
        recorded,
        identity=protocol_identity(audit.site.store, run_id, frame.run.protocol, frame.run.version),
        audit=frame,
        digest=known,
        progress=digest if isinstance(digest, PartialProgress) else None,
        counts=overview.counts(known) if known else {},
        deviation_groups=DEVIATION_GROUPS,
        note_groups=NOTE_GROUPS,
        group_name=overview.group_name,
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
    """Return results that are still being computed, or that failed.

    The whole run is read only if there may be any.
    """
    failed = digest is not None and digest.facets.kinds.get("job_failed", 0) > 0
    if digest is None or digest.problem or not (failed or audit.site.store.open_jobs(run_id)):
        return []
    return results_to_come(audit.site.run(run_id))


@router.get(
    "/audit/runs/{run_id}/deviations", name="audit_deviations", dependencies=_READ, response_class=HTMLResponse
)
def deviations_page(request: Request, audit: CurrentAudit, run_id: str, group: str = "", page: int = 1) -> Response:
    """Show all deviations, or what is in one group of them or of what else is recorded."""
    frame = audit_frame(audit, run_id, "")
    digest = audit.digests.get(run_id)
    known = overview.known(digest)
    group = group if group in GROUPS else ""
    listed = overview.findings(known, group) if known else []
    pages = max(1, -(-len(listed) // queries.PAGE))
    page = min(max(page, 1), pages)
    return render(
        request,
        "audit/deviations.html.j2",
        audit=frame,
        progress=digest if isinstance(digest, PartialProgress) else None,
        groups=GROUPS,
        note_groups=NOTE_GROUPS,
        deviations=len(known.deviations) if known else 0,
        counts=overview.counts(known) if known else {},
        group=group,
        listed=listed[(page - 1) * queries.PAGE : page * queries.PAGE],
        count=len(listed),
        page=page,
        pages=pages,
        href=lambda number: link(f"{frame.base}/deviations", {"group": group, "page": number}),
    )


_RUNS_A_PAGE = 25


@router.get("/audit", name="audit", dependencies=_READ, response_class=HTMLResponse)
def runs_page(request: Request, audit: CurrentAudit, query: Annotated[RunQuery, Query()]) -> Response:
    """Show the runs, newest first."""
    with audit.site.store.database.reading() as connection:
        every = queries.runs(connection)
    said = {run.basics.run_id for run in find_runs(audit.site.store, RunSearch(q=query.q))}
    listed = [_listed(audit, basics) for basics in every]
    found = [run for run in listed if run.basics.run_id in said and overview.matches(run, query)]
    pages = max(1, -(-len(found) // _RUNS_A_PAGE))
    page = min(max(query.page, 1), pages)
    return render(
        request,
        "audit/runs.html.j2",
        runs=found[(page - 1) * _RUNS_A_PAGE : page * _RUNS_A_PAGE],
        count=len(found),
        every=len(every),
        unknown=sum(run.digest is None for run in found),
        protocols=sorted({run.protocol for run in every if run.protocol}),
        people=overview.people_of(listed),
        wanted=query,
        page=page,
        pages=pages,
        href=lambda number: link("/audit", {**query.query(), "page": number}),
    )


def _listed(audit: AuditState, basics: queries.RunBasics) -> ListedRun:
    digest = audit.digests.at(basics.run_id, basics.head_seq, basics.head_sha256)
    if isinstance(digest, PartialProgress):
        audit.digests.warm(basics.run_id)
    return ListedRun(basics, overview.known(digest), audit.verifications.last(basics.run_id))
