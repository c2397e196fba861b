"""Shared by the audit's pages: background computations of a data folder, the frame of a run's pages, query fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock
from typing import Annotated
from urllib.parse import urlencode

from fastapi import Depends, FastAPI, Request

from service.audit.background import ChildState, IncrementalResults
from service.audit.filters import ArtefactFilter, EventFilter, RunFilter
from service.audit.overview.digest import Digest, digests
from service.audit.overview.first_page import verified
from service.audit.provenance import Graph, graphs
from service.audit.record import rows
from service.audit.record.rows import RunBasics
from service.audit.verify.verifications import Verification, Verifications
from service.core.records.import_list import imported_sentence
from service.store.records import UnknownRunError
from service.web.site import CurrentSite, Site

_LOCK = Lock()
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


def _audit(request: Request, site: CurrentSite) -> AuditState:
    state = request.app.state
    with _LOCK:
        if not hasattr(state, "audit"):
            state.audit = AuditState(
                site, digests(site.store), graphs(site.store), Verifications(site.data, site.store.clock)
            )
        found: AuditState = state.audit
    return found


def close_audit(app: FastAPI) -> None:
    """End what is still being computed."""
    found: AuditState | None = getattr(app.state, "audit", None)
    if found is not None:
        found.digests.close()
        found.graphs.close()


CurrentAudit = Annotated[AuditState, Depends(_audit)]


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
        found = rows.runs(connection, run_id)
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
