"""Runs a method on the pairs of a data set, and scores what it finds."""

from __future__ import annotations

import time
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from service.compute.images.files import read_image
from service.compute.matching.methods.method import Match, Matches, Picture
from service.compute.matching.pairs.difficulty import CLASSES
from service.compute.matching.pairs.loader import MatchingData, Pair, View
from service.compute.matching.scores.matches import (
    epipolar_errors_px,
    fundamental_matrix,
    match_errors_px,
    precisions,
)
from service.compute.matching.scores.pose import PoseError, pose_error, pose_from_matches
from service.core.errors import ComputeError, DataError

_KEPT = 12  # views in memory
DAMAGED = (OSError, KeyError, ValueError, TypeError, IndexError, EOFError, zipfile.BadZipFile, zlib.error)
_NO_POSE = PoseError(float("inf"), float("inf"))

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class PairScore:
    """What a method did on a pair.

    Attributes:
        first, second, difficulty: the pair.
        matches: that it found.
        scored: those whose pixel in the first image has ground truth.
        precision: share of these within each of PRECISION_PX.
        pose: error of the relative pose; infinite without one.
        inliers: matches that agree with the estimated pose.
        epipolar_px: median of the epipolar errors; infinite without a match.
        seconds: for the matching alone. Features of an image are extracted with its first pair.
    """

    first: str
    second: str
    difficulty: str
    matches: int
    scored: int
    precision: tuple[float, ...]
    pose: PoseError
    inliers: int
    epipolar_px: float
    seconds: float


def chosen_pairs(pairs: Sequence[Pair], per_class: int) -> list[Pair]:
    """Choose up to `per_class` pairs of each class (0: all), evenly from the list, so every method gets the same."""
    chosen: list[Pair] = []
    for name in CLASSES:
        same = [pair for pair in pairs if pair["difficulty"] == name]
        count = min(per_class, len(same)) if per_class else len(same)
        chosen += [same[k * len(same) // count] for k in range(count)]
    return chosen


def evaluate(match: Match, data: MatchingData, pairs: Sequence[Pair], progress: Progress) -> list[PairScore]:
    """The scores of a method on pairs. It is given their pictures alone; poses and depth only judge it.

    Raises:
        DataError: a file of the data set cannot be read.
    """
    views = LoadedViews(data)
    scores: list[PairScore] = []
    for number, pair in enumerate(pairs):
        progress("matching", number, len(pairs))
        (first, one), (second, other) = (views.read(pair[name]) for name in ("first", "second"))
        began = time.perf_counter()
        found = match(one.copy(), other.copy())  # it may write on them
        scores.append(score_pair(found, pair, first, second, round(time.perf_counter() - began, 3)))
    progress("matching", len(pairs), len(pairs))
    return scores


def score_pair(found: Matches, pair: Pair, first: View, second: View, seconds: float) -> PairScore:
    """The score of the matches of a pair."""
    T_second_first = np.array(pair["T_second_first"])
    errors = match_errors_px(found, first, second)
    epipolar = epipolar_errors_px(found, fundamental_matrix(T_second_first, first.K, second.K))
    try:
        R, direction, inliers = pose_from_matches(found, first.K, second.K)
        error = pose_error(R, direction, T_second_first)
    except ComputeError:
        error, inliers = _NO_POSE, 0
    return PairScore(
        pair["first"],
        pair["second"],
        pair["difficulty"],
        len(errors),
        int(np.count_nonzero(~np.isnan(errors))),
        precisions(errors),
        error,
        inliers,
        float(np.median(epipolar)) if len(epipolar) else float("inf"),
        seconds,
    )


class LoadedViews:
    """Views of a data set with their pictures; those used last stay in memory."""

    def __init__(self, data: MatchingData) -> None:
        self._data = data
        self._known: OrderedDict[str, tuple[View, Picture]] = OrderedDict()

    def read(self, name: str) -> tuple[View, Picture]:
        """A view and its picture.

        Raises:
            DataError: a file cannot be read.
        """
        if name not in self._known:
            try:
                view = self._data.view(name)
            except DAMAGED as error:
                raise DataError("the depth of a view cannot be read", where=name, remedy="Export it again") from error
            picture = read_image(view.picture)
            if picture.shape[:2] != view.depth_m.shape:
                raise DataError("image and depth differ in size", where=name, remedy="Export the data set again")
            self._known[name] = view, picture
        self._known.move_to_end(name)
        while len(self._known) > _KEPT:
            self._known.popitem(last=False)
        return self._known[name]
