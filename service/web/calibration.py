"""The calibration of a run: coverage, residuals, uncertainty, poses to add, and its certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response
from pydantic import BaseModel

from service.computations.calibration import CALIBRATE, ArmAnswer, HandEye, Intrinsics, Residuals
from service.computations.records import Camera
from service.core.errors import IllegalTransitionError
from service.core.gates import AcceptedGate, depends_on, figure
from service.core.measure_names import measure_name
from service.core.protocol import Step
from service.core.recorded_devices import RecordedIdentity, recorded_report
from service.core.records.base import ArtefactRef
from service.core.records.events import Event
from service.core.records.run_events import (
    DeviceOpened,
    OperatorAction,
    RecordedOptics,
    RecordedView,
    ViewpointCaptured,
)
from service.core.run.state import StepState
from service.followed_run import RunRecord
from service.steps.kinds.calibration import Params
from service.web.charts import DotPlot, HeatMap, VectorField, dots, heat_map, vector_field
from service.web.images import BoardUse, board_use, captures_of, further_cameras_of, recorded_rig_section
from service.web.rendering import render
from service.web.run_frame import RunFrame, gate_word, limit, run_frame
from service.web.security import requires
from service.web.site import CurrentSite, RunId, Site

if TYPE_CHECKING:
    from service.dataset.further_cameras import KnownFurtherCamera
    from service.web.calibration_boards import PoseAdvice

# --- what the page and the certificate show, read from a run ------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ImageRow:
    """A board image and its residuals in each calibration; None where the calibration does not use it."""

    name: str
    rms_px: float | None
    five_fold_px: float | None
    leave_one_out_px: float | None
    residual_mm: float | None
    residual_deg: float | None
    held_out_mm: float | None
    held_out_deg: float | None
    sha256: str  # the photograph's hash
    step: str
    use: BoardUse


@dataclass(frozen=True, slots=True)
class Calibration:
    """The calibration in force, of one step or of two.

    Attributes:
        steps: those that solved something, in order.
        camera: the camera with its distortion.
        intrinsics: the rest that is known about the camera besides its parameters; None: not solved yet.
        hand_eye: the hand-eye calibration; None: not solved yet.
        best: the answer that the registration uses: with the arm's correction where there is one.
        captures: the board images of each step whose images were used: one step's, or first those of the intrinsics
            and last those of the hand-eye calibration.
        artefact: calibration.json of the last step.
        states: the states of all steps of the run.
    """

    steps: tuple[tuple[Step, StepState], ...]
    camera: Camera
    intrinsics: Intrinsics | None
    hand_eye: HandEye | None
    best: HandEye | ArmAnswer | None
    captures: tuple[tuple[RecordedView, ...], ...]
    artefact: ArtefactRef | None
    robots: tuple[str, ...]
    states: Mapping[str, StepState]

    @property
    def last_captures(self) -> tuple[RecordedView, ...]:
        """The board images of the last step whose images were used."""
        return self.captures[-1] if self.captures else ()


@dataclass(frozen=True, slots=True)
class Charts:
    """The charts of the intrinsics."""

    coverage: HeatMap
    residuals: VectorField
    per_image: DotPlot
    sigma_px: HeatMap
    sigma_mm: HeatMap


def calibration_of(log: RunRecord) -> Calibration | None:
    """Return the calibration in force; None before a calibration step has an answer."""
    solved = [
        (step, log.state.steps[step.id])
        for step in log.protocol.steps
        if step.gives == "calibration" and log.state.steps[step.id].result
    ]
    if not solved:
        return None
    answers = [CALIBRATE.read_answer(state.result) for _, state in solved]
    intrinsics = [answer.details.intrinsics for answer in answers if answer.details.intrinsics is not None]
    hand_eyes = [
        (answer.hand_eye, _Robots.model_validate(state.result).robots)
        for answer, (_, state) in zip(answers, solved, strict=True)
        if answer.hand_eye is not None
    ]
    captures = tuple(found for source in _sources(solved) if (found := _board_images(log, source)))
    hand_eye, robots = hand_eyes[-1] if hand_eyes else (None, ())
    files = [ref for ref in solved[-1][1].artefacts if ref.kind == "calibration"]
    return Calibration(
        steps=tuple(solved),
        camera=answers[-1].camera,
        intrinsics=intrinsics[-1] if intrinsics else None,
        hand_eye=hand_eye,
        best=None if hand_eye is None else hand_eye.best,
        captures=captures,
        artefact=files[-1] if files else None,
        robots=robots,
        states=log.state.steps,
    )


class _Robots(BaseModel):
    """The devices whose flange carried the camera, in the result of a calibration step."""

    robots: tuple[str, ...] = ()


def _sources(solved: Sequence[tuple[Step, StepState]]) -> list[str]:
    """Return the steps whose board images were used, each once: a calibration's own, or those of an earlier step."""
    return list(dict.fromkeys(step.params_as(Params).images_of or step.id for step, _ in solved))


