"""Finds a first hand-eye answer by closed forms, and names the usual mistake if poses and images do not fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad, transform
from service.core.units import LENGTH_WORDS, METRES_PER, deg, mm
from service.core.words import counted

ClosedForm = Literal["park", "daniilidis", "tsai", "horaud", "andreff"]

CLOSED_FORMS: dict[ClosedForm, int] = {
    "park": cv2.CALIB_HAND_EYE_PARK,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
}
MIN_VIEWS = 6
_MIN_ROTATION_DEG = 15.0  # largest rotation between two views
_MIN_SECOND_AXIS_DEG = 4.0  # root mean square rotation about the second best axis
_SUBSETS, _SUBSET_SIZE = 24, 8
_SPOILT = 2.0  # times larger median deviation: leaving the worst quarter out has not helped
_FAR_BETTER = 3.0  # times smaller misfit without the given size
_USUAL_NOISE_M = 1e-3  # of an arm, to weigh the given size of the board against the views


def solve_closed_form(hands: Array, boards: Array, method: ClosedForm) -> Transform:
    """Return T_flange_camera from poses T_base_flange and T_camera_board, both (N, 4, 4), N ≥ 3.

    Source: Park and Martin 1994, Daniilidis 1999, Tsai and Lenz 1989, Horaud and Dornaika 1995, Andreff et al. 1999,
    as OpenCV implements them.

    Raises:
        ComputeError: the answer is not finite.
    """
    # Arguments by keyword: a fifth positional argument of calibrateHandEye is silently taken as an output array.
    R, t = cv2.calibrateHandEye(
        R_gripper2base=list(hands[:, :3, :3]),
        t_gripper2base=list(hands[:, :3, 3]),
        R_target2cam=list(boards[:, :3, :3]),
        t_target2cam=list(boards[:, :3, 3]),
        method=CLOSED_FORMS[method],
    )
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()
    # Andreff's answer is a rotation only for exact data.
    U, scale, Vt = np.linalg.svd(np.nan_to_num(rotation))
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()) or scale[2] < 0.1:
        raise ComputeError(f"hand-eye calibration by {method} has no answer", remedy="Take views with more rotation")
    return transform(U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt, translation)


def all_closed_forms(hands: Array, boards: Array) -> dict[ClosedForm, Transform]:
    """Return T_flange_camera by every method that gives an answer."""
    answers: dict[ClosedForm, Transform] = {}
    for method in CLOSED_FORMS:
        try:
            answers[method] = solve_closed_form(hands, boards, method)
        except (cv2.error, ComputeError):  # these are only for comparison; one may fail
            continue
    return answers


def observability(hands: Array) -> tuple[float, float, float]:
    """Return largest relative rotation and RMS rotation about the second axis (degrees), and the condition number.

    Raises:
        ComputeError: these rotations do not determine the translation.
    """
    n = len(hands)
    if n < MIN_VIEWS:
        raise ComputeError(
            f"{n} views for the hand-eye calibration, at least {MIN_VIEWS} are needed",
            remedy="Take more board images",
        )
    i, j = np.triu_indices(n, 1)
    relative = np.swapaxes(hands[i, :3, :3], 1, 2) @ hands[j, :3, :3]
    vectors = Rotation.from_matrix(relative).as_rotvec()
    spread = deg(np.linalg.norm(vectors, axis=1).max())
    axes = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors)), 0)))
    second = float(axes[1])
    if spread < _MIN_ROTATION_DEG:
        raise ComputeError(
            f"the flange turned by {spread:.1f}° at most, {_MIN_ROTATION_DEG:.0f}° are needed",
            remedy="Tilt the camera to several sides of the board, 40° or more in all",
        )
    if second < _MIN_SECOND_AXIS_DEG:
        raise ComputeError(
            f"the flange turned about one axis only ({axes[2]:.1f}° about it, {second:.1f}° about any other): "
            "the camera's position along this axis is undetermined",
            remedy="Tilt the camera about a second axis too",
        )
    system = (np.eye(3) - relative).reshape(-1, 3)
    return spread, second, float(np.linalg.cond(system))


def untwist(hands: Array, boards: Array, T_board_turned: Transform) -> tuple[Array, NDArray[np.bool_]]:
    """Correct the views whose board corners were numbered from the other end, so that all views agree with the robot.

    Between two views, flange and camera must rotate by the same angle. Which orientation fits each pair better gives
    a signed graph; its leading eigenvector splits the views into two groups, and the larger one stays as it is.
    """
    n = len(hands)
    turned = boards @ T_board_turned
    vote = np.zeros((n, n))
    for i in range(n):
        arm = _angles(np.swapaxes(hands[i : i + 1, :3, :3], 1, 2) @ hands[:, :3, :3])
        same = _angles(boards[i, :3, :3] @ np.swapaxes(boards[:, :3, :3], 1, 2))
        other = _angles(boards[i, :3, :3] @ np.swapaxes(turned[:, :3, :3], 1, 2))
        vote[i] = np.clip(np.abs(arm - other) - np.abs(arm - same), -0.2, 0.2)
    np.fill_diagonal(vote, 0.0)
    leading = np.linalg.eigh(vote + vote.T)[1][:, -1]
    flip = leading < 0 if np.count_nonzero(leading < 0) * 2 <= n else leading >= 0
    return np.where(flip[:, None, None], turned, boards), flip


@dataclass(frozen=True, slots=True)
class RobustStart:
    """T_flange_camera, T_base_board and the board's scale (true size over the given one)."""

    T_flange_camera: Transform
    T_base_board: Transform
    scale: float

    def placed(self, hands: Array, boards: Array) -> Array:
        """Return (N, 4, 4) T_base_board from each view alone."""
        return hands @ self.T_flange_camera @ scaled(boards, self.scale)

    def deviation_mm(self, hands: Array, boards: Array) -> Array:
        """Return (N,) how far each view places the board from its place, as lengths on the board as it was given.

        They are relative to the scale, which must be positive: a board of no size fits everywhere.
        """
        mm, _ = deviation(self.placed(hands, boards), self.T_base_board)
        return mm / max(self.scale, 1e-9)


