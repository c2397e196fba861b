"""The relative pose that matches give, its error, and the area under the curve of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.matching.methods.method import Matches
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform
from service.core.units import deg

THRESHOLDS_DEG = (5.0, 10.0, 20.0)
INLIER_PX = 1.0
_LEAST = 5  # matches that determine an essential matrix
_CONFIDENCE, _ITERATIONS = 0.99999, 10_000
_FARTHEST = 1e4  # distance of a point, in baselines, up to which it counts as in front of the cameras


@dataclass(frozen=True, slots=True)
class PoseError:
    """Angles between an estimated relative pose and the true one, degrees.

    Attributes:
        rotation_deg: of the rotation that is left.
        translation_deg: between the directions of the translations, at most 90°: an essential matrix does not tell
            their sign.
    """

    rotation_deg: float
    translation_deg: float

    @property
    def worst_deg(self) -> float:
        """The larger of the two errors, which is the one that counts."""
        return max(self.rotation_deg, self.translation_deg)


def pose_from_matches(matches: Matches, K_first: Array, K_second: Array) -> tuple[Array, Array, int]:
    """Rotation (3, 3), direction (3,) of the translation of T_second_first, and the number of inliers.

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
    """The error of a rotation (3, 3) and a direction (3,) of translation."""
    rotation_rad = float(Rotation.from_matrix(R @ T_second_first[:3, :3].T).magnitude())
    true = T_second_first[:3, 3]
    cosine = float(direction @ true / max(np.linalg.norm(direction) * np.linalg.norm(true), 1e-300))
    return PoseError(deg(rotation_rad), deg(float(np.arccos(min(abs(cosine), 1.0)))))


def auc(errors_deg: Sequence[float], threshold_deg: float) -> float:
    """Area under the cumulative curve of pose errors up to a threshold, over the threshold: 0 to 1.

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
