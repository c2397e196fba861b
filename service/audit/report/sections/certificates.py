"""Calibration certificates: number, validity, held-out errors in mm, reasons for a new calibration, charts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import (
    Block,
    Column,
    DescriptionList,
    Drawings,
    Heading,
    Paragraph,
    Section,
    Table,
    TableCell,
)
from service.audit.report.drawings.charts import bars_drawing, coverage_drawing, residual_drawing, uncertainty_drawing
from service.audit.report.words import judged, limit, measured, utc
from service.core.gates.acceptance import depends_on
from service.core.recorded_devices import RecordedOptics, recorded_optics
from service.core.records.events import RecordedView
from service.jobs.calibration import calibrate
from service.jobs.calibration.records import HandEye, Intrinsics, Residuals
from service.jobs.records import Camera

_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
_INVARIANTS = ("settings_departures", "optics_departures")


def certificate_sections(run: RecordedRun) -> Iterator[Section]:
    """A certificate for each calibration step that has a result."""
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        kept = [ref for ref in state.artefacts if ref.kind == "calibration"]
        if step.gives == "calibration" and state.result and kept:
            solved = calibrate.KIND.read_answer(state.result)
            blocks = (
                _facts(run, step.id, kept[-1].sha256, solved),
                *(
                    Paragraph(f"Depends on an accepted gate: {gate.text}", "attention")
                    for gate in depends_on(run.protocol, run.state, step.id)
                ),
                *_intrinsics(solved),
                *_hand_eye(solved),
                *_validity(run, step.id),
            )
            yield Section(f"Calibration certificate: {step.title}", blocks)


def _facts(run: RecordedRun, step_id: str, sha256: str, solved: calibrate.Answer) -> DescriptionList:
    state = run.state.steps[step_id]
    first = next((run.events[seq - 1].payload for seq in sorted(state.captured.values())), None)
    camera = recorded_optics(first.camera if isinstance(first, RecordedView) else {})
    rows: list[tuple[str, TableCell | str]] = [
        ("Certificate number (SHA-256 of calibration.json)", sha256),
        ("Calibrated", utc(state.ended_utc) if state.ended_utc else "not accepted yet"),
        ("Camera and lens", _camera_and_lens(camera) or "not recorded"),
    ]
    if solved.details.intrinsics is not None:
        rows += _intrinsics_facts(solved.details.intrinsics)
    if solved.hand_eye is not None:
        rows += _hand_eye_facts(solved.hand_eye)
    return DescriptionList(tuple(rows))


def _camera_and_lens(camera: RecordedOptics) -> str:
    parts = (
        f"body {camera.body_serial}" if camera.body_serial else "",
        camera.lens,
        f"{camera.focal_length_mm:g} mm" if camera.focal_length_mm else "",
        f"f/{camera.aperture_f:g}" if camera.aperture_f else "",
        f"{camera.focus_mode} focus" if camera.focus_mode else "",
    )
    return ", ".join(filter(None, parts))


def _intrinsics_facts(solved: Intrinsics) -> Iterator[tuple[str, str]]:
    checked, sigma = solved.cross_validation, solved.uncertainty
    if checked is not None:
        text = f"{checked.five_fold_rms_px:.4f} px rms"
        if sigma is not None:
            off_mm = checked.five_fold_rms_px * sigma.worst_mm / sigma.worst_px
            text += f", which is {off_mm:.4f} mm at {sigma.distance_m:.2f} m"
        yield "Held-out error of the intrinsics", f"{text} ({checked.folds} folds)"
    if solved.board is not None and solved.board.bow_words:
        yield "Bow of the board", solved.board.bow_words
    if sigma is not None:
        spread = f"{sigma.centre_mm:.4f} mm in the centre, {sigma.worst_mm:.4f} mm at worst"
        yield "Uncertainty of a projected point", f"{spread}, at {sigma.distance_m:.2f} m"


def _hand_eye_facts(solved: HandEye) -> Iterator[tuple[str, str]]:
    best = solved.best
    corrected = ", the arm's errors corrected" if solved.arm_correction is not None else ""
    text = f"{_median_mm(best.residuals):.3f} mm (median over the views, each predicted by the others)"
    yield "Held-out error of the hand-eye", text + corrected
    if best.sigma.mm is not None and best.sigma.deg is not None:
        yield "Uncertainty of the hand-eye", f"{best.sigma.mm:.3f} mm, {best.sigma.deg:.4f}°"
    if best.board_size is not None:
        yield "Size of the board", best.board_size.words


def _median_mm(residuals: Residuals) -> float:
    return float(np.median(list(residuals.held_out_mm.values())))


def _intrinsics(solved: calibrate.Answer) -> Iterator[Block]:
    record, camera = solved.details.intrinsics, solved.camera
    if record is None:
        return
    yield Heading("Intrinsics")
    yield _parameters(camera, record)
    size = camera.width, camera.height
    drawings = (
        None if record.coverage is None else coverage_drawing(record.coverage, size),
        None if record.residuals is None else residual_drawing(record.residuals, record.rms_px, size),
        None if record.uncertainty is None else uncertainty_drawing(record.uncertainty, size),
    )
    yield Drawings(tuple(drawing for drawing in drawings if drawing is not None))
    if record.excluded:
        excluded = "; ".join(f"{one.image}: {one.reason}" for one in record.excluded)
        yield Paragraph(f"Views left out: {excluded}.")
    for warning in record.warnings:
        yield Paragraph(warning[:1].upper() + warning[1:] + ".", "attention")


def _parameters(camera: Camera, record: Intrinsics) -> Table:
    """Value and standard deviation of each recorded parameter, in two columns."""
    known = {name: float(getattr(camera, name)) for name in _PARAMETERS if name in camera.model_fields_set}
    texts = [
        (name, f"{value:.7g}", f"{record.sigma[name]:.2g}" if name in record.sigma else "held")
        for name, value in known.items()
    ]
    half = (len(texts) + 1) // 2
    empty = ("", "", "")
    pairs = zip(texts[:half], [*texts[half:], *[empty] * (2 * half - len(texts))], strict=True)
    columns = (Column("parameter"), Column("value", 1.4, "number"), Column("σ", 1.2, "number"))
    return Table((*columns, *columns), tuple((*a, *b) for a, b in pairs))


def _hand_eye(solved: calibrate.Answer) -> Iterator[Block]:
    record = solved.hand_eye
    if record is None:
        return
    yield Heading("Hand-eye")
    held = record.best.residuals.held_out_mm
    text = (
        f"Median {_median_mm(record.best.residuals):.3f} mm, largest {max(held.values()):.3f} mm; "
        f"solved by {record.method}."
    )
    yield Drawings((bars_drawing("hand_eye_held_out", "Held-out error of each view", text, held, "mm"),))
    for finding in record.findings:
        yield Paragraph(finding[:1].upper() + finding[1:] + ".", "attention")
    if record.arm_correction is not None:
        yield Paragraph(
            f"With the arm's poses as reported the median is {_median_mm(record.residuals):.3f} mm. The correction "
            f"({record.arm_correction.terms}) is of this arm alone, and holds for the stations where this arm stood."
        )


def _validity(run: RecordedRun, step_id: str) -> Iterator[Block]:
    """What the certificate is valid for, and the gates that watch it."""
    yield Heading("Validity, and what makes a new calibration necessary")
    yield Paragraph(
        "It holds for this camera, lens and mount as long as zoom, focus, aperture and the screws between flange and "
        "camera are untouched. Any of these makes a new one necessary: another lens, zoom, focus or aperture; the "
        "camera taken off or knocked; another arm, for the hand-eye and its correction; a gate below that fails; a "
        "registration whose error budget does not hold."
    )
    rows: list[tuple[TableCell | str, ...]] = []
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        accepted = state.accepted is not None
        mine = step.id == step_id
        for verdict in state.verdicts:
            if mine or verdict.measure in _INVARIANTS:
                rows.append((step.title, *measured(verdict), limit(verdict), judged(verdict, accepted=accepted)))
    columns = (
        Column("step", 2.4),
        Column("measure", 2.0),
        Column("value", 1.1, "number"),
        Column("limit", 0.9, "number"),
        Column("verdict", 0.8),
    )
    yield Table(columns, tuple(rows))
