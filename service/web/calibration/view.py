"""What the calibration page and its certificate show, read from a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from service.core.protocol.models import Step
from service.core.records.events import ArtefactRef, DeviceOpened, OperatorAction, View
from service.core.run.state import StepState
from service.run_record import RunRecord
from service.web.page.charts import Dots, HeatMap, VectorField, dots, heat_map, vector_field
from service.web.record.board_images import BoardUse, board_use
from service.web.record.images import captures_of


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
    sha256: str  # of the photograph
    step: str
    use: BoardUse


@dataclass(frozen=True, slots=True)
class Calibration:
    """The calibration in force, of one step or of two.

    Attributes:
        steps: those that solved something, in order.
        intrinsics: `intrinsics_record`; None: not solved yet.
        camera: fx … k6, width, height.
        hand_eye: `hand_eye_record`; None: not solved yet.
        best: the answer that the registration uses: the arm's correction where there is one, else `hand_eye`.
        captures: the board images, of the step whose images were used.
        artefact: calibration.json of the last step.
        states: of all steps of the run.
    """

    steps: tuple[tuple[Step, StepState], ...]
    camera: Mapping[str, float]
    intrinsics: Mapping[str, Any] | None
    hand_eye: Mapping[str, Any] | None
    best: Mapping[str, Any] | None
    captures: tuple[View, ...]
    artefact: ArtefactRef | None
    robots: tuple[str, ...]
    states: Mapping[str, StepState]


@dataclass(frozen=True, slots=True)
class Charts:
    """The charts of the intrinsics."""

    coverage: HeatMap
    residuals: VectorField
    per_image: Dots
    sigma_px: HeatMap
    sigma_mm: HeatMap


def calibration_of(log: RunRecord) -> Calibration | None:
    """The calibration in force; None before a calibration step has an answer."""
    solved = [
        (step, log.state.steps[step.id])
        for step in log.protocol.steps
        if step.kind == "calibration" and log.state.steps[step.id].result
    ]
    if not solved:
        return None
    intrinsics: Mapping[str, Any] | None = None
    hand_eye: Mapping[str, Any] | None = None
    camera: Mapping[str, float] = {}
    captures: list[View] = []
    robots: tuple[str, ...] = ()
    for step, state in solved:
        details: Mapping[str, Any] = state.result["details"]
        camera = state.result["camera"]
        source = step.params.model_dump().get("images_of") or step.id
        mine = [c.payload for c in captures_of(log, source) if c.replaced is None]
        captures = mine or captures
        if details.get("intrinsics"):
            intrinsics = details["intrinsics"]
        if state.result.get("hand_eye"):
            hand_eye, robots = state.result["hand_eye"], tuple(state.result.get("robots", ()))
    best = None if hand_eye is None else hand_eye["arm_correction"] or hand_eye
    files = [ref for ref in solved[-1][1].artefacts if ref.kind == "calibration"]
    return Calibration(
        tuple(solved), camera, intrinsics, hand_eye, best, tuple(captures), files[-1] if files else None, robots,
        log.state.steps,
    )  # fmt: skip


def charts_of(calibration: Calibration) -> Charts | None:
    """The charts of the intrinsics; None if they are not solved."""
    record = calibration.intrinsics
    if record is None:
        return None
    size = int(calibration.camera["width"]), int(calibration.camera["height"])
    uncertainty = record["uncertainty"]
    validation: Mapping[str, Any] = record["cross_validation"] or {}
    per_image: list[tuple[str, Sequence[float | None]]] = [("in the fit", record["per_view_rms_px"])]
    if validation:
        per_image.append(("held out, five folds", validation["five_fold_view_px"]))
        per_image.append(("held out, one at a time", validation["leave_one_out_view_px"]))
    gate = _limit(calibration, "rms_px")
    return Charts(
        coverage=heat_map(record["coverage"]["corners"], size, title="Board corners in each cell of the image"),
        residuals=vector_field(
            record["residuals"]["mean_px"],
            record["residuals"]["corners"],
            size,
            title="Mean residual of the corners in each cell",
        ),
        per_image=dots(
            record["images"],
            per_image,
            title="Residual of each image, rms, px",
            limit=gate,
            limit_text="" if gate is None else f"limit of the whole: {gate:g} px",
        ),
        sigma_px=heat_map(
            uncertainty["sigma_px"], size, title="Uncertainty of a projected point, px", unit="px", digits=3,
            logarithmic=True, every=4,
        ),
        sigma_mm=heat_map(
            uncertainty["sigma_mm"], size,
            title=f"Uncertainty at {uncertainty['distance_m']:.2f} m, where the specimen lies, mm",
            unit="mm", digits=4, logarithmic=True, every=4,
        ),
    )  # fmt: skip


def hand_eye_chart(calibration: Calibration) -> Dots | None:
    """Distance of the board as each image places it from its place by the others; None without a hand-eye."""
    best = calibration.best
    if best is None:
        return None
    names = list(best["residuals"]["mm"])
    values: list[tuple[str, Sequence[float | None]]] = [
        ("in the fit", [best["residuals"]["mm"][name] for name in names]),
        ("held out", [best["residuals"]["held_out_mm"][name] for name in names]),
    ]
    gate = _limit(calibration, "hand_eye_held_out_mm")
    limit_text = "" if gate is None else f"limit of the median held out: {gate:g} mm"
    return dots(names, values, title="Board placed by each image, error, mm", limit=gate, limit_text=limit_text)


def image_rows(calibration: Calibration) -> list[ImageRow]:
    """Every board image with its residuals, unused images first."""
    record, best = calibration.intrinsics or {}, calibration.best or {}
    names: list[str] = record.get("images", [])
    validation: Mapping[str, Any] = record.get("cross_validation") or {}

    def by_image(values: Sequence[float | None] | None) -> dict[str, float | None]:
        return dict(zip(names, values, strict=False)) if values else {}

    rms = by_image(record.get("per_view_rms_px"))
    five, one = by_image(validation.get("five_fold_view_px")), by_image(validation.get("leave_one_out_view_px"))
    left: Mapping[str, Mapping[str, float]] = best.get("residuals", {})
    rows = [
        ImageRow(
            name,
            rms.get(name),
            five.get(name),
            one.get(name),
            *(left.get(key, {}).get(name) for key in ("mm", "deg", "held_out_mm", "held_out_deg")),
            sha256=capture.artefacts[0].sha256,
            step=capture.step,
            use=board_use(calibration.states[capture.step], capture),
        )
        for capture in calibration.captures
        for name in (capture.viewpoint,)
    ]
    return sorted(rows, key=lambda row: row.use.used is not False)  # stable: what is not used first


def held_out_mm(calibration: Calibration) -> tuple[float, float] | None:
    """Median and maximum error of the board's position by images that the hand-eye calibration did not use, mm."""
    if calibration.best is None:
        return None
    values = list(calibration.best["residuals"]["held_out_mm"].values())
    return median(values), max(values)


