"""The accuracy of a run's data set: a sentence, tables beside the paper's, a budget, and its further cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from service.audit.recorded_run import RecordedRun, not_in_yet
from service.audit.report_blocks import (
    Block,
    Column,
    DescriptionList,
    Heading,
    Paragraph,
    Section,
    Table,
    TableCell,
    mm,
    utc,
    words,
)
from service.computations.evaluate import ErrorBudget, Row
from service.core.gates import depends_on
from service.core.words import counted
from service.dataset.further_cameras import KnownFurtherCamera, known_further_cameras
from service.dataset.registrations import late_results, shared_adjustment_note
from service.dataset.summary import RunSummary

PAPER_LIMIT_MM = 0.35
_LIMITED = "best_mean_radial_error_mm"
_HONEST = (0.5, 2.0)

# The paper's table: mean radial error (mm) and mean reprojection error (px) by source and width of the images.
_PAPER = {
    ("robot", 9504): (0.89, 8.99),
    ("colmap", 1920): (1.10, 11.53),
    ("colmap", 4752): (0.37, 3.91),
    ("colmap", 9504): (0.35, 3.71),
    ("glomap", 9504): (0.44, 4.67),
}
_SOURCES = {
    "robot": "the robot's poses as reported",
    "robot_corrected": "the robot's poses, its errors corrected",
    "spheres": "each image located by its own spheres",
    "triangulated": "adjusted from the corrected robot poses",
    "colmap": "incremental structure from motion, COLMAP",
    "glomap": "global structure from motion, GLOMAP",
    "hybrid": "structure from motion, robot and spheres adjusted together",
}


def result_sentence(summary: RunSummary) -> TableCell:
    """Return the result with its uncertainty and its limit."""
    best, row = summary.best(), _best_row(summary)
    if best is None or row is None:
        return TableCell("Not evaluated: nothing can be said about the accuracy of this data set.", "attention")
    limit_mm, whose = _limit(summary)
    error_mm = row.mean_radial_error_mm
    within = error_mm <= limit_mm
    simulated = " These are figures of a simulated rig." if summary.root.simulated else ""
    known = summary.budgets().get(best)
    total_mm = None if known is None else known.total_mm
    budget = "" if total_mm is None else f", {total_mm:.3f} mm with the scan's own error"
    on = {"control spheres": "control spheres, which took no part in the registration,"}
    return TableCell(
        f"With {best} poses ({_SOURCES.get(row.source, words(row.source))}), the mean error on the "
        f"{on.get(row.evaluated_on, 'spheres, each predicted by the others,')} is {error_mm:.3f} mm, "
        f"{'within' if within else 'OUTSIDE'} the limit of {limit_mm:g} mm ({whose}), with a predicted uncertainty "
        f"of the registration of {mm(row.predicted_error_mm)} mm (1σ, 3D){budget}.{simulated}"
        + (" It depends on figures that were accepted outside their limits, see below." if rests_on(summary) else ""),
        ("attention" if rests_on(summary) else "ok") if within else "stop",
    )


def rests_on(summary: RunSummary) -> tuple[str, ...]:
    """Return texts on the accepted gates on which the evaluation rests."""
    evaluations = [step.id for step in summary.protocol.steps if step.gives == "accuracy"]
    gates = (gate for step in evaluations for gate in depends_on(summary.protocol, summary.state, step))
    return tuple(dict.fromkeys(f"Depends on an accepted gate: {gate.text}" for gate in gates))


def _limit(summary: RunSummary) -> tuple[float, str]:
    gates = (gate for step in summary.protocol.steps for gate in step.gates if gate.measure == _LIMITED)
    limits = [gate.max for gate in gates if gate.max is not None]
    return (limits[-1], "the protocol's gate") if limits else (PAPER_LIMIT_MM, "the paper's figure")


def _best_row(summary: RunSummary) -> Row | None:
    return next((row for row in summary.table() if row.poses == summary.best()), None)


def accuracy_section(summary: RunSummary, true_error_mm: Mapping[str, float] | None) -> Section:
    """Return a table with one row for each source of camera poses, with the paper's figures."""
    rows = summary.table()
    title = "Registration error by source of camera poses"
    if not rows:
        return Section(title, (Paragraph("Not evaluated."),))
    blocks: list[Block] = [Paragraph(text, "attention") for text in rests_on(summary)]
    blocks.append(_table(rows, summary.best(), true_error_mm))
    blocks.append(
        Paragraph(
            f"Measured on {rows[0].evaluated_on}. The radial error is the distance between the sphere seen by the "
            "camera and the sphere of the scan, across the line of sight; the reprojection error is the same in the "
            "image. The paper's figures are of real images at its own widths; reprojection errors can be compared "
            "only at the same width."
        )
    )
    own = _best_row(summary)
    if own is not None and own.poses in summary.registrations():
        found = summary.registrations()[own.poses].findings
        blocks += [Paragraph(f"{one.text}.", "attention") for one in found]
    if own is not None and own.control_spheres:
        blocks += [Paragraph(f"{text[0].upper()}{text[1:]}.", "attention") for text in own.findings]
        blocks.append(_control_spheres(own))
    note = shared_adjustment_note(summary.protocol, summary.state)
    if note:
        blocks.append(Paragraph(note))
    return Section(title, tuple(blocks))