def _board_images(log: RunRecord, source: str) -> tuple[RecordedView, ...]:
    """Return the valid board images of a step."""
    return tuple(capture.payload for capture in captures_of(log, source) if capture.replaced is None)


def charts_of(calibration: Calibration) -> Charts | None:
    """Return the charts of the intrinsics; None if they are not solved."""
    record = calibration.intrinsics
    if record is None or record.coverage is None or record.residuals is None or record.uncertainty is None:
        return None
    size = calibration.camera.width, calibration.camera.height
    uncertainty, validation = record.uncertainty, record.cross_validation
    per_image: list[tuple[str, Sequence[float | None]]] = [("in the fit", record.per_view_rms_px)]
    if validation is not None:
        per_image.append(("held out, five folds", validation.five_fold_view_px))
        per_image.append(("held out, one at a time", validation.leave_one_out_view_px))
    gate = _limit(calibration, "rms_px")
    return Charts(
        coverage=heat_map(record.coverage.corners, size, title="Board corners in each cell of the image"),
        residuals=vector_field(
            record.residuals.mean_px,
            record.residuals.corners,
            size,
            title="Mean residual of the corners in each cell",
        ),
        per_image=dots(
            record.images,
            per_image,
            title="Residual of each image, rms, px",
            limit=gate,
            limit_text="" if gate is None else f"limit of the whole: {gate:g} px",
        ),
        sigma_px=heat_map(
            uncertainty.sigma_px, size, title="Uncertainty of a projected point, px", unit="px", digits=3,
            logarithmic=True, every=4,
        ),
        sigma_mm=heat_map(
            uncertainty.sigma_mm, size,
            title=f"Uncertainty at {uncertainty.distance_m:.2f} m, where the specimen lies, mm",
            unit="mm", digits=4, logarithmic=True, every=4,
        ),
    )  # fmt: skip


def hand_eye_chart(calibration: Calibration) -> DotPlot | None:
    """Return how far each image places the board from its place by the others; None without a hand-eye."""
    best = calibration.best
    if best is None:
        return None
    residuals = best.residuals
    names = list(residuals.mm)
    values: list[tuple[str, Sequence[float | None]]] = [
        ("in the fit", [residuals.mm[name] for name in names]),
        ("held out", [residuals.held_out_mm[name] for name in names]),
    ]
    gate = _limit(calibration, "hand_eye_held_out_mm")
    limit_text = "" if gate is None else f"limit of the median held out: {gate:g} mm"
    return dots(names, values, title="Board placed by each image, error, mm", limit=gate, limit_text=limit_text)


def image_rows(calibration: Calibration) -> list[ImageRow]:
    """Return every board image with its residuals, unused images first.

    A view's name is unique within its step alone: residuals of the intrinsics are those of the first step's images,
    residuals of the hand-eye calibration those of the last step's.
    """
    record = calibration.intrinsics or Intrinsics()
    validation = record.cross_validation

    def by_image(values: Sequence[float | None]) -> dict[str, float | None]:
        return dict(zip(record.images, values, strict=False))

    rms = by_image(record.per_view_rms_px)
    five = by_image(() if validation is None else validation.five_fold_view_px)
    one = by_image(() if validation is None else validation.leave_one_out_view_px)
    none = Residuals(held_out_mm={}, held_out_deg={})
    residuals = none if calibration.best is None else calibration.best.residuals
    rows: list[ImageRow] = []
    for place, captures in enumerate(calibration.captures):
        first, last = place == 0, place == len(calibration.captures) - 1
        placed = residuals if last else none
        for capture in captures:
            name = capture.viewpoint
            rows.append(
                ImageRow(
                    name=name,
                    rms_px=rms.get(name) if first else None,
                    five_fold_px=five.get(name) if first else None,
                    leave_one_out_px=one.get(name) if first else None,
                    residual_mm=placed.mm.get(name),
                    residual_deg=placed.deg.get(name),
                    held_out_mm=placed.held_out_mm.get(name),
                    held_out_deg=placed.held_out_deg.get(name),
                    sha256=capture.artefacts[0].sha256,
                    step=capture.step,
                    use=board_use(calibration.states[capture.step], capture),
                )
            )
    return sorted(rows, key=lambda row: row.use.used is not False)  # stable: what is not used first


