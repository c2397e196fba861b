"""Calibration certificates: number, validity, held-out errors in mm, what makes a new one necessary, charts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Block, Cell, Column, Drawings, Facts, Heading, Paragraph, Section, Table
from service.audit.report.drawings.charts import bars_drawing, coverage_drawing, residual_drawing, uncertainty_drawing
from service.audit.report.words import judged, limit, measured, utc
from service.core.gates.dependence import depends_on
from service.core.records.events import View

_INVARIANTS = ("settings_departures", "optics_departures")


def certificate_sections(run: RecordedRun) -> Iterator[Section]:
    """One for each calibration step that has a result."""
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        kept = [ref for ref in state.artefacts if ref.kind == "calibration"]
        if step.kind == "calibration" and state.result and kept:
            blocks = (
                _facts(run, step.id, kept[-1].sha256),
                *(
                    Paragraph(f"Depends on an accepted gate: {gate.text}", "attention")
                    for gate in depends_on(run.protocol, run.state, step.id)
                ),
                *_intrinsics(state.result),
                *_hand_eye(state.result),
                *_validity(run, step.id),
            )
            yield Section(f"Calibration certificate: {step.title}", blocks)


def _facts(run: RecordedRun, step_id: str, sha256: str) -> Facts:
    state = run.state.steps[step_id]
    first = next((run.events[seq - 1].payload for seq in sorted(state.captured.values())), None)
    camera = first.camera if isinstance(first, View) else {}
    optics = ", ".join(
        text
        for text in (
            str(camera.get("lens", "")),
            f"{camera['focal_length_mm']:g} mm" if camera.get("focal_length_mm") else "",
            f"f/{camera['aperture_f']:g}" if camera.get("aperture_f") else "",
            f"{camera.get('focus_mode', '')} focus" if camera.get("focus_mode") else "",
        )
        if text
    )
    intrinsics: Mapping[str, Any] = state.result["details"].get("intrinsics") or {}
    hand_eye: Mapping[str, Any] = state.result.get("hand_eye") or {}
    best = hand_eye.get("arm_correction") or hand_eye
    body = f"body {camera['body_serial']}" if camera.get("body_serial") else ""
    rows: list[tuple[str, Cell | str]] = [
        ("Certificate number (SHA-256 of calibration.json)", sha256),
        ("Calibrated", utc(state.ended_utc) if state.ended_utc else "not accepted yet"),
        ("Camera and lens", ", ".join(filter(None, (body, optics))) or "not recorded"),
    ]
    if intrinsics:
        checked, sigma = intrinsics.get("cross_validation"), intrinsics["uncertainty"]
        if checked is not None:
            off_mm = checked["five_fold_rms_px"] * sigma["worst_mm"] / sigma["worst_px"]
            text = (
                f"{checked['five_fold_rms_px']:.4f} px rms, which is {off_mm:.4f} mm at {sigma['distance_m']:.2f} m"
            )
            rows.append(("Held-out error of the intrinsics", f"{text} ({checked['folds']} folds)"))
        spread = f"{sigma['centre_mm']:.4f} mm in the centre, {sigma['worst_mm']:.4f} mm at worst"
        rows.append(("Uncertainty of a projected point", f"{spread}, at {sigma['distance_m']:.2f} m"))
    if best:
        held = np.median(list(best["residuals"]["held_out_mm"].values()))
        text = f"{held:.3f} mm (median over the views, each predicted by the others)"
        corrected = "" if best is hand_eye else ", the arm's errors corrected"
        rows += [
            ("Held-out error of the hand-eye", text + corrected),
            ("Uncertainty of the hand-eye", f"{best['sigma']['mm']:.3f} mm, {best['sigma']['deg']:.4f}°"),
        ]
    return Facts(tuple(rows))


def _intrinsics(result: Mapping[str, Any]) -> Iterator[Block]:
    record: Mapping[str, Any] | None = result["details"].get("intrinsics")
    if not record:
        return
    size = int(result["camera"]["width"]), int(result["camera"]["height"])
    yield Heading("Intrinsics")
    sigma: Mapping[str, float] = record["sigma"]
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
    columns = (Column("parameter"), Column("value", 1.4, "number"), Column("σ", 1.2, "number"))
    known = [name for name in names if name in result["camera"]]
    texts = [(n, f"{result['camera'][n]:.7g}", f"{sigma[n]:.2g}" if n in sigma else "held") for n in known]
    half = (len(texts) + 1) // 2
    empty = ("", "", "")
    pairs = zip(texts[:half], [*texts[half:], *[empty] * (2 * half - len(texts))], strict=True)
    yield Table((*columns, *columns), tuple((*a, *b) for a, b in pairs))
    yield Drawings(
        (coverage_drawing(record, size), residual_drawing(record, size), uncertainty_drawing(record, size))
    )
    excluded = [f"{item['image']}: {item['reason']}" for item in record["excluded"]]
    if excluded:
        yield Paragraph(f"Views left out: {'; '.join(excluded)}.")
    for warning in record["warnings"]:
        yield Paragraph(warning[:1].upper() + warning[1:] + ".", "attention")


def _hand_eye(result: Mapping[str, Any]) -> Iterator[Block]:
    record: Mapping[str, Any] | None = result.get("hand_eye")
    if not record:
        return
    yield Heading("Hand-eye")
    best: Mapping[str, Any] = record.get("arm_correction") or record
    held: Mapping[str, float] = best["residuals"]["held_out_mm"]
    median_mm, largest_mm = float(np.median(list(held.values()))), max(held.values())
    text = f"Median {median_mm:.3f} mm, largest {largest_mm:.3f} mm; solved by {record['method']}."
    yield Drawings((bars_drawing("hand_eye_held_out", "Held-out error of each view", text, held, "mm"),))
    if best is not record:
        without = float(np.median(list(record["residuals"]["held_out_mm"].values())))
        yield Paragraph(
            f"With the arm's poses as reported the median is {without:.3f} mm: the correction ({best['terms']}) is "
            "of this arm alone, and holds for the stations where this arm stood."
        )


def _validity(run: RecordedRun, step_id: str) -> Iterator[Block]:
    """What the certificate holds for, and what was watched after it."""
    yield Heading("Validity, and what makes a new calibration necessary")
    yield Paragraph(
        "It holds for this camera, lens and mount as long as zoom, focus, aperture and the screws between flange and "
        "camera are untouched. Any of these makes a new one necessary: another lens, zoom, focus or aperture; the "
        "camera taken off or knocked; another arm, for the hand-eye and its correction; a gate below that fails; a "
        "registration whose error budget does not hold."
    )
    rows: list[tuple[Cell | str, ...]] = []
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        accepted = state.accepted is not None
        mine = step.id == step_id
        for verdict in state.verdicts:
            if mine or verdict.measure in _INVARIANTS:
                rows.append((step.title, *measured(verdict), limit(verdict), judged(verdict, accepted=accepted)))
    columns = (
        Column("step", 2.4),
        Column("watched", 2.0),
        Column("value", 1.1, "number"),
        Column("limit", 0.9, "number"),
        Column("verdict", 0.8),
    )
    yield Table(columns, tuple(rows))