def _limit(calibration: Calibration, measure: str) -> float | None:
    gates = [gate for step, _ in calibration.steps for gate in step.gates if gate.measure == measure]
    return gates[-1].max if gates else None


# --- certificate --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Signature:
    """Who signed a calibration step, when, and with which meaning."""

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
    """What a certificate states in addition to the figures.

    Attributes:
        camera: EXIF of the first board image: settings, lens, body.
        robots: name in the rig, model and serial number of each whose flange carried the camera.
        passed: number, hash and time of the event by which the last step passed; None: it has not.
        checks: of later images.
        stops: troubles of the robot or camera since.
    """

    camera: Mapping[str, Any]
    camera_model: str
    robots: tuple[tuple[str, str, str], ...]
    environment: Mapping[str, float]
    operator: str
    passed: tuple[int, str, str] | None
    signatures: tuple[Signature, ...]
    checks: tuple[LaterCheck, ...]
    stops: tuple[str, ...]


_STATED = (
    "model", "body_serial", "lens", "lens_serial", "focal_length_mm", "aperture_f", "exposure_s", "iso", "focus_mode",
    "focus_distance_m", "width", "height",
)  # fmt: skip


def certificate_of(log: RunRecord, calibration: Calibration) -> Certificate:
    """The certificate, from the recorded events alone."""
    state, (_, there) = log.state, calibration.steps[-1]
    first = calibration.captures[0] if calibration.captures else None
    ids = {step.id for step, _ in calibration.steps}
    signatures = [
        Signature(event.payload.step or "", event.actor, event.at_utc, event.payload.meaning)
        for event in log.events
        if isinstance(event.payload, OperatorAction)
        and event.payload.action == "sign"
        and event.payload.step in ids
        and state.steps[event.payload.step].signed
    ]
    checks = [
        LaterCheck(step.title, len(done.captured), int(done.measures["optics_departures"]))
        for step, done in ((s, state.steps[s.id]) for s in log.protocol.steps)
        if step.id not in ids and "optics_departures" in done.measures
    ]
    passed = None
    if there.passed_seq:
        passed = (there.passed_seq, there.passed_sha256, log.events[there.passed_seq - 1].at_utc)
    since = there.passed_seq or state.seq
    stops = [f"{t.device}: {t.message} (event {t.seq})" for t in state.troubles if t.seq > since]
    known = {
        event.payload.device: event.payload.report.get("identity", {})
        for event in log.events
        if isinstance(event.payload, DeviceOpened)
    }
    models = [str(identity.get("model", "")) for identity in known.values() if identity.get("kind") == "camera"]
    stated = dict.fromkeys(_STATED) | ({} if first is None else first.camera)  # imported images state what they do
    robots = [(name, known.get(name, {})) for name in calibration.robots]
    return Certificate(
        stated,
        models[-1] if models else str(stated["model"] or ""),
        tuple((name, str(about.get("model", "")), str(about.get("serial", ""))) for name, about in robots),
        {} if first is None else first.environment,
        state.operator,
        passed,
        tuple({s.step: s for s in signatures}.values()),
        tuple(checks),
        tuple(stops),
    )
