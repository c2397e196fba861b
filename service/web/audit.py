"""The auditor's pages of a run and of the site: gates, corrections, verification, events, files, provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, FastAPI, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from service.audit import findings, overview, queries
from service.audit.background import ChildState, IncrementalResults, PartialProgress
from service.audit.devices import bodies_of_run, clock_offsets, opened_devices, sessions
from service.audit.filters import ArtefactFilter, EventFilter, RunFilter
from service.audit.findings import correct, correctable, signatures
from service.audit.overview import Digest, digests, verified
from service.audit.provenance import Graph, draw, graphs, origin
from service.audit.queries import RunBasics
from service.audit.verifications import Verification, Verifications
from service.computations import term
from service.core.measure_names import measure_name
from service.core.protocol import Protocol, Step
from service.core.recorded_devices import clock_offset_words, clock_readings
from service.core.records.import_list import imported_sentence
from service.core.run.state import RunState, StepState
from service.dataset.registrations import evaluated, own_registration
from service.steps import step_kinds
from service.steps.notes import deidentified
from service.steps.protocol_check import measures_of
from service.store.records import SITE, UnknownRunError
from service.web.images import further_cameras_of
from service.web.rendering import render
from service.web.run_actions import Reason
from service.web.run_frame import sentence
from service.web.run_view_records import GateLine, gate_lines
from service.web.security import SignedInPerson, requires
from service.web.site import Site, singleton

# --- shared by the auditor's pages: background computations, the frame of a run's pages, query fields -------------

_TABS = (
    ("", "Overview"),
    ("/gates", "Gates"),
    ("/timeline", "Timeline"),
    ("/artefacts", "Artefacts"),
    ("/provenance", "Provenance"),
    ("/corrections", "Corrections"),
    ("/signatures", "Signatures"),
    ("/devices", "Devices and clocks"),
    ("/verification", "Verification"),
)


@dataclass
class AuditState:
    """The background computations for one data folder."""

    site: Site
    digests: IncrementalResults[Digest]
    graphs: IncrementalResults[Graph]
    verifications: Verifications


def _audit_of(site: Site) -> AuditState:
    return AuditState(site, digests(site.store), graphs(site.store), Verifications(site.data, site.store.clock))


def close_audit(app: FastAPI) -> None:
    """End what is still being computed."""
    found: AuditState | None = getattr(app.state, "audit", None)
    if found is not None:
        found.digests.close()
        found.graphs.close()


CurrentAudit = Annotated[AuditState, Depends(singleton("audit", _audit_of))]


@dataclass(frozen=True, slots=True)
class AuditFrame:
    """The frame around every page of one run."""

    run: RunBasics
    base: str  # /audit/runs/RUN
    tabs: tuple[tuple[str, str], ...]  # address, text
    here: str  # address of the current tab
    verification: Verification | None
    verified: str
    verifying: ChildState | None
    imported: str  # the sentence that says so; "" for a run that captured its photographs itself


def audit_frame(audit: AuditState, run_id: str, tab: str) -> AuditFrame:
    """Return the frame of one run's page at `tab`. Raises UnknownRunError."""
    with audit.site.store.database.reading() as connection:
        found = queries.runs(connection, run_id)
    if not found:
        raise UnknownRunError(f"there is no run {run_id!r}", remedy="Choose one from the list of runs")
    base = f"/audit/runs/{run_id}"
    last = audit.verifications.last(run_id)
    return AuditFrame(
        run=found[0],
        base=base,
        tabs=(*((base + path, text) for path, text in _TABS), (f"/runs/{run_id}/exports", "Exports")),
        here=base + tab,
        verification=last,
        verified=verified(last, found[0].head_sha256),
        verifying=audit.verifications.running(run_id),
        imported=imported_sentence(found[0].created_utc, found[0].operator) if found[0].origin == "imported" else "",
    )


def link(address: str, query: Mapping[str, str | int | None]) -> str:
    """Return an address with its query; empty fields are left out."""
    fields = {name: value for name, value in query.items() if value not in ("", None, 0)}
    return f"{address}?{urlencode(fields)}" if fields else address


class RunQuery(RunFilter):
    """A page of the list of runs."""

    page: int = 1


class EventQuery(EventFilter):
    """A page of a list of events, which begins after one event or ends before one."""

    after: int = 0
    before: int = 0


class ArtefactQuery(ArtefactFilter):
    """A page of the list of files."""

    page: int = 1


# --- gates, devices, corrections, signatures, and whether the evidence verifies -----------------------------------

router = APIRouter(tags=["audit"])
_ERROR, _PIXELS = "mean_radial_error_mm", "mean_reprojection_error_px"


