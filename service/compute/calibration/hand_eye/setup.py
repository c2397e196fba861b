"""Checks whether robot poses and board images fit together, and names the usual mistake if they do not.

If the camera is on the flange and the board lies still, T_base_flange · X · T_camera_board is constant. A file with
T_flange_base instead, or a camera beside the robot that looks at a board on the flange, gives poses that fit only
when inverted; a file in millimetres fits only with a board a thousand times as large; a file whose quaternions are in
another order, or which lost a row, fits only when it is read so. A solver would still give an answer: a camera metres
away, with centimetres of noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.hand_eye.closed_form import (
    MIN_VIEWS,
    RobustStart,
    deviation,
    robust_start,
    solve_with_scale,
)
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse
from service.core.text.counts import counted
from service.core.units import LENGTH_WORDS, METRES_PER

Setup = Literal["eye-in-hand", "eye-to-hand"]

# If half of the views place the board farther than this from its place, these are not a robot's poses.
_MOST_MM, _MOST_DEG = 25.0, 3.0
_CLEARLY = 3.0  # the true reading's errors are this many times smaller, in position and rotation
_LIKE = 0.12  # relative difference up to which a ratio of lengths counts as that of two units
_LOST_FEWEST = 2  # views that a lost row must explain: an outlier, or two poses that were swapped, explain one
_LOST_SHARE = 0.9  # of the views that fit if a row was lost


@dataclass(frozen=True, slots=True)
class PoseReading:
    """Another way to read the robot's poses.

    Attributes:
        hands: (N, 4, 4) T_base_flange of the views.
        words: what the poses are then, after "they fit".
        remedy: what to do.
    """

    hands: Array
    words: str
    remedy: str


@dataclass(frozen=True, slots=True)
class PosesAsRead:
    """The robot's poses in the file from which they were read.

    Attributes:
        hands: (M, 4, 4) of all rows in the file's order, as they were read.
        rows: (N,) the row of each view.
        images: (N) their names.
        readings: how else the file could be read.
    """

    hands: Array
    rows: NDArray[np.int64]
    images: tuple[str, ...]
    readings: tuple[PoseReading, ...] = ()

    def inverted(self) -> PosesAsRead:
        """The same with every pose inverted."""
        readings = tuple(replace(reading, hands=inverted(reading.hands)) for reading in self.readings)
        return replace(self, hands=inverted(self.hands), readings=readings)


@dataclass(frozen=True, slots=True)
class SetupFit:
    """Agreement of the views under one reading of the poses: medians over the views, and the board's relative size.

    `mm` is a length on the board as it was stated, so that it does not depend on the unit of the robot's positions.
    """

    mm: float
    deg: float
    scale: float

    @property
    def fits(self) -> bool:
        """Whether the errors are small enough for a robot."""
        return self.mm <= _MOST_MM and self.deg <= _MOST_DEG

    def beats(self, other: SetupFit) -> bool:
        """Whether it fits, and so much better that the other reading must be a mistake."""
        return self.fits and _CLEARLY * self.mm < other.mm and _CLEARLY * self.deg < other.deg

    @property
    def unit(self) -> tuple[str, str] | None:
        """The unit of the positions, and its option, if it is not the metre."""
        for unit, metres in METRES_PER.items():
            if metres != 1 and abs(np.log(max(self.scale, 1e-9) * metres)) < _LIKE:
                return LENGTH_WORDS[unit], unit
        return None

    def __str__(self) -> str:
        return f"{self.mm:.3g} mm and {self.deg:.2g}°" if np.isfinite(self.mm) else "by any distance"


def inverted(poses: Array) -> Array:
    """(N, 4, 4) inverses of poses (N, 4, 4)."""
    return np.array([inverse(T) for T in poses])


def check_setup(
    hands: Array, boards: Array, *, point_m: Array, setup: Setup, poses: PosesAsRead | None = None
) -> None:
    """Raise ComputeError unless robot and image poses fit; its message names another reading of them that fits.

    Args:
        hands: (N, 4, 4) T_base_flange, or T_flange_base for a camera beside the robot.
        boards: (N, 4, 4) T_camera_board.
        point_m: (3,) point of the board at which distances are measured.
        setup: the assumed reading of the poses.
        poses: the file from which the poses come, if they come from one.
    """
    as_read = _fit(hands, boards, point_m)
    if as_read.fits and as_read.unit is not None:
        raise _misread(as_read, as_read, "", "")
    for reading in _readings(hands, setup, poses, every=not as_read.fits):
        found = _fit(reading.hands, boards, point_m)
        if found.beats(as_read):
            raise _misread(as_read, found, reading.words, reading.remedy)
    lost = _lost_row(hands, boards, point_m, poses)
    if lost is not None:
        raise ComputeError(
            f"the robot's poses do not fit the images as they are ({as_read} off in the median), but fit {lost}",
            remedy="A row of the poses, or an image, is missing or there twice: give each image its own pose",
        )
    if not as_read.fits:
        apart = f"half of them place the board more than {as_read} from its place"
        raise ComputeError(
            "the robot's poses do not fit the images: "
            f"{apart if np.isfinite(as_read.mm) else 'no place of the board fits even half of them'}, even with the "
            "poses inverted, in another unit, or with the rotations written in another way",
            remedy="Check that each image has its own pose (order, names), that the pose is the flange's, the "
            "order qx,qy,qz,qw, the board's square, camera.json, and that the board lay still",
        )


def _misread(as_read: SetupFit, found: SetupFit, words: str, remedy: str) -> ComputeError:
    unit = found.unit
    if unit is not None:
        words = f"in {unit[0]}{f' and {words}' if words else ''}"
        remedy = f"Write positions in metres, or give --length {unit[1]}. {remedy}".rstrip(" .")
    off = "" if found is as_read else f" ({as_read} off in the median)"
    return ComputeError(
        f"the robot's poses do not fit the images as they are{off}, but fit {words} ({found})", remedy=remedy
    )


def _readings(hands: Array, setup: Setup, poses: PosesAsRead | None, *, every: bool) -> Iterator[PoseReading]:
    """Other ways to read the poses, the likeliest first; without `every` only that which may fit like the first."""
    other: Setup = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    where = (
        "beside the robot, the board on its flange" if other == "eye-to-hand" else "on the flange, the board still"
    )
    yield PoseReading(
        inverted(hands),
        f"inverted: either the file holds T_flange_base, or the camera stands {where}",
        f"Invert the poses in the file, or give --setup {other}",
    )
    if every and poses is not None:
        yield from poses.readings


def _lost_row(hands: Array, boards: Array, point_m: Array, poses: PosesAsRead | None) -> str | None:
    """How the poses fit if a row was lost, or there twice: from one view on, each has its neighbour's pose."""
    if len(hands) < MIN_VIEWS + _LOST_FEWEST:
        return None
    every, rows = (hands, np.arange(len(hands))) if poses is None else (poses.hands, poses.rows)
    found: list[tuple[int, str]] = []
    for step, words in ((1, "after"), (-1, "before")):
        there = (rows + step >= 0) & (rows + step < len(every))
        moved = np.where(there[:, None, None], every[np.clip(rows + step, 0, len(every) - 1)], hands)
        for common in _answers_of_a_half(hands, moved, boards):
            own = _near(common, hands, boards, point_m)
            count, first = _split(own, _near(common, moved, boards, point_m) & there)
            if count >= max(_LOST_SHARE * len(hands), own.sum() + _LOST_FEWEST):
                name = f"the {_ordinal(first + 1)} image" if poses is None else poses.images[first]
                begin = "each image" if first == 0 else f"from {name} on each"
                fitting = f"{counted(count, 'image')} of {len(hands)}"
                found.append((count, f"if {begin} has the pose of the row {words} its own ({fitting})"))
    return max(found)[1] if found else None