def _table(rows: Sequence[Row], own: str | None, true_error_mm: Mapping[str, float] | None) -> Table:
    """Return one row for each source of poses; that of the run's `own` registration is marked."""
    columns = [
        Column("camera poses", 2.6),
        Column("images", 1.1),
        Column("mean radial error (mm)", 1.0, "number"),
        Column("mean reprojection error (px)", 1.15, "number"),
        Column("predicted error (mm)", 1.0, "number"),
        Column("outlines", 0.8, "number"),
        Column("the paper: mm / px (image width)", 1.4, "number"),
    ]
    if true_error_mm is not None:
        columns.append(Column("true error (mm), known to the simulator alone", 1.2, "number"))
    shown = tuple(
        (*_texts(row, best=row.poses == own), *(() if true_error_mm is None else (mm(true_error_mm.get(row.poses)),)))
        for row in rows
    )
    strong = frozenset(number for number, row in enumerate(rows) if row.poses == own)
    return Table(tuple(columns), shown, strong)


def _control_spheres(row: Row) -> Table:
    """Return each control sphere by itself, with the run's own registration."""
    columns = (
        Column("control sphere", 1.0),
        Column("radial error (mm)", 1.0, "number"),
        Column("outlines measured of expected", 1.3, "number"),
        Column("from its place in the scan (mm)", 1.3, "number"),
    )
    rows = tuple(
        (
            str(sphere.index),
            mm(sphere.radial_error_mm),
            f"{sphere.measured} of {sphere.expected}",
            "–"
            if sphere.displacement_mm is None
            else f"{sphere.displacement_mm:.3f} ± {mm(sphere.displacement_sigma_mm)}",
        )
        for sphere in row.control_spheres
    )
    return Table(columns, rows)


def _texts(row: Row, *, best: bool) -> tuple[str, ...]:
    late = f" ({row.late})" if row.late else ""
    named = row.poses + (" (best)" if best else late)
    return (
        f"{named}: {_SOURCES.get(row.source, words(row.source))}",
        row.resolution.replace(" ", "\N{NO-BREAK SPACE}"),
        f"{row.mean_radial_error_mm:.3f}",
        "–" if row.mean_reprojection_error_px is None else f"{row.mean_reprojection_error_px:.2f}",
        mm(row.predicted_error_mm),
        str(row.control_outlines),
        _paper(row),
    )


def later_section(summary: RunSummary) -> Section | None:
    """Return results that arrived after the evaluation, their effect, and what is still missing; None without any."""
    late = late_results(summary.protocol, summary.state)
    missing = not_in_yet(summary.protocol, summary.state, summary.events)
    if not late and not missing:
        return None
    blocks: list[Block] = []
    if late:
        columns = (
            Column("event", 0.5, "number"),
            Column("time", 1.2),
            Column("what arrived, and what it changed", 5.0),
        )
        blocks.append(Table(columns, tuple((str(one.seq), utc(one.at_utc), f"{one.text}.") for one in late)))
        better = summary.better_later()
        if better is not None:
            blocks.append(
                Paragraph(
                    f"{better.poses} has the smallest error of all, {better.mean_radial_error_mm:.3f} mm. What "
                    f"was judged and signed is {summary.best()}, and the data set has its poses."
                )
            )
    if missing:
        blocks.append(Paragraph("Not in when this was made:", "attention"))
        blocks += [Paragraph(f"{line}.", "attention") for line in missing]
    return Section("Results that arrived later", tuple(blocks))


def _paper(row: Row) -> str:
    """Return the paper's figures for this source, at the image width nearest to the row's."""
    width = int(row.resolution.split()[0])
    known = [at for source, at in _PAPER if source == row.source]
    if not known:
        return "–"
    at = min(known, key=lambda candidate: abs(np.log(candidate / width)))
    radial_mm, reprojection_px = _PAPER[row.source, at]
    return f"{radial_mm:.2f} / {reprojection_px:.2f} ({at})"


def budget_section(summary: RunSummary) -> Section | None:
    """Return the error budget by source, compared with independent measurements; None without an evaluation."""
    best = summary.best()
    budget = summary.budgets().get(best or "")
    if budget is None or budget.total_mm is None:
        return None
    return Section(
        "Error budget",
        (
            *(Paragraph(text, "attention") for text in rests_on(summary)),
            Paragraph(f"Standard deviations (3D) in the middle of the anatomy, with the poses of {best}."),
            _contributions(budget, budget.total_mm),
            Heading("Does it hold?"),
            Paragraph(
                "Each independent measurement is compared with what the budget predicts for it. "
                "A normalised χ² near 1 means that the stated errors are right."
            ),
            _observations(budget),
        ),
    )


