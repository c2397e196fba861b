"""Runs a method of matching on an exported data set; its result is a file, rows of a table, and plots."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError, field_validator

from service.compute.matching.loader import MatchingData, Pair
from service.compute.matching.methods import Match, Matcher, Matches, Picture
from service.compute.matching.pairs import CLASSES
from service.compute.matching.scores import (
    DAMAGED,
    INLIER_PX,
    PRECISION_PX,
    THRESHOLDS_DEG,
    LoadedViews,
    PairScore,
    PoseError,
    Progress,
    auc,
    chosen_pairs,
    evaluate,
    match_errors_px,
)
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array

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
    """Return the table's rows, of the columns HEADER: one for each method and each difficulty of pairs."""
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


_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


@dataclass(frozen=True, slots=True)
class _Pair:
    """A pair of the list, with the fields that are checked when the list is read."""

    first: str
    second: str
    difficulty: str
    angle_deg: FiniteFloat
    T_second_first: tuple[_Row, _Row, _Row, _Row]


@dataclass(frozen=True, slots=True)
class MatchingTask:
    """One run of a matching method: the data set, the method and where its result goes.

    Attributes:
        dataset: folder exported with the format `matching`.
        how: the method.
        weights: its file of weights, if it has one.
        per_class: pairs of each class at most; 0: all.
        out: folder for the result; it may hold those of other methods on the same pairs.
    """

    dataset: Path
    how: Matcher
    weights: Path | None
    per_class: int
    out: Path


_PAIRS = TypeAdapter(tuple[_Pair, ...])


def run_matching(wanted: MatchingTask, progress: Progress) -> list[MethodResult]:
    """Run a method, and write METHOD.json, METHOD_CLASS.png, table.md and curves.png of all methods there.

    Returns:
        all results, by the names of their methods.

    Raises:
        ConfigurationError: the method's weights or packages are not installed or not given.
        DataError: the data set or a result in the folder cannot be read, or results are of other pairs.
    """
    data = open_matching_data(wanted.dataset)
    pairs = chosen_pairs(data.pairs, wanted.per_class)
    if not pairs:
        raise DataError("no pair of images overlaps", where=str(wanted.dataset), remedy="Export more views")
    others = {result.method: result for result in results_in(wanted.out)}
    others.pop(wanted.how.name, None)
    match = wanted.how.load(wanted.weights)
    own = result_of(wanted.how, wanted.dataset, data, evaluate(match, data, pairs, progress))
    results = [result for _, result in sorted((others | {own.method: own}).items())]
    require_same_pairs(results, wanted.out)
    write_result(wanted.out / f"{own.method}.json", own)
    (wanted.out / "table.md").write_text(markdown(results), encoding="utf-8")
    (wanted.out / "curves.png").write_bytes(curves_png(results))
    _write_examples(wanted, match, data, pairs)
    return results


def open_matching_data(folder: Path) -> MatchingData:
    """Return the pairs of an exported data set.

    Raises:
        DataError: the folder holds none.
    """
    try:
        data = MatchingData(folder)
        _PAIRS.validate_python(data.pairs)
        unknown = {pair[end] for pair in data.pairs for end in ("first", "second")} - data.names
        if unknown:
            raise ValueError(f"{min(unknown)} is not among the views")
    except DAMAGED as error:
        raise DataError(
            "this is not a data set for feature matching",
            where=str(folder),
            remedy="Export one: orthocapture export RUN --format matching --out DIR",
        ) from error
    return data


def results_in(folder: Path) -> list[MethodResult]:
    """Return the results of earlier runs in a folder.

    Raises:
        DataError: a JSON file there is something else.
    """
    return [read_result(path) for path in sorted(folder.glob("*.json"))]


def require_same_pairs(results: Sequence[MethodResult], folder: Path) -> None:
    """Raise DataError unless all results are of the same pairs of the same data set."""
    of = {(r.dataset_sha256, tuple((score.first, score.second) for score in r.scores)) for r in results}
    if len(of) > 1:
        raise DataError(
            "results of other pairs are in this folder, with which these cannot be compared",
            where=str(folder),
            remedy="Give a new folder with --out, or the same data set and --pairs-per-class as before",
        )


