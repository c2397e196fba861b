"""The figures of a report as files: each as SVG, its numbers as CSV, and the tables of errors as CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.audit.report.blocks import Drawing, Drawings, Report, SceneBlock
from service.audit.report.output.svg import drawing_svg
from service.dataset.summary import RunSummary

_ERRORS = (
    "poses", "source", "resolution", "images", "evaluated_on", "control_outlines", "mean_radial_error_mm",
    "mean_reprojection_error_px", "predicted_error_mm", "control_error_mm", "control_normalised_chi2", "late",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FigureFile:
    """One file; `shows` says what is in it."""

    name: str
    shows: str
    text: str


def figure_files(report: Report, summary: RunSummary) -> list[FigureFile]:
    """Every figure of a report, numbered by its section, then the tables of errors as CSV."""
    found: list[FigureFile] = []
    for number, section in enumerate(report.sections, 1):
        # If a run calibrates twice, two sections have figures of the same names.
        for drawing in _drawings(section.blocks):
            name = f"{number:02d}_{drawing.name}"
            shows = f"{section.title}. {drawing.title}"
            found.append(FigureFile(f"{name}.svg", shows, drawing_svg(drawing) + "\n"))
            found.append(FigureFile(f"{name}.csv", shows, _csv(drawing.rows)))
    table = summary.table()
    if table:
        rows = [_ERRORS, *(tuple(_text(row.plain(), name) for name in _ERRORS) for row in table)]
        found.append(FigureFile("registration_error.csv", "Registration error by source of camera poses", _csv(rows)))
    contributions = [
        (poses, item.name, f"{item.sigma_mm:.6f}", "yes" if item.counted else "no", item.how)
        for poses, budget in summary.budgets().items()
        for item in budget.contributions
    ]
    if contributions:
        head = ("poses", "source", "sigma_mm", "in_the_sum", "how")
        found.append(FigureFile("error_budget.csv", "Error budget", _csv([head, *contributions])))
    return found


def write_figures(files: Sequence[FigureFile], folder: Path) -> None:
    """Write the files; the folder is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        (folder / file.name).write_text(file.text, encoding="utf-8", newline="")


def _drawings(blocks: Sequence[object]) -> Iterator[Drawing]:
    for block in blocks:
        if isinstance(block, Drawings):
            yield from block.items
        elif isinstance(block, SceneBlock):
            yield block.drawing


def _csv(rows: Sequence[Sequence[str]]) -> str:
    out = io.StringIO()
    csv.writer(out).writerows([_plain(cell) for cell in row] for row in rows)
    return out.getvalue()


def _plain(cell: str) -> str:
    """The text, with an apostrophe in front if a spreadsheet would take it for a formula; numbers are unchanged."""
    return f"'{cell}" if re.match(r"[=+@\t\r]|-(?![\d.])", cell) else cell


def _text(row: Mapping[str, Any], name: str) -> str:
    value = row.get(name)
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