def held_out_mm(calibration: Calibration) -> tuple[float, float] | None:
    """Return the median and maximum error of the board's position, mm, by images that the hand-eye did not use."""
    if calibration.best is None:
        return None
    values = list(calibration.best.residuals.held_out_mm.values())
    return median(values), max(values)


def _limit(calibration: Calibration, measure: str) -> float | None:
    gates = [gate for step, _ in calibration.steps for gate in step.gates if gate.measure == measure]
    return gates[-1].max if gates else None


# --- certificate --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StepSignature:
    """The signature of a calibration step: who signed, when, and with which meaning."""

    step: str
    who: str
    at_utc: str
    meaning: str


@dataclass(frozen=True, slots=True)
class LaterCheck:
    """A later step that compared its images with the calibration."""

    step: str
    images: int
    departing: int


@dataclass(frozen=True, slots=True)
class Certificate:
    """The statements of a certificate in addition to the figures.

    Attributes:
        camera: EXIF of the first board image: settings, lens, body.
        robots: name in the rig, model and serial number of each whose flange carried the camera.
        passed: number, hash and time of the event by which the last step passed; None: it has not.
        checks: the checks of later images.
        stops: troubles of the robot or camera since.
    """

    camera: RecordedOptics
    camera_model: str
    robots: tuple[tuple[str, str, str], ...]
    environment: Mapping[str, float]
    operator: str
    passed: tuple[int, str, str] | None
    signatures: tuple[StepSignature, ...]
    checks: tuple[LaterCheck, ...]
    stops: tuple[str, ...]


def _later_checks(log: RunRecord, calibrated: set[str]) -> list[LaterCheck]:
    """Return the steps outside the calibration that compared their images with it."""
    steps = [(step, log.state.steps[step.id]) for step in log.protocol.steps if step.id not in calibrated]
    return [
        LaterCheck(step.title, len(done.captured), int(done.measures["optics_departures"]))
        for step, done in steps
        if "optics_departures" in done.measures
    ]


def certificate_of(log: RunRecord, calibration: Calibration) -> Certificate:
    """Return the certificate, from the recorded events alone."""
    state, (_, there) = log.state, calibration.steps[-1]
    first = calibration.last_captures[0] if calibration.captures else None
    ids = {step.id for step, _ in calibration.steps}
    signatures = [
        StepSignature(event.payload.step or "", event.actor, event.at_utc, event.payload.meaning)
        for event in log.events
        if isinstance(event.payload, OperatorAction)
        and event.payload.action == "sign"
        and event.payload.step in ids
        and state.steps[event.payload.step].signed
    ]
    passed = None
    if there.passed_seq:
        passed = (there.passed_seq, there.passed_sha256, log.events[there.passed_seq - 1].at_utc)
    since = there.passed_seq or state.seq
    stops = [f"{t.device}: {t.message} (event {t.seq})" for t in state.troubles if t.seq > since]
    known = {
        event.payload.device: recorded_report(event.payload.report).identity
        for event in log.events
        if isinstance(event.payload, DeviceOpened)
    }
    models = [identity.model for identity in known.values() if identity.kind == "camera"]
    stated = RecordedOptics() if first is None else first.optics
    robots = [(name, known.get(name, RecordedIdentity())) for name in calibration.robots]
    return Certificate(
        stated,
        models[-1] if models else stated.model,
        tuple((name, about.model, about.serial) for name, about in robots),
        {} if first is None else first.environment,
        state.operator,
        passed,
        tuple({s.step: s for s in signatures}.values()),
        tuple(_later_checks(log, ids)),
        tuple(stops),
    )


# --- the pages ----------------------------------------------------------------------------------------------------

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
def calibration_page(request: Request, site: CurrentSite, run_id: RunId) -> HTMLResponse:
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
    from service.web.calibration_boards import board_plan_of  # noqa: PLC0415

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
    from service.web.calibration_boards import advised_poses, empty_regions  # noqa: PLC0415

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