def _write_examples(wanted: MatchingTask, match: Match, data: MatchingData, pairs: Sequence[Pair]) -> None:
    """Draw the middle pair of each class, with its matches."""
    views = LoadedViews(data)
    for name in CLASSES:
        same = [pair for pair in pairs if pair["difficulty"] == name]
        if not same:
            continue
        pair = same[len(same) // 2]
        (first, one), (second, other) = (views.read(pair[key]) for key in ("first", "second"))
        found = match(one.copy(), other.copy())
        errors = match_errors_px(found, first, second)
        caption = (
            f"{name}: {pair['first']} and {pair['second']}, {pair['angle_deg']:.0f} degrees, {len(errors)} matches"
        )
        picture = matches_picture(one, other, found, errors, caption)
        (wanted.out / f"{wanted.how.name}_{name}.png").write_bytes(png(picture))


Canvas = NDArray[np.uint8]
Curve = tuple[Array, Array]  # x, and y from 0 to 1

_PANEL, _LEFT, _TOP, _BOTTOM = 340, 52, 46, 48
_LARGEST_DEG, _TICKS_DEG = 20.0, (0, 5, 10, 15, 20)
_INK, _GREY = (40, 40, 40), (205, 205, 205)
_COLOURS = ((180, 90, 20), (40, 90, 220), (60, 150, 60), (150, 60, 150), (30, 160, 200))  # blue first
_GOOD, _BAD, _UNSCORED = (70, 170, 40), (50, 50, 220), (170, 170, 170)
_RIGHT_PX = 3.0  # a match within is drawn as right
_PICTURE_WIDTH, _MOST_LINES = 900, 120


def curves_png(results: Sequence[MethodResult]) -> bytes:
    """Return the panels by class: above, the share of pairs below each pose error; below, precision by distance.

    Raises:
        ComputeError: the picture cannot be encoded.
    """
    classes = [name for name in CLASSES if any(s.difficulty == name for r in results for s in r.scores)]
    upper: list[Canvas] = []
    lower: list[Canvas] = []
    for name in classes:
        scores = [[score for score in result.scores if score.difficulty == name] for result in results]
        count = max(len(own) for own in scores)
        panel = _Panel(f"{name} ({count} pairs)", "pose error, degrees", _LARGEST_DEG, _TICKS_DEG)
        upper.append(panel.drawn([_pose_curve(own) for own in scores]))
        panel = _Panel(name, "distance from the truth, px", PRECISION_PX[-1], (0, 1, 3, 5, 10))
        lower.append(panel.drawn([_precision_curve(own) for own in scores]))
    body = np.vstack([_titled("share of pairs", np.hstack(upper)), _titled("precision", np.hstack(lower))])
    return png(np.vstack([body, _legend(results, body.shape[1])]))


def _pose_curve(scores: Sequence[PairScore]) -> Curve:
    worst = np.sort([score.pose.worst_deg for score in scores])
    below = worst[worst < _LARGEST_DEG]
    share = np.arange(len(below) + 1) / max(len(worst), 1)
    return np.concatenate([[0.0], below, [_LARGEST_DEG]]), np.append(share, share[-1])


def _precision_curve(scores: Sequence[PairScore]) -> Curve:
    mean = np.mean([score.precision for score in scores], axis=0) if scores else np.zeros(len(PRECISION_PX))
    return np.array([0.0, *PRECISION_PX]), np.concatenate([[0.0], mean])


class _Panel:
    """Axes from 0 to 1 upwards."""

    def __init__(self, title: str, label: str, most: float, ticks: Sequence[int]) -> None:
        self._title, self._label, self._most, self._ticks = title, label, most, ticks

    def drawn(self, curves: Sequence[Curve]) -> Canvas:
        canvas = np.full((_PANEL, _PANEL, 3), 255, dtype=np.uint8)
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            left, right = self._at(0.0, share), self._at(self._most, share)
            cv2.line(canvas, left, right, _GREY, 1)
            _text(canvas, f"{100 * share:.0f} %", (4, left[1] + 4))
        for tick in self._ticks:
            x, y = self._at(tick, 0.0)
            cv2.line(canvas, (x, y), (x, y + 4), _INK, 1)
            _text(canvas, str(tick), (x - 4 * len(str(tick)), y + 18))
        _text(canvas, self._title, (_LEFT, _TOP - 14), 0.5)
        _text(canvas, self._label, (_LEFT, _PANEL - 8))
        for (x, y), colour in zip(curves, _cycled(len(curves)), strict=True):
            line = np.array([self._at(a, b) for a, b in zip(x, y, strict=True)], dtype=np.int32)
            cv2.polylines(canvas, [line], False, colour, 2, cv2.LINE_AA)
        return canvas

    def _at(self, x: float, y: float) -> tuple[int, int]:
        width, height = _PANEL - _LEFT - 14, _PANEL - _TOP - _BOTTOM
        return round(_LEFT + x / self._most * width), round(_PANEL - _BOTTOM - y * height)


def matches_picture(first: Picture, second: Picture, found: Matches, errors_px: Array, caption: str) -> Canvas:
    """Return both pictures with some of the matches: green within 3 px, red beyond, grey without ground truth."""
    scale = _PICTURE_WIDTH / first.shape[1]
    height = round(scale * max(first.shape[0], second.shape[0]))
    sides = [cv2.resize(picture, (_PICTURE_WIDTH, round(picture.shape[0] * scale))) for picture in (first, second)]
    canvas = np.full((height + 34, 2 * _PICTURE_WIDTH, 3), 255, dtype=np.uint8)
    for k, side in enumerate(sides):
        canvas[34 : 34 + side.shape[0], k * _PICTURE_WIDTH : (k + 1) * _PICTURE_WIDTH] = side
    _text(canvas, caption, (8, 22), 0.55)
    step = max(1, len(errors_px) // _MOST_LINES)
    for k in range(0, len(errors_px), step):
        error = errors_px[k]
        colour = _UNSCORED if np.isnan(error) else _GOOD if error < _RIGHT_PX else _BAD
        a, b = (np.rint(scale * (pixel + 0.5) - 0.5).astype(int) for pixel in (found.first_px[k], found.second_px[k]))
        ends = (int(a[0]), int(a[1]) + 34), (int(b[0]) + _PICTURE_WIDTH, int(b[1]) + 34)
        cv2.line(canvas, *ends, colour, 1, cv2.LINE_AA)
        for end in ends:
            cv2.circle(canvas, end, 3, colour, 1, cv2.LINE_AA)
    return canvas


def png(canvas: Canvas) -> bytes:
    """Return the picture as a PNG file.

    Raises:
        ComputeError: it cannot be encoded.
    """
    done, data = cv2.imencode(".png", canvas)
    if not done:
        raise ComputeError("a plot cannot be written as PNG")
    return data.tobytes()


def _titled(title: str, body: Canvas) -> Canvas:
    head = np.full((30, body.shape[1], 3), 255, dtype=np.uint8)
    _text(head, title, (8, 21), 0.6)
    return np.vstack([head, body])


def _legend(results: Sequence[MethodResult], width: int) -> Canvas:
    mark = ["The data set is simulated."] if any(result.simulated for result in results) else []
    canvas = np.full((26 * (len(results) + len(mark)) + 10, width, 3), 255, dtype=np.uint8)
    for k, (result, colour) in enumerate(zip(results, _cycled(len(results)), strict=True)):
        y = 20 + 26 * k
        cv2.line(canvas, (12, y - 5), (44, y - 5), colour, 2, cv2.LINE_AA)
        _text(canvas, f"{result.method}: {result.words}", (54, y), 0.5)
    for sentence in mark:
        _text(canvas, sentence, (12, 20 + 26 * len(results)), 0.5)
    return canvas


def _cycled(count: int) -> list[tuple[int, int, int]]:
    return [_COLOURS[k % len(_COLOURS)] for k in range(count)]


def _text(canvas: Canvas, text: str, at: tuple[int, int], size: float = 0.42) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)