def _answers_of_a_half(hands: Array, moved: Array, boards: Array) -> Iterator[RobustStart]:
    """Answers of the first views with their own poses, and of the last ones with their neighbours'.

    The row is lost in one half, so one of the two halves has no wrong pose.
    """
    half = max(MIN_VIEWS, len(hands) // 2)
    for whole, part in ((hands, slice(0, half)), (moved, slice(len(hands) - half, None))):
        try:
            yield solve_with_scale(whole[part], boards[part])
        except (cv2.error, ComputeError):  # a half may have too little rotation
            continue


def _split(own: NDArray[np.bool_], neighbours: NDArray[np.bool_]) -> tuple[int, int]:
    """Number of views that fit at most if the first ones have their own poses and the others their neighbours'.

    Also the index of the first of the others.
    """
    before = np.concatenate([[0], np.cumsum(own)])[:-1]
    after = neighbours.sum() - np.concatenate([[0], np.cumsum(neighbours)])[:-1]
    first = int(np.argmax(before + after))
    return int(before[first] + after[first]), first


def _ordinal(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def _near(common: RobustStart, hands: Array, boards: Array, point_m: Array) -> NDArray[np.bool_]:
    """(N,) whether each view places the board where the common answer does."""
    mm, deg = deviation(common.placed(hands, boards), common.T_base_board, point_m)
    return (mm <= _MOST_MM / 2) & (deg <= _MOST_DEG / 2)


def _fit(hands: Array, boards: Array, point_m: Array) -> SetupFit:
    try:
        found = robust_start(hands, boards, np.random.default_rng(0))
    except ComputeError:
        return SetupFit(float("inf"), float("inf"), 1.0)
    if found.scale <= 0:  # no board has a negative size
        return SetupFit(float("inf"), float("inf"), 1.0)
    mm, deg = deviation(found.placed(hands, boards), found.T_base_board, point_m)
    return SetupFit(float(np.median(mm)) / found.scale, float(np.median(deg)), found.scale)