def scaled(boards: Array, scale: float) -> Array:
    """Return board poses (N, 4, 4) as if the board were `scale` times as large as they were computed for."""
    out = boards.copy()
    out[:, :3, 3] *= scale
    return out


def solve_with_scale(hands: Array, boards: Array) -> RobustStart:
    """Return Park's rotation, which no scale changes, and positions with the board's scale by linear least squares.

    The given size counts as one measurement with an error of 100 %, so that views that do not determine the scale
    leave it where it is; if the views fit far better without it, as with lengths in another unit, it does not count.
    """
    R = solve_closed_form(hands, boards, "park")[:3, :3]
    n = len(hands)
    system, right = np.zeros((3 * n + 1, 7)), np.zeros(3 * n + 1)
    system[:-1, :3] = hands[:, :3, :3].reshape(-1, 3)
    system[:-1, 3:6] = np.tile(-np.eye(3), (n, 1))
    system[:-1, 6] = np.einsum("nij,nj->ni", hands[:, :3, :3] @ R, boards[:, :3, 3]).ravel()
    right[:-1] = -hands[:, :3, 3].ravel()
    system[-1, 6] = right[-1] = _USUAL_NOISE_M
    shift = np.linalg.lstsq(system, right)[0]
    free = np.linalg.lstsq(system[:-1], right[:-1])[0]
    misfit = [float(np.linalg.norm(system[:-1] @ answer - right[:-1])) for answer in (shift, free)]
    if free[6] > 0 and _FAR_BETTER * misfit[1] < misfit[0]:
        shift = free
    X, scale = transform(R, np.asarray(shift[:3], dtype=np.float64)), float(shift[6])
    return RobustStart(X, mean_pose(hands @ X @ scaled(boards, scale)), scale)


def robust_start(hands: Array, boards: Array, rng: np.random.Generator) -> RobustStart:
    """Return the answer of the subset of views that fits half of all views best.

    Least median of squares over random subsets (Rousseeuw 1984) and all views, so that a few wrong poses have no
    influence. Its scale is positive.
    """
    n = len(hands)
    picks = [np.arange(n)]
    picks += [rng.choice(n, min(_SUBSET_SIZE, n), replace=False) for _ in range(_SUBSETS if n > _SUBSET_SIZE else 0)]
    best: tuple[Array, RobustStart] | None = None
    for pick in picks:
        try:
            found = solve_with_scale(hands[pick], boards[pick])
        except (cv2.error, ComputeError):
            continue
        if found.scale <= 0:  # no board has a negative size
            continue
        off_mm = found.deviation_mm(hands, boards)
        if best is None or np.median(off_mm) < np.median(best[0]):
            best = (off_mm, found)
    if best is None:
        raise ComputeError("hand-eye calibration has no answer", remedy="Take views with more rotation")
    off_mm, start = best
    keep = np.argsort(off_mm, kind="stable")[: max(MIN_VIEWS, (3 * n) // 4)]
    try:
        refined = solve_with_scale(hands[keep], boards[keep])
    except (cv2.error, ComputeError):
        return start
    # Of few views of an arm that errs, the one left out may be the only one that was turned far.
    spoilt = refined.scale <= 0 or np.median(refined.deviation_mm(hands, boards)) > _SPOILT * np.median(off_mm)
    return start if spoilt else refined


def mean_pose(poses: Array) -> Transform:
    """Return the mean position and mean rotation of poses (N, 4, 4)."""
    return transform(Rotation.from_matrix(poses[:, :3, :3]).mean(), poses[:, :3, 3].mean(axis=0))


def deviation(poses: Array, mean: Transform, point_m: Array | None = None) -> tuple[Array, Array]:
    """Return distance in mm (of the origin, or a point (3,) in the poses' frame) and angle in degrees from `mean`."""
    offset = inverse(mean) @ poses
    angle = Rotation.from_matrix(offset[:, :3, :3]).magnitude()
    point = np.zeros(3) if point_m is None else point_m
    moved = offset[:, :3, :3] @ point + offset[:, :3, 3] - point
    return mm(np.linalg.norm(moved, axis=1)), np.degrees(angle)


def distance(a: Transform, b: Transform) -> tuple[float, float]:
    """Return the distance in mm and angle in degrees between two poses."""
    offset = inverse(a) @ b
    return mm(float(np.linalg.norm(offset[:3, 3]))), deg(rotation_angle_rad(offset))


def _angles(rotations: Array) -> Array:
    return np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))


