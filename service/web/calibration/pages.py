"""The calibration: coverage, residuals, uncertainty, poses to add, certificate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response

from service.core.errors import IllegalTransitionError
from service.core.gates import AcceptedGate, depends_on, figure
from service.core.measure_names import measure_name
from service.core.records.events import Event
from service.core.records.run_events import ViewpointCaptured
from service.followed_run import RunRecord
from service.web.calibration.view import (
    Calibration,
    Certificate,
    Charts,
    ImageRow,
    calibration_of,
    certificate_of,
    charts_of,
    hand_eye_chart,
    held_out_mm,
    image_rows,
)
from service.web.page.charts import DotPlot
from service.web.page.rendering import render
from service.web.page.run_frame import RunFrame, gate_word, limit, run_frame
from service.web.record.images import further_cameras_of, recorded_rig_section
from service.web.security import requires
from service.web.site import CurrentSite, RunId, Site

if TYPE_CHECKING:
    from service.dataset.further_cameras import KnownFurtherCamera
    from service.web.calibration.boards import PoseAdvice

router = APIRouter(tags=["calibration"])


@dataclass(frozen=True, slots=True)
class ShownCalibration:
    """The data that both the page of a calibration and its certificate show.

    Attributes:
        run_id: the run's identifier.
        found: the calibration in force.
        held_out: median and maximum error of the board's position by images that were not used, mm.
        depends: acceptances on which the calibration depends.
    """

    run_id: str
    found: Calibration
    held_out: tuple[float, float] | None
    depends: list[AcceptedGate]


@dataclass(frozen=True, slots=True)
class CalibrationPage(ShownCalibration):
    """The data that the page of a calibration shows.

    Attributes:
        charts: the charts of the intrinsics; None if they are not solved.
        hand_eye_chart: the chart of the hand-eye calibration; None without one.
        images: the images of the board, with their residuals.
        regions: parts of the image without corners: name, empty cells, all cells.
        poses: the poses of the board that would help most.
        further: cameras of the rig that are calibrated by themselves.
    """

    charts: Charts | None
    hand_eye_chart: DotPlot | None
    images: list[ImageRow]
    regions: list[tuple[str, int, int]]
    poses: tuple[PoseAdvice, ...]
    further: tuple[KnownFurtherCamera, ...]


@dataclass(frozen=True, slots=True)
class CertificatePage(ShownCalibration):
    """The data that the certificate shows; `head` is the last event of the run."""

    certificate: Certificate
    simulated: bool
    head: Event


@router.get("/runs/{run_id}/calibration", name="calibration", dependencies=[Depends(requires("read"))])
def calibration(request: Request, site: CurrentSite, run_id: RunId) -> HTMLResponse:
    """Show whether the calibration is good, in pixels and in millimetres, and what would make it better."""
    log = site.run(run_id)
    found = calibration_of(log)
    frame = run_frame(site, run_id)
    if found is None:
        return render(request, "calibration/calibration.html.j2", run_id=run_id, found=None, frame=frame)
    regions, poses = _advice(site, log, found)
    shown = CalibrationPage(
        run_id=run_id,
        found=found,
        charts=charts_of(found),
        hand_eye_chart=hand_eye_chart(found),
        images=image_rows(found),
        held_out=held_out_mm(found),
        depends=_depends(log, found),
        regions=regions,
        poses=poses,
        further=further_cameras_of(log),
    )
    return _rendered(request, "calibration/calibration.html.j2", shown, frame)


@router.get("/runs/{run_id}/board-plan.svg", name="board_plan", dependencies=[Depends(requires("read"))])
def board_plan(site: CurrentSite, run_id: RunId, step: Annotated[str, Query(max_length=64)]) -> Response:
    """Show the planned board images of a calibration step: corners over the image, and the camera's places."""
    # The planning of poses brings scipy, which the start of the service does not wait for.
    from service.web.calibration.boards import board_plan_of  # noqa: PLC0415

    headers = {"Cache-Control": "private, no-cache"}
    return Response(board_plan_of(site.run(run_id), step, site.data), media_type="image/svg+xml", headers=headers)


@router.get(
    "/runs/{run_id}/calibration/certificate",
    name="calibration_certificate",
    dependencies=[Depends(requires("read"))],
)
def certificate(request: Request, site: CurrentSite, run_id: RunId) -> HTMLResponse:
    """Show the calibration on a page to print."""
    log = site.run(run_id)
    found = calibration_of(log)
    if found is None:
        raise IllegalTransitionError(
            "there is no calibration to certify yet", where=run_id, remedy="Finish the calibration step first"
        )
    shown = CertificatePage(
        run_id=run_id,
        found=found,
        held_out=held_out_mm(found),
        depends=_depends(log, found),
        certificate=certificate_of(log, found),
        simulated=log.state.simulated,
        head=log.events[-1],
    )
    return _rendered(request, "calibration/certificate.html.j2", shown, run_frame(site, run_id))


def _rendered(request: Request, template: str, page: ShownCalibration, frame: RunFrame) -> HTMLResponse:
    """Return a page with the words for measures and gates."""
    return render(
        request,
        template,
        page,
        frame=frame,
        measure_name=measure_name,
        figure=figure,
        limit=limit,
        gate_word=gate_word,
    )


def _depends(log: RunRecord, found: Calibration) -> list[AcceptedGate]:
    gates = (gate for step, _ in found.steps for gate in depends_on(log.protocol, log.state, step.id))
    return list(dict.fromkeys(gates))


def _advice(
    site: Site, log: RunRecord, found: Calibration
) -> tuple[list[tuple[str, int, int]], tuple[PoseAdvice, ...]]:
    """Return parts of the image without corners, and board poses worth taking."""
    # The planning of poses brings scipy, which the start of the service does not wait for.
    from service.web.calibration.boards import advised_poses, empty_regions  # noqa: PLC0415

    coverage = None if found.intrinsics is None else found.intrinsics.coverage
    regions = [] if coverage is None else empty_regions(coverage.corners)
    board = log.protocol.board
    if found.hand_eye is None or found.best is None or board is None or found.artefact is None:
        return regions, ()
    used = set(found.best.residuals.mm)
    poses = advised_poses(
        found.hand_eye,
        found.camera,
        [c for c in found.last_captures if isinstance(c, ViewpointCaptured) and c.viewpoint in used],
        board,
        recorded_rig_section(log).collision.arm or "",
        site.data,
        found.artefact.sha256,
    )
    return regions, poses
