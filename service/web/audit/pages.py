"""The auditor's view: runs, first page of a run, timeline, artefacts, provenance, corrections, the site's chain."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from service.audit.background.incremental import Progress
from service.audit.overview import findings, first_page
from service.audit.overview.corrections import correct, correctable
from service.audit.overview.devices import bodies_of_run
from service.audit.overview.digest import Digest
from service.audit.overview.first_page import GROUPS, ListedRun, RunFilter
from service.audit.overview.shots import failed_exposures_of, shots_of, together
from service.audit.provenance.drawing import draw
from service.audit.provenance.graph import origin
from service.audit.record import artefact_queries, queries
from service.audit.record.queries import EventFilter
from service.audit.runs.search import RunWanted, find_runs
from service.run_record import results_to_come
from service.steps.time_left import Left
from service.store.records import SITE
from service.web.audit.frame import Audit, Auditing, audit_frame, close_audit, cut, link
from service.web.audit.gates import accuracy_of
from service.web.audit.protocol_identity import protocol_identity
from service.web.page.rendering import TEMPLATES, render
from service.web.security.guards import Signed, requires


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncGenerator[None]:
    """Templates are read before anybody asks: the first page of a run answers at once too."""
    for name in TEMPLATES.list_templates(filter_func=lambda name: name.startswith(("audit/", "evidence/"))):
        TEMPLATES.get_template(name)
    yield
    close_audit(app)


router = APIRouter(tags=["audit"], lifespan=_lifespan)
_RUNS_A_PAGE = 25
_FIRST = 25  # of a list on the first page
_READ = [Depends(requires("read"))]

Text = Annotated[str, Query(description="as shown; cut after 200 characters")]
Number = Annotated[int, Query()]


@router.get("/audit", name="audit", dependencies=_READ, response_class=HTMLResponse)
def runs_page(
    request: Request,
    audit: Auditing,
    since: Text = "",
    until: Text = "",
    protocol: Text = "",
    person: Text = "",
    status: Text = "",
    simulated: Text = "",
    deviations: Text = "",
    unverified: Text = "",
    q: Text = "",
    page: Number = 1,
) -> Response:
    """The runs, newest first."""
    wanted = RunFilter(
        since=cut(since),
        until=cut(until),
        protocol=cut(protocol),
        person=cut(person),
        status=cut(status),
        simulated=cut(simulated),
        deviations=bool(deviations),
        unverified=bool(unverified),
        q=cut(q),
    )
    with audit.site.store.database.reading() as connection:
        every = queries.runs(connection)
    said = {run.run_id for run in find_runs(audit.site.store, RunWanted(q=wanted.q))}
    listed = [_listed(audit, basics) for basics in every]
    found = [run for run in listed if run.basics.run_id in said and first_page.matches(run, wanted)]
    pages = max(1, -(-len(found) // _RUNS_A_PAGE))
    page = min(max(page, 1), pages)
    return render(
        request,
        "audit/runs.html.j2",
        runs=found[(page - 1) * _RUNS_A_PAGE : page * _RUNS_A_PAGE],
        count=len(found),
        every=len(every),
        unknown=sum(run.digest is None for run in found),
        protocols=sorted({run.protocol for run in every if run.protocol}),
        people=first_page.people_of(listed),
        wanted=wanted,
        page=page,
        pages=pages,
        href=lambda number: link("/audit", {**wanted.query(), "page": number}),
    )


def _listed(audit: Audit, basics: queries.RunBasics) -> ListedRun:
    digest = audit.digests.at(basics.run_id, basics.head_seq, basics.head_sha256)
    if isinstance(digest, Progress):
        audit.digests.warm(basics.run_id)
    return ListedRun(basics, first_page.known(digest), audit.verifications.last(basics.run_id))


@router.get("/audit/runs/{run_id}", name="audit_run", dependencies=_READ, response_class=HTMLResponse)
def run_page(request: Request, audit: Auditing, run_id: str) -> Response:
    """The first page of a run: deviations first."""
    frame = audit_frame(audit, run_id, "")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    with audit.site.store.database.reading() as connection:
        root = queries.read_rows(connection, run_id, [1], whole=True)
        corrected = queries.count_of_kind(connection, run_id, "record_corrected")
        devices = findings.events_of(connection, run_id, "device_opened", newest=True)
        sessions = findings.events_of(connection, run_id, "session_started", newest=True)
        exports = findings.events_of(connection, run_id, "evidence_exported", newest=True)
        signatures = findings.signatures(connection, run_id, known)
        failures = failed_exposures_of(connection, run_id)
        bodies = bodies_of_run(connection, run_id, devices)
    listed = first_page.findings(known) if known else []
    run = frame.run
    return render(
        request,
        "audit/run.html.j2",
        identity=protocol_identity(audit.site.store, run_id, run.protocol, run.version),
        audit=frame,
        digest=known,
        progress=digest if isinstance(digest, Progress) else None,
        counts=first_page.counts(known) if known else {},
        groups=GROUPS,
        group_name=first_page.group_name,
        listed=listed[:_FIRST],
        more=len(listed) - _FIRST,
        accuracy=accuracy_of(known),
        dataset_exported=any(row.payload.get("what") == "dataset" for row in exports),
        root=root[0] if root else None,
        corrected=corrected,
        shots=shots_of(known, failures),
        together=together,
        bodies=bodies,
        devices={row.payload.get("device"): row for row in devices},
        session=sessions[-1] if sessions else None,
        sessions=len(sessions),
        exports=exports,
        releases=[s for s in signatures if not s.step],
        signatures=signatures,
        late=known.late if known else [],
        to_come=[left.text for left in _to_come(audit, run_id, known)],
    )


def _to_come(audit: Audit, run_id: str, digest: Digest | None) -> list[Left]:
    """Results that are still being computed, or will never come. Read whole only where there may be any."""
    failed = digest is not None and digest.facets.kinds.get("job_failed", 0) > 0
    if digest is None or digest.problem or not (failed or audit.site.store.open_jobs(run_id)):
        return []
    return results_to_come(audit.site.run(run_id))


@router.get(
    "/audit/runs/{run_id}/deviations", name="audit_deviations", dependencies=_READ, response_class=HTMLResponse
)
def deviations_page(request: Request, audit: Auditing, run_id: str, group: Text = "", page: Number = 1) -> Response:
    """All deviations, or those of one group."""
    frame = audit_frame(audit, run_id, "")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    group = group if group in GROUPS else ""
    listed = first_page.findings(known, group) if known else []
    pages = max(1, -(-len(listed) // queries.PAGE))
    page = min(max(page, 1), pages)
    return render(
        request,
        "audit/deviations.html.j2",
        audit=frame,
        progress=digest if isinstance(digest, Progress) else None,
        groups=GROUPS,
        counts=first_page.counts(known) if known else {},
        group=group,
        listed=listed[(page - 1) * queries.PAGE : page * queries.PAGE],
        count=len(listed),
        page=page,
        pages=pages,
        href=lambda number: link(f"{frame.base}/deviations", {"group": group, "page": number}),
    )


# --- events ---------------------------------------------------------------------------------------------------


@router.get("/audit/runs/{run_id}/timeline", name="audit_timeline", dependencies=_READ, response_class=HTMLResponse)
def timeline_page(
    request: Request,
    audit: Auditing,
    run_id: str,
    step: Text = "",
    device: Text = "",
    person: Text = "",
    kind: Text = "",
    q: Text = "",
    after: Number = 0,
    before: Number = 0,
) -> Response:
    """The events of a run in order, filtered and searched."""
    frame = audit_frame(audit, run_id, "/timeline")
    wanted = EventFilter(cut(step), cut(device), cut(person), cut(kind), cut(q))
    return _events(request, audit, run_id, wanted, after, before, "evidence/timeline.html.j2", audit=frame)


def _events(
    request: Request,
    here: Audit,
    chain: str,
    wanted: EventFilter,
    after: int,
    before: int,
    template: str,
    **context: Any,
) -> Response:
    digest = here.digests.get(chain) if chain != SITE else None
    with here.site.store.database.reading() as connection:
        facets = digest.facets if digest is not None and not isinstance(digest, Progress) else queries.Facets()
        last, _ = queries.head(connection, chain)
        if chain == SITE:
            facets.add(connection, SITE, 0, last)
        counted = facets.matching(wanted) if facets.kinds else None
        page = queries.events_page(connection, chain, wanted, after=after, before=before, counted=counted)
        devices = artefact_queries.artefact_facets(connection, chain)["device"]
    address = request.url.path
    return render(
        request,
        template,
        events=page,
        wanted=wanted,
        facets=facets,
        devices=sorted({*facets.devices, *devices}),
        progress=digest if isinstance(digest, Progress) else None,
        last=last,
        earlier=link(address, {**wanted.query(), "before": page.before}) if page.before else "",
        later=link(address, {**wanted.query(), "after": page.after}) if page.after else "",
        **context,
    )


@router.get("/audit/runs/{run_id}/events/{seq}", name="audit_event", dependencies=_READ, response_class=HTMLResponse)
def event_page(request: Request, audit: Auditing, person: Signed, run_id: str, seq: int) -> Response:
    """One event with everything that is recorded of it."""
    frame = audit_frame(audit, run_id, "/timeline")
    return _event(request, audit, run_id, seq, may_correct=person.may("correct"), audit=frame)


def _event(request: Request, here: Audit, chain: str, seq: int, *, may_correct: bool, **context: Any) -> Response:
    with here.site.store.database.reading() as connection:
        row = queries.one_event(connection, chain, seq)
        last, _ = queries.head(connection, chain)
        brought = artefact_queries.artefacts_of_events(connection, chain, [row.seq])
    return render(
        request,
        "evidence/event.html.j2",
        event=row,
        last=last,
        computed_sha256=queries.computed_sha256(chain, row),
        brought=brought,
        fields=correctable(row.payload) if may_correct and row.kind != "record_corrected" else [],
        events_at=f"/audit/runs/{chain}/events" if chain != SITE else "/audit/site/events",
        **context,
    )


# --- artefacts -------------------------------------------------------------------------------------------------


@router.get("/audit/runs/{run_id}/artefacts", name="audit_artefacts", dependencies=_READ, response_class=HTMLResponse)
def artefacts_page(
    request: Request,
    audit: Auditing,
    run_id: str,
    kind: Text = "",
    step: Text = "",
    device: Text = "",
    viewpoint: Text = "",
    q: Text = "",
    page: Number = 1,
) -> Response:
    """Every file of a run."""
    frame = audit_frame(audit, run_id, "/artefacts")
    wanted = artefact_queries.ArtefactFilter(cut(kind), cut(step), cut(device), cut(viewpoint), cut(q))
    with audit.site.store.database.reading() as connection:
        found = artefact_queries.artefacts_page(connection, run_id, wanted, page=page)
        facets = artefact_queries.artefact_facets(connection, run_id)
    return render(
        request,
        "evidence/artefacts.html.j2",
        audit=frame,
        found=found,
        wanted=wanted,
        facets=facets,
        href=lambda number: link(f"{frame.base}/artefacts", {**wanted.query(), "page": number}),
    )


@router.get(
    "/audit/runs/{run_id}/artefacts/{sha256}", name="audit_artefact", dependencies=_READ, response_class=HTMLResponse
)
def artefact_page(request: Request, audit: Auditing, run_id: str, sha256: str) -> Response:
    """One file: what it is, where it came from, what was made of it."""
    frame = audit_frame(audit, run_id, "/artefacts")
    with audit.site.store.database.reading() as connection:
        found = origin(connection, run_id, sha256)
    return render(request, "evidence/artefact.html.j2", audit=frame, origin=found, artefact=found.records[0])


@router.get(
    "/audit/runs/{run_id}/provenance", name="audit_provenance", dependencies=_READ, response_class=HTMLResponse
)
def provenance_page(request: Request, audit: Auditing, run_id: str) -> Response:
    """What came from what."""
    frame = audit_frame(audit, run_id, "/provenance")
    graph = audit.graphs.get(run_id)
    known = None if isinstance(graph, Progress) else graph
    return render(
        request,
        "evidence/provenance.html.j2",
        audit=frame,
        progress=graph if isinstance(graph, Progress) else None,
        graph=known,
        drawing=draw(known) if known else None,
    )


# --- findings --------------------------------------------------------------------------------------------------


@router.get(
    "/audit/runs/{run_id}/corrections", name="audit_corrections", dependencies=_READ, response_class=HTMLResponse
)
def corrections_page(request: Request, audit: Auditing, run_id: str, page: Number = 1) -> Response:
    """Old and new: corrected values, steps done again, views taken again."""
    frame = audit_frame(audit, run_id, "/corrections")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    views = findings.replaced_viewpoints(known) if known else []
    pages = max(1, -(-len(views) // queries.PAGE))
    page = min(max(page, 1), pages)
    shown = views[(page - 1) * queries.PAGE : page * queries.PAGE]
    with audit.site.store.database.reading() as connection:
        values = findings.corrected_values(connection, run_id)
        steps = findings.replaced_steps(connection, run_id, known) if known else []
        seqs = sorted({seq for view in shown for seq in (view.old_seq, view.new_seq) if seq})
        pictures = {
            row.seq: row
            for row in reversed(artefact_queries.artefacts_of_events(connection, run_id, seqs))
            if row.is_picture
        }
        corrected = queries.count_of_kind(connection, run_id, "record_corrected")
    return render(
        request,
        "audit/corrections.html.j2",
        audit=frame,
        progress=digest if isinstance(digest, Progress) else None,
        values=values,
        corrected=corrected,
        steps=steps,
        views=shown,
        view_count=len(views),
        pictures=pictures,
        page=page,
        pages=pages,
        href=lambda number: link(f"{frame.base}/corrections", {"page": number}),
    )


@router.post("/audit/runs/{run_id}/corrections", name="correct", dependencies=[Depends(requires("correct"))])
def correct_value(
    audit: Auditing,
    person: Signed,
    run_id: str,
    of_seq: Annotated[int, Form(ge=1, le=2**53)],
    field: Annotated[str, Form(min_length=1, max_length=400)],
    new: Annotated[str, Form(max_length=4000)],
    reason: Annotated[str, Form(min_length=1, max_length=2000)],
) -> Response:
    """Record a correction; the original stays."""
    audit_frame(audit, run_id, "/corrections")
    correct(audit.site.store, run_id, of_seq=of_seq, field=field, new=new, reason=reason, actor=person.account)
    return RedirectResponse(f"/audit/runs/{run_id}/corrections", status_code=303)


@router.get(
    "/audit/runs/{run_id}/signatures", name="audit_signatures", dependencies=_READ, response_class=HTMLResponse
)
def signatures_page(request: Request, audit: Auditing, run_id: str) -> Response:
    """Who signed what, and whether it still stands."""
    frame = audit_frame(audit, run_id, "/signatures")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    with audit.site.store.database.reading() as connection:
        found = findings.signatures(connection, run_id, known)
    return render(
        request,
        "audit/signatures.html.j2",
        audit=frame,
        signatures=found,
        digest=known,
        progress=digest if isinstance(digest, Progress) else None,
    )


# --- verification -----------------------------------------------------------------------------------------------


@router.get(
    "/audit/runs/{run_id}/verification", name="audit_verification", dependencies=_READ, response_class=HTMLResponse
)
def verification_page(request: Request, audit: Auditing, run_id: str) -> Response:
    """What the last verification found, or how far the present one is."""
    return render(request, "audit/verification.html.j2", audit=audit_frame(audit, run_id, "/verification"))


@router.post("/audit/runs/{run_id}/verification", name="verify", dependencies=_READ)
def verify_now(audit: Auditing, person: Signed, run_id: str) -> Response:
    """Verify the run; it only reads, so whoever may read may ask for it."""
    audit_frame(audit, run_id, "/verification")
    audit.verifications.start(run_id, person.account)
    return RedirectResponse(f"/audit/runs/{run_id}/verification", status_code=303)


# --- the site -----------------------------------------------------------------------------------------------------


@router.get("/audit/site", name="audit_site", dependencies=_READ, response_class=HTMLResponse)
def site_page(
    request: Request,
    audit: Auditing,
    person: Text = "",
    kind: Text = "",
    q: Text = "",
    after: Number = 0,
    before: Number = 0,
) -> Response:
    """The site's chain: starts of the service, people, keys."""
    wanted = EventFilter(person=cut(person), kind=cut(kind), q=cut(q))
    with audit.site.store.database.reading() as connection:
        starts = findings.events_of(connection, SITE, "service_started", newest=True)[-5:]
        keys = findings.events_of(connection, SITE, "key_changed", newest=True)
    return _events(
        request,
        audit,
        SITE,
        wanted,
        after,
        before,
        "evidence/site.html.j2",
        starts=list(reversed(starts)),
        keys=keys,
    )


@router.get("/audit/site/events/{seq}", name="audit_site_event", dependencies=_READ, response_class=HTMLResponse)
def site_event_page(request: Request, audit: Auditing, seq: int) -> Response:
    """One event of the site's chain."""
    return _event(request, audit, SITE, seq, may_correct=False)
