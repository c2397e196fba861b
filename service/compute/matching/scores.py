"""Runs a matching method on the pairs of a data set, and scores its matches and the relative pose that they give."""

from __future__ import annotations

import time
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.images.photographs import read_image
from service.compute.matching.loader import OCCLUDED, OUTSIDE, UNKNOWN, MatchingData, Pair, View, correspondences
from service.compute.matching.methods import Match, Matches, Picture
from service.compute.matching.pairs import CLASSES
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, skew
from service.core.units import deg

PRECISION_PX = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0)  # at which precision is measured; 1, 3 and 5 px are in the tables


def match_errors_px(matches: Matches, first: View, second: View) -> Array:
    """Return errors (M,): distance of each match in the second image from its true place there.

    Infinite where the second image does not show the point, so that there is nothing to match. NaN without ground
    truth, such as beside the specimen or on a marker: such matches are not scored.
    """
    truth = correspondences(first, second, matches.first_px)
    error = np.linalg.norm(matches.second_px - truth.second_px, axis=1)
    error[(truth.status == OCCLUDED) | (truth.status == OUTSIDE)] = np.inf
    error[truth.status == UNKNOWN] = np.nan
    return error


def precisions(errors_px: Array) -> tuple[float, ...]:
    """Return the share of the scored matches within each of PRECISION_PX; 0 if none is scored."""
    scored = errors_px[~np.isnan(errors_px)]
    return tuple(float(np.mean(scored < limit)) if len(scored) else 0.0 for limit in PRECISION_PX)


def fundamental_matrix(T_second_first: Transform, K_first: Array, K_second: Array) -> Array:
    """Return F (3, 3) with x_second^T F x_first = 0 for corresponding pixels (Hartley and Zisserman 2004, 9.2.4)."""
    E = skew(T_second_first[:3, 3]) @ T_second_first[:3, :3]
    return np.linalg.inv(K_second).T @ E @ np.linalg.inv(K_first)


def epipolar_errors_px(matches: Matches, F: Array) -> Array:
    """Return (M,) mean distance of both pixels of a match from the epipolar line of the other."""
    first, second = (
        np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        for pixels in (matches.first_px, matches.second_px)
    )
    lines = first @ F.T, second @ F
    product = np.abs(np.sum(second * lines[0], axis=1))
    lengths = [np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-300) for line in lines]
    return 0.5 * (product / lengths[0] + product / lengths[1])


THRESHOLDS_DEG = (5.0, 10.0, 20.0)
INLIER_PX = 1.0
_LEAST = 5  # matches that determine an essential matrix
_CONFIDENCE, _ITERATIONS = 0.99999, 10_000
_FARTHEST = 1e4  # distance of a point, in baselines, up to which it counts as in front of the cameras


@dataclass(frozen=True, slots=True)
class PoseError:
    """Angles between an estimated relative pose and the true one, degrees.

    Attributes:
        rotation_deg: angle of the rotation that is left.
        translation_deg: angle between the directions of the translations, at most 90°: an essential matrix does not
            give their sign.
    """

    rotation_deg: float
    translation_deg: float

    @property
    def worst_deg(self) -> float:
        """The larger of the two errors, which is the one that counts."""
        return max(self.rotation_deg, self.translation_deg)


def pose_from_matches(matches: Matches, K_first: Array, K_second: Array) -> tuple[Array, Array, int]:
    """Return the rotation (3, 3), direction (3,) of the translation of T_second_first, and the number of inliers.

    An essential matrix by MAGSAC++ (Barath et al., CVPR 2020), as OpenCV's USAC has it, with a threshold of INLIER_PX
    in images of the mean focal length. The same matches give the same pose.

    Raises:
        ComputeError: there are too few matches, or no pose fits them.
    """
    if len(matches.first_px) < _LEAST:
        raise ComputeError(f"{len(matches.first_px)} matches give no pose")
    focal = float(np.mean([K[k, k] for K in (K_first, K_second) for k in (0, 1)]))
    K = np.diag([focal, focal, 1.0])
    points = [
        focal * (pixels - [M[0, 2], M[1, 2]]) / [M[0, 0], M[1, 1]]
        for pixels, M in ((matches.first_px, K_first), (matches.second_px, K_second))
    ]
    try:
        E, inliers = cv2.findEssentialMat(
            points[0], points[1], K, cv2.USAC_MAGSAC, _CONFIDENCE, INLIER_PX, maxIters=_ITERATIONS
        )
    except cv2.error as error:
        raise ComputeError("no essential matrix fits the matches") from error
    found = np.asarray(E, dtype=np.float64)  # NaN without a shape, if there is none
    if found.shape != (3, 3) or not np.isfinite(found).all():
        raise ComputeError("no essential matrix fits the matches")
    count, R, t, *_ = cv2.recoverPose(found, points[0], points[1], K, _FARTHEST, mask=np.array(inliers))
    if count == 0:
        raise ComputeError("no match lies in front of both cameras")
    return np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel(), int(count)


def pose_error(R: Array, direction: Array, T_second_first: Transform) -> PoseError:
    """Return the error of a rotation (3, 3) and a direction (3,) of translation."""
    rotation_rad = float(Rotation.from_matrix(R @ T_second_first[:3, :3].T).magnitude())
    true = T_second_first[:3, 3]
    cosine = float(direction @ true / max(np.linalg.norm(direction) * np.linalg.norm(true), 1e-300))
    return PoseError(deg(rotation_rad), deg(float(np.arccos(min(abs(cosine), 1.0)))))


def auc(errors_deg: Sequence[float], threshold_deg: float) -> float:
    """Return the area under the cumulative curve of pose errors up to a threshold, over the threshold: 0 to 1.

    Defined as in Sarlin et al. (SuperGlue, CVPR 2020) and later work. The curve is piecewise linear from (0, 0)
    through (error k, k / n), with the errors in order, and level from the last error below the threshold. A pair
    without a pose has an infinite error.

    Raises:
        ComputeError: there is no error.
    """
    if not errors_deg:
        raise ComputeError("there is no pair to score")
    below = sorted(error for error in errors_deg if error < threshold_deg)
    share = np.arange(len(below) + 1) / len(errors_deg)
    x = np.array([0.0, *below, threshold_deg])
    return float(np.trapezoid(np.append(share, share[-1]), x)) / threshold_deg


_KEPT = 12  # views in memory
DAMAGED = (OSError, KeyError, ValueError, TypeError, IndexError, EOFError, zipfile.BadZipFile, zlib.error)
_NO_POSE = PoseError(float("inf"), float("inf"))

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class PairScore:
    """The result of a method on a pair.

    Attributes:
        first, second, difficulty: the pair.
        matches: number of matches that it found.
        scored: those whose pixel in the first image has ground truth.
        precision: share of these within each of PRECISION_PX.
        pose: error of the relative pose; infinite without one.
        inliers: matches that agree with the estimated pose.
        epipolar_px: median of the epipolar errors; infinite without a match.
        seconds: time for the matching alone. Features of an image are extracted with its first pair.
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
    """Return the scores of a method on pairs. It is given their pictures alone; poses and depth only judge it.

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
    """Return the score of the matches of a pair."""
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
        """Read a view and its picture.

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
