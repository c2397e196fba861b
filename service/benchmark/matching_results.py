"""Holds the result of a matching method on a data set, as a file and as rows of a table: scores of pairs, classes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator

from service.compute.matching.loader import MatchingData
from service.compute.matching.methods import Matcher
from service.compute.matching.pairs import CLASSES
from service.compute.matching.scores import INLIER_PX, PRECISION_PX, THRESHOLDS_DEG, PairScore, PoseError, auc
from service.core.errors import DataError

ALL = "all"
_Count = Annotated[int, Field(ge=0, le=10**9)]


@dataclass(frozen=True, slots=True)
class ClassScore:
    """The score of a method on a class of pairs.

    Attributes:
        name: the class's name, or ALL.
        pairs: number of pairs.
        auc: area under the curve of the pose error up to each of THRESHOLDS_DEG.
        precision: mean precision over the pairs at each of PRECISION_PX.
        epipolar_px: median over the pairs of their medians; infinite if most have no match.
        matches: mean number of matches.
        scored: share of the matches with ground truth.
        seconds: mean time for a pair.
    """

    name: str
    pairs: int
    auc: tuple[float, ...]
    precision: tuple[float, ...]
    epipolar_px: float
    matches: float
    scored: float
    seconds: float


@dataclass(frozen=True, slots=True)
class MethodResult:
    """The scores of one method on every pair of a list.

    Attributes:
        method, words: its name, and what it is called in tables.
        dataset_sha256: SHA-256 of the list of pairs.
        simulated: no camera was in front of a specimen.
        scores: one score for each pair.
    """

    method: str
    words: str
    dataset_sha256: str
    simulated: bool
    scores: tuple[PairScore, ...] = field(repr=False)

    @property
    def classes(self) -> list[ClassScore]:
        """The classes that have pairs, in order of difficulty, and all pairs together."""
        by = {name: [score for score in self.scores if score.difficulty == name] for name in CLASSES}
        return [class_score(name, scores) for name, scores in [*by.items(), (ALL, list(self.scores))] if scores]


def class_score(name: str, scores: Sequence[PairScore]) -> ClassScore:
    """Return the score of some pairs, at least one."""
    worst = [score.pose.worst_deg for score in scores]
    matches = sum(score.matches for score in scores)
    return ClassScore(
        name,
        len(scores),
        tuple(auc(worst, threshold) for threshold in THRESHOLDS_DEG),
        tuple(float(v) for v in np.mean([score.precision for score in scores], axis=0)),
        float(np.median([score.epipolar_px for score in scores])),
        matches / len(scores),
        sum(score.scored for score in scores) / max(matches, 1),
        float(np.mean([score.seconds for score in scores])),
    )


def result_of(how: Matcher, folder: Path, data: MatchingData, scores: Sequence[PairScore]) -> MethodResult:
    """Return the result of a method on the data set in a folder."""
    sha256 = hashlib.sha256((folder / "pairs.json").read_bytes()).hexdigest()
    return MethodResult(how.name, how.words, sha256, data.simulated, tuple(scores))


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class _PairRecord(_Record):
    first: str
    second: str
    difficulty: str
    matches: _Count
    scored: _Count
    precision: dict[str, FiniteFloat]
    rotation_deg: FiniteFloat | None
    translation_deg: FiniteFloat | None
    inliers: _Count
    epipolar_px: FiniteFloat | None
    seconds: FiniteFloat

    @field_validator("precision")
    @classmethod
    def _at_each_threshold(cls, found: dict[str, float]) -> dict[str, float]:
        if list(found) != [f"{threshold:g}" for threshold in PRECISION_PX]:
            raise ValueError("the precision is not stated at the thresholds of the table")
        return found


class _ResultRecord(_Record):
    method: str
    words: str
    dataset_sha256: str
    simulated: bool
    classes: dict[str, dict[str, Any]]
    pairs: list[_PairRecord]


def record(result: MethodResult) -> dict[str, Any]:
    """Return the result as plain data; infinite numbers become null."""
    pairs = [
        {
            "first": score.first,
            "second": score.second,
            "difficulty": score.difficulty,
            "matches": score.matches,
            "scored": score.scored,
            "precision": _by_threshold(PRECISION_PX, score.precision),
            "rotation_deg": _finite(score.pose.rotation_deg),
            "translation_deg": _finite(score.pose.translation_deg),
            "inliers": score.inliers,
            "epipolar_px": _finite(score.epipolar_px),
            "seconds": score.seconds,
        }
        for score in result.scores
    ]
    return {
        "method": result.method,
        "words": result.words,
        "dataset_sha256": result.dataset_sha256,
        "simulated": result.simulated,
        "classes": {one.name: _class_record(one) for one in result.classes},
        "pairs": pairs,
    }


def read_result(path: Path) -> MethodResult:
    """Read a result as `record` wrote it.

    Raises:
        DataError: the file is something else.
    """
    try:
        found = _ResultRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise DataError(
            "this is not the result of a matching method", where=str(path), remedy="Run it again"
        ) from error
    scores = tuple(
        PairScore(
            pair.first,
            pair.second,
            pair.difficulty,
            pair.matches,
            pair.scored,
            tuple(pair.precision.values()),
            PoseError(_number(pair.rotation_deg), _number(pair.translation_deg)),
            pair.inliers,
            _number(pair.epipolar_px),
            pair.seconds,
        )
        for pair in found.pairs
    )
    return MethodResult(found.method, found.words, found.dataset_sha256, found.simulated, scores)


def write_result(path: Path, result: MethodResult) -> None:
    """Write a result as JSON."""
    path.write_text(json.dumps(record(result), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _class_record(one: ClassScore) -> dict[str, Any]:
    return {
        "pairs": one.pairs,
        "auc": _by_threshold(THRESHOLDS_DEG, one.auc),
        "precision": _by_threshold(PRECISION_PX, one.precision),
        "epipolar_px": _finite(one.epipolar_px),
        "matches": one.matches,
        "scored": one.scored,
        "seconds": one.seconds,
    }


def _by_threshold(thresholds: Sequence[float], values: Sequence[float]) -> dict[str, float]:
    return {f"{threshold:g}": value for threshold, value in zip(thresholds, values, strict=True)}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _number(value: float | None) -> float:
    return float("inf") if value is None else value


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
    """Return the rows below HEADER: each method on each class of pairs."""
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
    """Return the table as Markdown, with what its columns mean."""
    lines = ["| " + " | ".join(HEADER) + " |", "|---|---|" + "---:|" * (len(HEADER) - 2)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(results)]
    names = "\n".join(f"- `{result.method}`: {result.words}" for result in results)
    mark = "\n\nThe data set is simulated." if any(result.simulated for result in results) else ""
    return "\n".join(lines) + f"\n\n{names}\n\n{_NOTES}{mark}\n"
