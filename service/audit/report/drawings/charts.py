"""Charts of a report: coverage, residuals and uncertainty of a calibration, and bars for each view."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from service.audit.report.blocks import Drawing, Label, Line, Rectangle, Shape
from service.core.geometry import Array
from service.core.units import mm
from service.jobs.calibration.records import Coverage, ProjectionUncertainty, ResidualField

_WIDTH = 480.0
_LEGEND = 26.0
_INK, _LINE, _BLUE, _RED = "#1a1f24", "#c9d1d9", "#1f5fbf", "#b3261e"
_PALE, _DEEP = (239, 244, 250), (31, 95, 191)


def coverage_drawing(coverage: Coverage, size: tuple[int, int]) -> Drawing:
    """Number of board corners in each cell of an image of `size` (width, height), px."""
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
    """Standard deviation of a projected point over the image, in micrometres at the board's distance."""
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
    """Mean residual of each cell as an arrow: the error of the lens model. `rms_px`: of all corners."""
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
    """A bar for each view, on a scale up to the largest value; `name`: of the file."""
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
    """One row for each cell: its indices, its position in the image, and its value."""
    cells = (
        (*_cell(int(at[0]), int(at[1]), values.shape, size), form.format(value))
        for at, value in np.ndenumerate(values)
    )
    return (("row", "column", "centre_x_px", "centre_y_px", name), *cells)


def _cell(row: int, column: int, shape: tuple[int, ...], size: tuple[int, int]) -> tuple[str, ...]:
    """Row, column, and the middle of the cell in px; pixel centres at integer coordinates."""
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
