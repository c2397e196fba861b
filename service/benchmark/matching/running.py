"""Runs a method of matching on an exported data set, and writes its result beside those of other methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import FiniteFloat, TypeAdapter

from service.benchmark.matching.plots import curves_png, matches_picture, png
from service.benchmark.matching.result import MethodResult, read_result, result_of, write_result
from service.benchmark.matching.table import markdown
from service.compute.matching.methods.method import Match, Matcher
from service.compute.matching.pairs.difficulty import CLASSES
from service.compute.matching.pairs.loader import MatchingData, Pair
from service.compute.matching.scores.evaluate import DAMAGED, LoadedViews, Progress, chosen_pairs, evaluate
from service.compute.matching.scores.matches import match_errors_px
from service.core.errors import DataError

_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


@dataclass(frozen=True, slots=True)
class _Pair:
    """What has to be right about a pair of the list."""

    first: str
    second: str
    difficulty: str
    angle_deg: FiniteFloat
    T_second_first: tuple[_Row, _Row, _Row, _Row]


@dataclass(frozen=True, slots=True)
class MatchingTask:
    """What is to be run.

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
        ConfigurationError: what the method needs is not installed or not given.
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
    """The pairs of an exported data set.

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
    """The results of earlier runs in a folder.

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
    """The middle pair of each class, with its matches."""
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
