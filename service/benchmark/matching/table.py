"""The table of a benchmark of matching: rows of text, and Markdown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.benchmark.matching.result import ClassScore, MethodResult
from service.compute.matching.scores.matches import PRECISION_PX
from service.compute.matching.scores.pose import INLIER_PX, THRESHOLDS_DEG

_PRECISION_SHOWN = (1.0, 3.0, 5.0)
HEADER = (
    "method", "pairs", "number",
    *(f"AUC {threshold:g}°" for threshold in THRESHOLDS_DEG),
    *(f"precision {limit:g} px" for limit in _PRECISION_SHOWN),
    "epipolar px", "matches", "scored", "s per pair",
)  # fmt: skip
_NOTES = f"""\
AUC: area under the cumulative curve of the pose error, the larger of the angles of rotation and translation, in
per cent of the largest possible (as SuperGlue, CVPR 2020); poses by MAGSAC++ with {INLIER_PX:g} px. Precision:
share of the scored matches within so many pixels of the true correspondence, mean over the pairs; a match of a
point that the second image does not show is wrong. Scored: share of the matches that have ground truth.
Epipolar: median over the pairs of the median distance from the epipolar lines."""


def rows(results: Sequence[MethodResult]) -> list[tuple[str, ...]]:
    """Rows below HEADER: each method on each class of pairs."""
    return [(result.method, *_cells(one)) for result in results for one in result.classes]


def _cells(one: ClassScore) -> tuple[str, ...]:
    precision = [one.precision[PRECISION_PX.index(limit)] for limit in _PRECISION_SHOWN]
    return (
        one.name,
        str(one.pairs),
        *(f"{100 * value:.1f}" for value in (*one.auc, *precision)),
        f"{one.epipolar_px:.2f}" if np.isfinite(one.epipolar_px) else "–",
        f"{one.matches:.0f}",
        f"{100 * one.scored:.0f} %",
        f"{one.seconds:.2f}",
    )


def markdown(results: Sequence[MethodResult]) -> str:
    """The table as Markdown, with what its columns mean."""
    lines = ["| " + " | ".join(HEADER) + " |", "|---|---|" + "---:|" * (len(HEADER) - 2)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(results)]
    names = "\n".join(f"- `{result.method}`: {result.words}" for result in results)
    mark = "\n\nThe data set is simulated." if any(result.simulated for result in results) else ""
    return "\n".join(lines) + f"\n\n{names}\n\n{_NOTES}{mark}\n"
