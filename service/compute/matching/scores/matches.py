"""How far matches are from the true correspondences and from the epipolar lines."""

from __future__ import annotations

import numpy as np

from service.compute.matching.methods.method import Matches
from service.compute.matching.pairs.loader import OCCLUDED, OUTSIDE, UNKNOWN, View, correspondences
from service.core.geometry import Array, Transform, skew

PRECISION_PX = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0)  # at which precision is measured; 1, 3 and 5 px are in the tables


def match_errors_px(matches: Matches, first: View, second: View) -> Array:
    """Errors (M,): distance of each match in the second image from the true correspondence of its pixel in the first.

    Infinite where the second image does not show the point, so that there is nothing to match. NaN without ground
    truth, such as beside the specimen or on a marker: such matches are not scored.
    """
    truth = correspondences(first, second, matches.first_px)
    error = np.linalg.norm(matches.second_px - truth.second_px, axis=1)
    error[(truth.status == OCCLUDED) | (truth.status == OUTSIDE)] = np.inf
    error[truth.status == UNKNOWN] = np.nan
    return error


def precisions(errors_px: Array) -> tuple[float, ...]:
    """Share of the scored matches within each of PRECISION_PX; 0 if none is scored."""
    scored = errors_px[~np.isnan(errors_px)]
    return tuple(float(np.mean(scored < limit)) if len(scored) else 0.0 for limit in PRECISION_PX)


def fundamental_matrix(T_second_first: Transform, K_first: Array, K_second: Array) -> Array:
    """F (3, 3) with x_second^T F x_first = 0 for corresponding pixels (Hartley and Zisserman, 2nd edition, 9.2.4)."""
    E = skew(T_second_first[:3, 3]) @ T_second_first[:3, :3]
    return np.linalg.inv(K_second).T @ E @ np.linalg.inv(K_first)


def epipolar_errors_px(matches: Matches, F: Array) -> Array:
    """(M,) mean distance of both pixels of a match from the epipolar line of the other."""
    first, second = (
        np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        for pixels in (matches.first_px, matches.second_px)
    )
    lines = first @ F.T, second @ F
    product = np.abs(np.sum(second * lines[0], axis=1))
    lengths = [np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-300) for line in lines]
    return 0.5 * (product / lengths[0] + product / lengths[1])