@dataclass(frozen=True, slots=True)
class StepGates:
    """The gates of one step as its last attempt was judged, and how many earlier judgements failed."""

    step: str
    title: str
    attempt: int
    lines: tuple[GateLine, ...]
    failed_before: int


@dataclass(frozen=True, slots=True)
class AccuracyRow:
    """One row of the accuracy table, compared with the limit by which the run's own registration was judged."""

    poses: str
    error_mm: float | None
    reprojection_px: float | None
    images: str
    late: str
    limit: str  # "" if the protocol sets none
    within: bool | None
    own: bool  # the run's own registration: what a data set is exported with


@router.get(
    "/audit/runs/{run_id}/gates",
    name="audit_gates",
    dependencies=[Depends(requires("read"))],
    response_class=HTMLResponse,
)
def gates_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show every gate of every step, in the order of the protocol."""
    digest = audit.digests.get(run_id)
    known = overview.known(digest)
    return render(
        request,
        "audit/gates.html.j2",
        audit=audit_frame(audit, run_id, "/gates"),
        progress=digest if isinstance(digest, PartialProgress) else None,
        steps=gates_of(known) if known else [],
    )


def gates_of(digest: Digest) -> list[StepGates]:
    """Return the steps that have gates."""
    protocol, state = digest.protocol, digest.state
    if protocol is None or state is None:
        return []
    out: list[StepGates] = []
    for step in protocol.steps:
        if not step.gates:
            continue
        now = state.steps[step.id]
        failed = sum(gate.step == step.id and gate.attempt < now.attempt for gate in digest.failed_gates)
        lines = _explained(protocol, step, now, state.skipped)
        out.append(StepGates(step.id, step.title, now.attempt, lines, failed))
    return out


def _explained(protocol: Protocol, step: Step, now: StepState, skipped: frozenset[str]) -> tuple[GateLine, ...]:
    """Return the gates of a step; where the protocol gives no reason for a limit, what its measure means."""
    kind = step_kinds().get(step.kind)
    declared = {} if kind is None else kind.measures.declared()
    measures = measures_of(step, {known.id: known for known in protocol.steps}) or declared
    meanings = {name: sentence(measure.meaning) for name, measure in measures.items() if measure.meaning}
    lines = zip(step.gates, gate_lines(step, now, skipped), strict=True)
    return tuple(replace(line, why=line.why or meanings.get(gate.measure, "")) for gate, line in lines)


def accuracy_of(digest: Digest | None) -> list[AccuracyRow]:
    """Return the accuracy on the control spheres of every source of poses; empty before the evaluation."""
    if digest is None or digest.protocol is None or digest.state is None:
        return []
    return _accuracy(digest.protocol, digest.state)


def _accuracy(protocol: Protocol, state: RunState) -> list[AccuracyRow]:
    rows = evaluated(protocol, state)
    own = own_registration(protocol, state)
    gates = [gate for step in protocol.steps if step.gives == "accuracy" for gate in step.gates]
    most = next((gate.max for gate in gates if gate.measure.endswith(_ERROR)), None)
    out: list[AccuracyRow] = []
    for row in rows:
        error = row.mean_radial_error_mm
        out.append(
            AccuracyRow(
                poses=row.poses,
                error_mm=error,
                reprojection_px=row.mean_reprojection_error_px,
                images="" if row.images is None else str(row.images),
                late=row.late,
                limit="" if most is None else f"at most {most:g} mm",
                within=None if most is None else error <= most,
                own=row.poses == own,
            )
        )
    return out


@router.get(
    "/audit/runs/{run_id}/devices",
    name="audit_devices",
    dependencies=[Depends(requires("read"))],
    response_class=HTMLResponse,
)
def devices_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show devices with versions, clocks, troubles; sessions and software."""
    frame = audit_frame(audit, run_id, "/devices")
    with audit.site.store.database.reading() as connection:
        opened = opened_devices(findings.events_of(connection, run_id, "device_opened", newest=True))
        started = findings.events_of(connection, run_id, "session_started", newest=True)
        troubles = findings.events_of(connection, run_id, "device_trouble", newest=True)
        trouble_count = queries.count_of_kind(connection, run_id, "device_trouble")
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


_READ = [Depends(requires("read"))]


