"""The auditor's page of all gates of a run: every limit, what was measured against it, and how it was judged."""

from __future__ import annotations

from dataclasses import dataclass

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.background import PartialProgress
from service.audit.overview import first_page
from service.audit.overview.digest import Digest
from service.core.protocol.models import Protocol
from service.core.run.state import RunState
from service.dataset.registrations import evaluated, own_registration
from service.web.audit.frame import CurrentAudit, audit_frame
from service.web.page.rendering import render
from service.web.run.figures import GateLine, gate_lines
from service.web.security.guards import requires

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
    limit: str  # "" where the protocol sets none
    within: bool | None
    own: bool  # the run's own registration: what a data set is exported with


@router.get(
    "/audit/runs/{run_id}/gates",
    name="audit_gates",
    dependencies=[Depends(requires("read"))],
    response_class=HTMLResponse,
)
def gates_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Every gate of every step, in the order of the protocol."""
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    return render(
        request,
        "audit/gates.html.j2",
        audit=audit_frame(audit, run_id, "/gates"),
        progress=digest if isinstance(digest, PartialProgress) else None,
        steps=gates_of(known) if known else [],
    )


def gates_of(digest: Digest) -> list[StepGates]:
    """The steps that have gates."""
    protocol, state = digest.protocol, digest.state
    if protocol is None or state is None:
        return []
    out: list[StepGates] = []
    for step in protocol.steps:
        if not step.gates:
            continue
        now = state.steps[step.id]
        failed = sum(gate.step == step.id and gate.attempt < now.attempt for gate in digest.failed_gates)
        out.append(StepGates(step.id, step.title, now.attempt, gate_lines(step, now, state.skipped), failed))
    return out


def accuracy_of(digest: Digest | None) -> list[AccuracyRow]:
    """The accuracy on the control spheres of every source of poses; empty before the evaluation."""
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
