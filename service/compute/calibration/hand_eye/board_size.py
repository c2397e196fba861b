"""The board's size by the robot's lengths: its ratio to the stated size, whether that is credible, and what it means.

The stated size of a board scales the camera's distance from it. The robot is the second ruler: it moves by known
lengths between the images. Where the two differ by more than the board's tolerance and the uncertainty of the
comparison, one of them is wrong, and a fit would hide the difference in the camera's position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.compute.calibration.board.board import Board
from service.compute.calibration.hand_eye.fit import HandEyeMeasurements, HandEyeSolution
from service.compute.calibration.hand_eye.weighted import resample
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import deg, mistaken_length, mm

_RULER = 3e-4  # relative error of the lengths of an arm that was not measured
_SURE = 3.0  # standard deviations
_UNEXPLAINED = 4.0  # times as much scatter in position as the rotations explain
_USUAL_M = 1.5e-3  # along each axis; joints of which one errs more than the others reach this in position alone
_LIKE = 0.05  # relative difference up to which a ratio counts as a known one
#: Ratios of true to stated size that mistakes other than of the unit lead to.
_KNOWN: tuple[tuple[float, str], ...] = (
    (2.0, "the distance of two rows of circles, or half a square, given for the whole has this ratio"),
    (0.5, "the distance of two circles in a row, or two squares, given for one has this ratio"),
    (4 / 3, "the side of a marker given for that of its square has this ratio"),
    (0.75, "the side of a square given for that of its marker has this ratio"),
)
_PRINTED = (0.85, 1.18)  # A4 on Letter and back, and the printers' "fit to page"


@dataclass(frozen=True, slots=True)
class BoardSizeFound:
    """The board's true size over the stated one, as the robot's lengths show it.

    Attributes:
        ratio: by robot and images alone.
        sigma: standard deviation of `ratio`, without that of the robot's own lengths.
        tolerance: stated for the board: the largest relative error of its size.
        used: in the answer: `ratio` and the stated size, weighted.
        square_m: the stated side of a square; None if none was stated.
    """

    ratio: float
    sigma: float
    tolerance: float
    used: float
    square_m: float | None

    @property
    def credible(self) -> bool:
        """Whether the difference lies within tolerance, uncertainty and the arm's own lengths."""
        return abs(self.ratio - 1) <= _SURE * float(np.hypot(self.sigma, _RULER)) + self.tolerance

    @property
    def words(self) -> str:
        """`the squares are 14.50 ± 0.01 mm by the robot, 15 were given`."""
        if self.square_m is None:
            return f"by the robot the board is {self.ratio:.4f} ± {self.sigma:.4f} times as large as stated"
        found, spread = mm(self.ratio * self.square_m), mm(self.sigma * self.square_m)
        digits = int(np.clip(1 - np.floor(np.log10(max(spread, 1e-9))), 2, 5))
        given = f"{mm(self.square_m):g} were given"
        return f"the squares are {found:.{digits}f} ± {spread:.{digits}f} mm by the robot, {given}"

    def require_credible(self) -> None:
        """Raise ComputeError, with the ratio's likely cause, unless the size is credible."""
        if self.credible:
            return
        likely = _likely(self.ratio)
        raise ComputeError(
            f"{self.words} (ratio {self.ratio:.4f}{likely}); the board's tolerance is {100 * self.tolerance:.2g} %",
            remedy="Measure ten squares with a ruler and give their true size; if it is right, check that the "
            "robot's positions are in the stated unit and that its model is the mounted arm",
        )


def _likely(ratio: float) -> str:
    unit = mistaken_length(ratio, _LIKE)
    if unit:
        return f": {unit} have this ratio"
    for known, words in _KNOWN:
        if abs(ratio / known - 1) < _LIKE:
            return f": {words}"
    low, high = _PRINTED
    return ": a printer that fits pages to paper does this" if low < ratio < high else ""


def size_sigma(tolerance: float) -> float:
    """Standard deviation of a size whose error is anything within a tolerance."""
    return tolerance / float(np.sqrt(3))


def size_found(free: HandEyeSolution, used: float, board: Board | None, counts: Array) -> BoardSizeFound:
    """The board's size by robot and images alone.

    Args:
        free: answer of the weighted fit that knows nothing of the board's size.
        used: the board's scale in the answer that weighs the stated size too.
        board: as described; None: its size is exactly known.
        counts: (R, N) how often each view counts in each replicate of a bootstrap.
    """
    assert free.views is not None
    assert free.noise is not None
    assert free.fit is not None
    scatter = float(np.std(resample(free.views, free.noise, free.fit, counts)[:, 12])) if len(counts) > 1 else 0.0
    tolerance, square_m = (0.0, None) if board is None else (board.size_tolerance, board.square_m)
    return BoardSizeFound(free.scale, max(scatter, free.scale_sigma), tolerance, used, square_m)


def contradictions(data: HandEyeMeasurements, answer: HandEyeSolution) -> tuple[str, ...]:
    """What robot and images say differently, in words, though they agree on the board's size.

    An arm errs by its joints' angles, so its positions err by no more than its rotations do at the length of the arm.
    Positions that scatter more than that contradict the images in another way.
    """
    assert answer.noise is not None
    reach_m = float(np.median(np.linalg.norm(data.hands[:, :3, 3], axis=1)))
    images_rad = float(np.sqrt(np.median(np.trace(data.covariance[:, 3:, 3:], axis1=1, axis2=2)) / 3))
    explained_m = reach_m * float(np.hypot(answer.noise.robot_rad, images_rad))
    least_m = max(_UNEXPLAINED * explained_m, _USUAL_M)
    if answer.noise.robot_m <= least_m:
        return ()
    return (
        f"the robot's positions scatter by {mm(answer.noise.robot_m):.2f} mm along each axis, its rotations only by "
        f"{deg(answer.noise.robot_rad):.4f}° (at its reach {mm(explained_m):.2f} mm): look for a board that is bent "
        "or moved, a lens that was refocused, or positions with another tool or payload",
    )
