"""Calibration certificates: number, validity, held-out errors in mm, reasons for a new calibration, charts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from service.audit.recorded_run import RecordedRun
from service.audit.report_blocks import (
    Block,
    Column,
    DescriptionList,
    Drawing,
    Drawings,
    Heading,
    Label,
    Line,
    Paragraph,
    Rectangle,
    Section,
    Shape,
    Table,
    TableCell,
    judged,
    limit,
    measured,
    utc,
)
from service.computations.calibration import (
    CALIBRATE,
    CalibrateAnswer,
    Coverage,
    HandEye,
    Intrinsics,
    ProjectionUncertainty,
    ResidualField,
    Residuals,
)
from service.computations.records import Camera
from service.core.gates import depends_on
from service.core.geometry import Array
from service.core.records.run_events import RecordedOptics, RecordedView
from service.core.units import mm

_WIDTH = 480.0
_LEGEND = 26.0
_INK, _LINE, _BLUE, _RED = "#1a1f24", "#c9d1d9", "#1f5fbf", "#b3261e"
_PALE, _DEEP = (239, 244, 250), (31, 95, 191)


def coverage_drawing(coverage: Coverage, size: tuple[int, int]) -> Drawing:
    """Return the number of board corners in each cell of an image of `size` (width, height), px."""
    counts = np.array(coverage.corners, dtype=np.float64)
    empty = int(np.sum(counts == 0))
    shapes, height = _cells(counts, size, lambda value: f"{value:.0f}")
    return Drawing(
        "Coverage: corners of the board in each part of the image",
        f"{coverage.share:.0%} of the {counts.size} cells hold a corner (empty: {empty}); the fullest holds "
        f"{counts.max():.0f}.",
        _WIDTH,
        height,
        tuple(shapes),
        "coverage",
        _by_cell(counts, size, "corners", "{:.0f}"),
    )


def uncertainty_drawing(known: ProjectionUncertainty, size: tuple[int, int]) -> Drawing:
    """Return the standard deviation of a projected point over the image, in micrometres at the board's distance."""
    field = np.array(known.sigma_mm, dtype=np.float64)
    coarse = mm(field[:: max(1, len(field) // 8), :: max(1, len(field[0]) // 12)])
    shapes, height = _cells(np.log(coarse), size, lambda value: f"{math.exp(value):.2g}")
    return Drawing(
        f"Uncertainty of a projected point at {known.distance_m:.2f} m, in µm",
        f"σ {known.centre_mm:.4f} mm in the centre and {known.worst_mm:.4f} mm at worst "
        f"({known.centre_px:.4f} and {known.worst_px:.4f} px).",
        _WIDTH,
        height,
        tuple(shapes),
        "projection_uncertainty",
        _by_cell(field, size, "sigma_mm", "{:.6f}"),
    )


def residual_drawing(residuals: ResidualField, rms_px: float | None, size: tuple[int, int]) -> Drawing:
    """Return the mean residual of each cell as an arrow: the error of the lens model. `rms_px`: of all corners."""
    mean = np.array(residuals.mean_px, dtype=np.float64)
    counts = np.array(residuals.corners)
    known = counts > 0
    lengths = np.linalg.norm(mean, axis=2)
    longest = float(lengths[known].max(initial=0.0))
    usual = float(np.quantile(lengths[known], 0.9)) if known.any() else 0.0
    rows, columns = counts.shape
    height = _WIDTH * size[1] / size[0]
    cell = np.array([_WIDTH / columns, height / rows])
    shapes: list[Shape] = [Rectangle(0, 0, _WIDTH, height, "#f7f9fb")]
    for row, column in np.argwhere(known):
        middle = (np.array([column, row]) + 0.5) * cell
        length = min(2.0, lengths[row, column] / max(usual, 1e-9)) * 0.45 * float(cell.min())
        tip = middle + mean[row, column] / max(lengths[row, column], 1e-9) * length
        shapes += _arrow(middle, tip)
    return Drawing(
        "Residuals: mean of each part of the image",
        f"An arrow of half a cell is {usual:.4f} px, the longest stands for {longest:.4f} px"
        + ("." if rms_px is None else f"; {rms_px:.4f} px rms over all corners."),
        _WIDTH,
        height,
        tuple(shapes),
        "residuals",
        (
            ("row", "column", "centre_x_px", "centre_y_px", "mean_dx_px", "mean_dy_px", "corners"),
            *(
                (*_cell(int(row), int(column), counts.shape, size), *(f"{v:.5f}" for v in mean[row, column]), str(n))
                for (row, column), n in np.ndenumerate(counts)
            ),
        ),
    )


def bars_drawing(name: str, title: str, text: str, values: Mapping[str, float], unit: str) -> Drawing:
    """Return a bar for each view, on a scale up to the largest value; `name`: of the file."""
    height, base = 190.0, 160.0
    largest = max(values.values(), default=0.0) or 1.0
    step = (_WIDTH - 50) / max(len(values), 1)
    shapes: list[Shape] = [Line(44, base, _WIDTH, base, _LINE)]
    for share in (0.5, 1.0):
        y = base - 130 * share
        shapes += [
            Line(44, y, _WIDTH, y, _LINE, 0.5),
            Label(40, y + 3, f"{largest * share:.2g} {unit}", 9, anchor="end"),
        ]
    every = max(1, math.ceil(len(values) / 16))
    for k, (view, value) in enumerate(values.items()):
        x = 48 + k * step
        shapes.append(Rectangle(x, base - 130 * value / largest, 0.7 * step, 130 * value / largest, _BLUE))
        if k % every == 0:
            shapes.append(Label(x + 0.35 * step, base + 14, view, 8))
    rows = (("view", f"error_{unit}"), *((view, f"{value:.6f}") for view, value in values.items()))
    return Drawing(title, text, _WIDTH, height, tuple(shapes), name, rows)


def _by_cell(values: Array, size: tuple[int, int], name: str, form: str) -> tuple[tuple[str, ...], ...]:
    """Return one row for each cell: its indices, its position in the image, and its value."""
    cells = (
        (*_cell(int(at[0]), int(at[1]), values.shape, size), form.format(value))
        for at, value in np.ndenumerate(values)
    )
    return (("row", "column", "centre_x_px", "centre_y_px", name), *cells)


def _cell(row: int, column: int, shape: tuple[int, ...], size: tuple[int, int]) -> tuple[str, ...]:
    """Return the row, column, and the middle of the cell in px; pixel centres at integer coordinates."""
    x, y = (column + 0.5) * size[0] / shape[1] - 0.5, (row + 0.5) * size[1] / shape[0] - 0.5
    return str(row), str(column), f"{x:.1f}", f"{y:.1f}"


def _cells(values: Array, size: tuple[int, int], text: Callable[[float], str]) -> tuple[list[Shape], float]:
    rows, columns = values.shape
    height = _WIDTH * size[1] / size[0]
    width, tall = _WIDTH / columns, height / rows
    low, high = float(values.min()), float(values.max())
    shapes: list[Shape] = []
    for (row, column), value in np.ndenumerate(values):
        share = (float(value) - low) / (high - low) if high > low else 0.0
        shapes.append(Rectangle(column * width, row * tall, width - 1, tall - 1, _mixed(share)))
        ink = "#ffffff" if share > 0.55 else _INK
        shapes.append(Label((column + 0.5) * width, (row + 0.5) * tall + 3.5, text(float(value)), 9.5, ink))
    return shapes, height


def _mixed(share: float) -> str:
    return "#" + "".join(f"{round(a + (b - a) * share):02x}" for a, b in zip(_PALE, _DEEP, strict=True))


def _arrow(start: Array, tip: Array) -> Sequence[Line]:
    along = tip - start
    length = float(np.linalg.norm(along))
    if length < 1.0:
        return [Line(start[0] - 0.7, start[1], start[0] + 0.7, start[1], _BLUE, 1.4)]
    unit, side = along / length, np.array([-along[1], along[0]]) / length
    head = min(5.0, 0.4 * length)
    ends = [tip - head * unit + sign * 0.5 * head * side for sign in (1, -1)]
    lines = [(start, tip), *((end, tip) for end in ends)]
    return [Line(float(a[0]), float(a[1]), float(b[0]), float(b[1]), _BLUE, 1.1) for a, b in lines]


_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
_INVARIANTS = ("settings_departures", "optics_departures")


def certificate_sections(run: RecordedRun) -> Iterator[Section]:
    """Yield a certificate for each calibration step that has a result."""
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        kept = [ref for ref in state.artefacts if ref.kind == "calibration"]
        if step.gives == "calibration" and state.result and kept:
            solved = CALIBRATE.read_answer(state.result)
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


def _facts(run: RecordedRun, step_id: str, sha256: str, solved: CalibrateAnswer) -> DescriptionList:
    state = run.state.steps[step_id]
    first = next((run.events[seq - 1].payload for seq in sorted(state.captured.values())), None)
    camera = first.optics if isinstance(first, RecordedView) else RecordedOptics()
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


def _intrinsics(solved: CalibrateAnswer) -> Iterator[Block]:
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
    """Return the value and standard deviation of each recorded parameter, in two columns."""
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


def _hand_eye(solved: CalibrateAnswer) -> Iterator[Block]:
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
    """Yield the section on what the certificate is valid for, and on the gates that watch it."""
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