@router.get(
    "/audit/runs/{run_id}/corrections", name="audit_corrections", dependencies=_READ, response_class=HTMLResponse
)
def corrections_page(request: Request, audit: CurrentAudit, run_id: str, page: int = 1) -> Response:
    """Show old and new: corrected values, steps done again, views taken again."""
    frame = audit_frame(audit, run_id, "/corrections")
    digest = audit.digests.get(run_id)
    known = overview.known(digest)
    views = findings.replaced_viewpoints(known) if known else []
    pages = max(1, -(-len(views) // queries.PAGE))
    page = min(max(page, 1), pages)
    shown = views[(page - 1) * queries.PAGE : page * queries.PAGE]
    with audit.site.store.database.reading() as connection:
        values = findings.corrected_values(connection, run_id)
        steps = findings.replaced_steps(connection, run_id, known) if known else []
        seqs = sorted({seq for view in shown for seq in (view.old_seq, view.new_seq) if seq})
        files = queries.artefacts_of_events(connection, run_id, seqs)
        pictures = {file.seq: file for file in reversed(files) if file.ref.is_picture}
        corrected = queries.count_of_kind(connection, run_id, "record_corrected")
    return render(
        request,
        "audit/corrections.html.j2",
        audit=frame,
        progress=digest if isinstance(digest, PartialProgress) else None,
        values=values,
        corrected=corrected,
        steps=steps,
        views=shown,
        view_count=len(views),
        pictures=pictures,
        page=page,
        pages=pages,
        measure_name=measure_name,
        href=lambda number: link(f"{frame.base}/corrections", {"page": number}),
    )


@router.post("/audit/runs/{run_id}/corrections", name="correct", dependencies=[Depends(requires("correct"))])
def correct_value(
    audit: CurrentAudit,
    person: SignedInPerson,
    run_id: str,
    of_seq: Annotated[int, Form(ge=1, le=2**53)],
    field: Annotated[str, Form(min_length=1, max_length=400)],
    new: Annotated[str, Form(max_length=4000)],
    reason: Reason,
) -> Response:
    """Record a correction; the original stays."""
    audit_frame(audit, run_id, "/corrections")
    correct(audit.site.store, run_id, of_seq=of_seq, field=field, new=new, reason=reason, actor=person.account)
    return RedirectResponse(f"/audit/runs/{run_id}/corrections", status_code=303)


@router.get(
    "/audit/runs/{run_id}/signatures", name="audit_signatures", dependencies=_READ, response_class=HTMLResponse
)
def signatures_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show who signed what, and whether the signature is still valid."""
    frame = audit_frame(audit, run_id, "/signatures")
    digest = audit.digests.get(run_id)
    known = overview.known(digest)
    with audit.site.store.database.reading() as connection:
        found = signatures(connection, run_id, known)
    return render(
        request,
        "audit/signatures.html.j2",
        audit=frame,
        signatures=found,
        digest=known,
        progress=digest if isinstance(digest, PartialProgress) else None,
    )


@router.get(
    "/audit/runs/{run_id}/verification", name="audit_verification", dependencies=_READ, response_class=HTMLResponse
)
def verification_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show what the last verification found, or how far the current one is."""
    return render(request, "audit/verification.html.j2", audit=audit_frame(audit, run_id, "/verification"))


@router.post("/audit/runs/{run_id}/verification", name="verify", dependencies=_READ)
def verify_now(
    audit: CurrentAudit, person: SignedInPerson, run_id: str, back: Annotated[Literal["", "exports"], Form()] = ""
) -> Response:
    """Verify the run. It only reads, so everybody who may read may start it."""
    audit_frame(audit, run_id, "/verification")
    audit.verifications.start(run_id, person.account)
    shown = f"/runs/{run_id}/exports" if back else f"/audit/runs/{run_id}/verification"
    return RedirectResponse(shown, status_code=303)


# --- the events of a run and of the site as they were recorded, and its files -------------------------------------


@router.get("/audit/runs/{run_id}/timeline", name="audit_timeline", dependencies=_READ, response_class=HTMLResponse)
def timeline_page(
    request: Request, audit: CurrentAudit, run_id: str, query: Annotated[EventQuery, Query()]
) -> Response:
    """Show the events of a run in order, filtered and searched."""
    frame = audit_frame(audit, run_id, "/timeline")
    return _events(request, audit, run_id, query, "audit/timeline.html.j2", audit=frame)


def _events(
    request: Request,
    here: AuditState,
    chain: str,
    query: EventQuery,
    template: str,
    **context: Any,
) -> Response:
    digest = here.digests.get(chain) if chain != SITE else None
    with here.site.store.database.reading() as connection:
        facets = digest.facets if digest is not None and not isinstance(digest, PartialProgress) else queries.Facets()
        last, _ = queries.head(connection, chain)
        if chain == SITE:
            facets.add(connection, SITE, 0, last)
        counted = facets.matching(query) if facets.kinds else None
        page = queries.events_page(connection, chain, query, after=query.after, before=query.before, counted=counted)
        devices = queries.artefact_facets(connection, chain)["device"]
    address = request.url.path
    return render(
        request,
        template,
        events=page,
        wanted=query,
        facets=facets,
        devices=sorted({*facets.devices, *devices}),
        progress=digest if isinstance(digest, PartialProgress) else None,
        last=last,
        earlier=link(address, {**query.query(), "before": page.before}) if page.before else "",
        later=link(address, {**query.query(), "after": page.after}) if page.after else "",
        **context,
    )


@router.get("/audit/runs/{run_id}/events/{seq}", name="audit_event", dependencies=_READ, response_class=HTMLResponse)
def event_page(request: Request, audit: CurrentAudit, person: SignedInPerson, run_id: str, seq: int) -> Response:
    """Show one event with everything that is recorded of it."""
    frame = audit_frame(audit, run_id, "/timeline")
    return _event(request, audit, run_id, seq, may_correct=person.may("correct"), audit=frame)


def _event(
    request: Request, here: AuditState, chain: str, seq: int, *, may_correct: bool, **context: Any
) -> Response:
    with here.site.store.database.reading() as connection:
        row = queries.one_event(connection, chain, seq)
        last, _ = queries.head(connection, chain)
        brought = queries.artefacts_of_events(connection, chain, [row.seq])
    return render(
        request,
        "audit/event.html.j2",
        event=row,
        last=last,
        computed_sha256=queries.computed_sha256(chain, row),
        brought=brought,
        fields=correctable(row.payload) if may_correct and row.kind != "record_corrected" else [],
        events_at=f"/audit/runs/{chain}/events" if chain != SITE else "/audit/site/events",
        **context,
    )


@router.get("/audit/site", name="audit_site", dependencies=_READ, response_class=HTMLResponse)
def site_page(request: Request, audit: CurrentAudit, query: Annotated[EventQuery, Query()]) -> Response:
    """Show the site's chain: starts of the service, people, keys."""
    with audit.site.store.database.reading() as connection:
        starts = findings.events_of(connection, SITE, "service_started", newest=True)[-5:]
        keys = findings.events_of(connection, SITE, "key_changed", newest=True)
    return _events(
        request,
        audit,
        SITE,
        query,
        "audit/site.html.j2",
        starts=list(reversed(starts)),
        keys=keys,
    )


@router.get("/audit/site/events/{seq}", name="audit_site_event", dependencies=_READ, response_class=HTMLResponse)
def site_event_page(request: Request, audit: CurrentAudit, seq: int) -> Response:
    """Show one event of the site's chain."""
    return _event(request, audit, SITE, seq, may_correct=False)


@router.get("/audit/runs/{run_id}/artefacts", name="audit_artefacts", dependencies=_READ, response_class=HTMLResponse)
def artefacts_page(
    request: Request, audit: CurrentAudit, run_id: str, query: Annotated[ArtefactQuery, Query()]
) -> Response:
    """Show every file of a run."""
    frame = audit_frame(audit, run_id, "/artefacts")
    with audit.site.store.database.reading() as connection:
        found = queries.artefacts_page(connection, run_id, query, page=query.page)
        facets = queries.artefact_facets(connection, run_id)
    return render(
        request,
        "audit/artefacts.html.j2",
        audit=frame,
        found=found,
        wanted=query,
        facets=facets,
        href=lambda number: link(f"{frame.base}/artefacts", {**query.query(), "page": number}),
    )


@router.get(
    "/audit/runs/{run_id}/artefacts/{sha256}", name="audit_artefact", dependencies=_READ, response_class=HTMLResponse
)
def artefact_page(request: Request, audit: CurrentAudit, run_id: str, sha256: str) -> Response:
    """Show one file: what it is, where it came from, and what was made from it."""
    frame = audit_frame(audit, run_id, "/artefacts")
    with audit.site.store.database.reading() as connection:
        found = origin(connection, run_id, sha256)
    return render(request, "audit/artefact.html.j2", audit=frame, origin=found, artefact=found.records[0])


@router.get(
    "/audit/runs/{run_id}/provenance", name="audit_provenance", dependencies=_READ, response_class=HTMLResponse
)
def provenance_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show the provenance graph of a run."""
    frame = audit_frame(audit, run_id, "/provenance")
    graph = audit.graphs.get(run_id)
    known = None if isinstance(graph, PartialProgress) else graph
    return render(
        request,
        "audit/provenance.html.j2",
        audit=frame,
        progress=graph if isinstance(graph, PartialProgress) else None,
        graph=known,
        drawing=draw(known) if known else None,
        term=term,
    )