# Checks whether robot poses and board images fit together, and names the usual mistake if they do not.
#
# If the camera is on the flange and the board lies still, T_base_flange · X · T_camera_board is constant. A file
# with T_flange_base instead, or a camera beside the robot that looks at a board on the flange, gives poses that fit
# only when inverted; a file in millimetres fits only with a board a thousand times as large; a file whose
# quaternions are in another order, or which lost a row, fits only when it is read so. A solver would still give an
# answer: a camera metres away, with centimetres of noise.


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
        words: text that says which poses they are then, after "they fit".
        remedy: the advice to the user.
    """

    hands: Array
    words: str
    remedy: str


@dataclass(frozen=True, slots=True)
class PosesAsRead:
    """The robot's poses in the file from which they were read.

    Attributes:
        hands: (M, 4, 4) poses of all rows in the file's order, as they were read.
        rows: (N,) the row of each view.
        images: (N) their names.
        readings: the other ways to read the file.
    """

    hands: Array
    rows: NDArray[np.int64]
    images: tuple[str, ...]
    readings: tuple[PoseReading, ...] = ()

    def inverted(self) -> PosesAsRead:
        """Return the same with every pose inverted."""
        readings = tuple(replace(reading, hands=inverted(reading.hands)) for reading in self.readings)
        return replace(self, hands=inverted(self.hands), readings=readings)


@dataclass(frozen=True, slots=True)
class SetupFit:
    """Agreement of the views under one reading of the poses: medians over the views, and the board's relative size.

    `mm` is a length on the board as it is described, so that it does not depend on the unit of the robot's positions.
    """

    mm: float
    deg: float
    scale: float

    @property
    def fits(self) -> bool:
        """True if the errors are small enough for a robot."""
        return self.mm <= _MOST_MM and self.deg <= _MOST_DEG

    def beats(self, other: SetupFit) -> bool:
        """Return whether it fits, and so much better that the other reading must be a mistake."""
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
    """Return (N, 4, 4) inverses of poses (N, 4, 4)."""
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
    """Yield other ways to read the poses, likeliest first; without `every` only that which may fit like the first."""
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
    """Return how the poses fit if a row was lost, or there twice: from one view on, each has its neighbour's pose."""
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
    """Yield answers of the first views with their own poses, and of the last ones with their neighbours'.

    The row is lost in one half, so one of the two halves has no wrong pose.
    """
    half = max(MIN_VIEWS, len(hands) // 2)
    for whole, part in ((hands, slice(0, half)), (moved, slice(len(hands) - half, None))):
        try:
            yield solve_with_scale(whole[part], boards[part])
        except (cv2.error, ComputeError):  # a half may have too little rotation
            continue


def _split(own: NDArray[np.bool_], neighbours: NDArray[np.bool_]) -> tuple[int, int]:
    """Count the views that fit at most if the first have their own poses and the others their neighbours'.

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
    """Return (N,) whether each view places the board where the common answer does."""
    mm, deg = deviation(common.placed(hands, boards), common.T_base_board, point_m)
    return (mm <= _MOST_MM / 2) & (deg <= _MOST_DEG / 2)


def _fit(hands: Array, boards: Array, point_m: Array) -> SetupFit:
    try:
        found = robust_start(hands, boards, np.random.default_rng(0))
    except ComputeError:
        return SetupFit(float("inf"), float("inf"), 1.0)
    mm, deg = deviation(found.placed(hands, boards), found.T_base_board, point_m)
    return SetupFit(float(np.median(mm)) / found.scale, float(np.median(deg)), found.scale)