def _contributions(budget: ErrorBudget, total_mm: float) -> Table:
    contributions = [
        (c.name + ("" if c.counted else " (not in the sum)"), f"{c.sigma_mm:.4f}", c.how)
        for c in budget.contributions
    ]
    total = ("sum", f"{total_mm:.4f}", "root of the sum of squares")
    return Table(
        (Column("source", 1.3), Column("σ (mm)", 0.7, "number"), Column("how it was found", 4.5)),
        (*contributions, total),
        frozenset({len(contributions)}),
    )


def _observations(budget: ErrorBudget) -> Table:
    return Table(
        (
            Column("independent measurement", 3.0),
            Column("spheres", 0.8, "number"),
            Column("observed (mm)", 0.85, "number"),
            Column("predicted (mm)", 0.85, "number"),
            Column("normalised χ²", 0.9, "number"),
            Column("verdict", 2.0),
        ),
        tuple(
            (
                f"{o.name}: {o.how}",
                str(o.n),
                f"{o.observed_mm:.4f}",
                f"{o.predicted_mm:.4f}",
                f"{o.normalised_chi2:.2f}",
                TableCell(o.verdict, "ok" if _HONEST[0] <= o.normalised_chi2 <= _HONEST[1] else "attention"),
            )
            for o in budget.observations
        ),
    )


_INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def further_cameras_section(run: RecordedRun) -> Section | None:
    """Return a table of all, then the numbers of each; None for a run with one camera."""
    cameras = known_further_cameras(run.protocol, run.state, run.summary().captures())
    if not cameras:
        return None
    text = (
        "They exposed after the first camera at the viewpoints of the data set. Each is calibrated by itself, and "
        "located by the spheres in its images."
    )
    blocks: list[Block] = [Paragraph(text), _camera_table(cameras)]
    for camera in cameras:
        blocks += [Heading(camera.name), _facts(camera)]
        if camera.located is not None and camera.located.T_outer_camera is not None:
            rows = tuple(tuple(f"{value:.6f}" for value in row) for row in camera.located.T_outer_camera)
            name = "T_scan_camera" if camera.mounted == "fixed" else "T_first_camera"
            empty = (Column("", 1.0, "number"),) * 3
            blocks.append(Table((Column(f"{name}, m", 1.0, "number"), *empty), rows, small=True))
    return Section("Further cameras", tuple(blocks))


def _camera_table(cameras: tuple[KnownFurtherCamera, ...]) -> Table:
    columns = (
        Column("camera", 0.9),
        Column("place", 1.4),
        Column("images", 0.7, "number"),
        Column("in the frame of", 1.2),
        Column("σ position, mm", 0.9, "number"),
        Column("σ rotation, mrad", 1.0, "number"),
        Column("its clock is ahead by", 1.6, "number"),
    )
    return Table(columns, tuple(_row(camera) for camera in cameras))


def _row(camera: KnownFurtherCamera) -> tuple[TableCell | str, ...]:
    place = "in the room" if camera.mounted == "fixed" else "beside the first camera"
    clock = "not known" if camera.clock is None else f"{camera.clock.offset_s:+.3f} ± {camera.clock.sigma_s:.3f} s"
    if camera.sigma_mm is None or camera.sigma_mrad is None:
        why = "not registered" if camera.located is None else f"NOT LOCATED: {camera.located.why}"
        tone = "attention" if camera.located is None else "stop"
        return camera.name, place, str(len(camera.images)), TableCell(why, tone), "–", "–", clock
    sigmas = f"{camera.sigma_mm:.3f}", f"{camera.sigma_mrad:.3f}"
    return camera.name, place, str(len(camera.images)), camera.outer, *sigmas, clock


def _facts(camera: KnownFurtherCamera) -> DescriptionList:
    optics, located = camera.optics, camera.located
    body = ", ".join(filter(None, (optics.model, optics.lens, f"body {optics.body_serial}")))
    rows: list[tuple[str, TableCell | str]] = [
        ("Camera and lens", body),
        ("Calibration (SHA-256 of its file)", camera.calibration.sha256),
    ]
    if located is not None:
        parameters = ", ".join(f"{name} {float(getattr(located.camera, name)):.6g}" for name in _INTRINSICS)
        rows.append(("Intrinsics", f"{located.camera.width} × {located.camera.height} px; {parameters}"))
        rows.append(("Outlines measured in", "raw files" if located.measured_on == "raw" else "JPEGs"))
        if located.consistency_mm is not None and located.consistency_mrad is not None:
            agree = f"{located.consistency_mm:.3f} mm and {located.consistency_mrad:.3f} mrad rms"
            rows.append(("Its images agree within", agree))
        if located.excluded:
            left_out = "; ".join(f"{view}: {why}" for view, why in located.excluded.items())
            rows.append(("Images left out", TableCell(left_out, "attention")))
    if camera.clock is not None:
        unlike = "; two models, whose delays differ" if camera.clock.unlike else ""
        rows.append(("Clocks compared by", counted(camera.clock.photographs, "pair") + " of photographs" + unlike))
    return DescriptionList(tuple(rows))
