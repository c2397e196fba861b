"""Chooses board poses that cover the image and determine the camera and its mount as well as possible."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board
from service.compute.calibration.board_knowledge import (
    BoardKnowledge,
    hand_eye_information,
    inverse_of,
    lens_field,
    lens_information,
    lens_prior,
    uncertainty_mm,
)
from service.compute.calibration.intrinsics import COVERAGE_GRID, coverage_map_of
from service.compute.camera_model import CameraModel
from service.compute.photography import ViewRange
from service.core.geometry import Array, Transform, apply, inverse, look_at, rotation_about_z
from service.core.units import deg, mm

_ANCHORS = tuple(product((0, -1, 1), (0, -1, 1)))  # places in the frame: its middle, edges and corners
_ROUNDS = 4
_MARGIN = 0.006  # of the image's width, on top of all uncertainty
_DRAWS, _CHECKED = 16, 64
_MOST = 800


@dataclass(frozen=True, slots=True)
class Candidates:
    """Camera poses T_base_camera (C, 4, 4), and the board points' expected pixels (C, P, 2)."""

    T_base_camera: Array
    pixels: Array

    def take(self, which: NDArray[np.int64]) -> Candidates:
        """Return only the candidates with these indices."""
        return Candidates(self.T_base_camera[which], self.pixels[which])


def board_candidates(
    known: BoardKnowledge,
    board: Board,
    wishes: ViewRange,
    approach: Array,
    *,
    most: int = _MOST,
    seed: int = 0,
    draw: int = 0,
) -> Candidates:
    """Return poses that keep the whole printed board in the frame for every truth within the tolerances.

    Args:
        known: nominal values or estimates, with their tolerances.
        board: the board.
        wishes: tilts, rolls and distances.
        approach: (3,) horizontal unit vector from the scene towards the base; images are upright for a viewer there.
        most: number of poses tried, drawn at random from all combinations.
        seed: seed of the draw.
        draw: 1 for the next so many combinations, which the draw before did not have, and so on.

    Returns:
        Candidates, possibly none.
    """
    grid = _grid(known, board, wishes, approach)
    rng = np.random.default_rng([seed, 0xCA11])
    pick = rng.permutation(len(grid) * len(_ANCHORS))[draw * most : (draw + 1) * most]
    poses = np.array([grid[k // len(_ANCHORS)] for k in pick]).reshape(-1, 4, 4)
    anchors = np.array([_ANCHORS[k % len(_ANCHORS)] for k in pick], dtype=np.float64).reshape(-1, 2)
    outline = _outline(board)
    truth = _ToleranceDraws(known, outline, _DRAWS)
    poses = _pushed(poses, anchors, known.camera, truth)
    poses = poses[_inside(poses, known.camera, truth)]
    poses = poses[_inside(poses, known.camera, _ToleranceDraws(known, outline, _CHECKED, seed=1))]
    return Candidates(poses, expected_pixels(known, board, poses))


def expected_pixels(known: BoardKnowledge, board: Board, T_base_camera: Array) -> Array:
    """Return (C, P, 2) pixels of the board's points for the estimated camera, mount and board."""
    boards = np.array([inverse(T) @ known.T_base_board for T in T_base_camera]).reshape(-1, 4, 4)
    points = np.einsum("nij,pj->npi", boards[:, :3, :3], board.points()) + boards[:, None, :3, 3]
    return known.camera.project(points.reshape(-1, 3)).reshape(len(boards), len(board.points()), 2)


def _outline(board: Board) -> Array:
    """Return (8, 3) edge of the printed squares in the board frame; it lies one square beyond the inner corners."""
    points = board.points()[:, :2]
    low, high = points.min(axis=0) - board.square_m, points.max(axis=0) + board.square_m
    share = [(0, 0), (0.5, 0), (1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (0, 0.5)]
    return np.column_stack([low + np.array(share) * (high - low), np.zeros(len(share))])


class _ToleranceDraws:
    """Draws within the tolerances: the true pose of a camera sent to a pose, and the true place of the board."""

    def __init__(self, known: BoardKnowledge, outline: Array, count: int, seed: int = 0) -> None:
        hands, boards, self.zoom, self.shift_px = known.draws(count, seed)
        self.camera = known.camera
        T_flange_camera = known.T_flange_camera
        self.T_true_sent = np.array([inverse(hand) @ T_flange_camera for hand in hands])  # (D, 4, 4)
        self.outline_base = np.array([apply(board, outline) for board in boards])  # (D, K, 3)

    def pixels(self, T_base_camera: Array) -> tuple[Array, Array]:
        """Return (C, D, K, 2) pixels of the outline and (C, D, K) its depths, m."""
        count, (draws, points, _) = len(T_base_camera), self.outline_base.shape
        moved = self.outline_base.reshape(-1, 3) - T_base_camera[:, None, :3, 3]
        sent = (moved @ T_base_camera[:, :3, :3]).reshape(count, draws, points, 3)
        T = self.T_true_sent
        turned = sent @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
        pixels = self.camera.project(turned.reshape(-1, 3)).reshape(*turned.shape[:3], 2)
        middle = np.array([self.camera.cx, self.camera.cy])
        return (pixels - middle) * self.zoom[:, None, None] + middle + self.shift_px[:, None], turned[..., 2]


def _grid(known: BoardKnowledge, board: Board, wishes: ViewRange, approach: Array) -> list[Transform]:
    middle = apply(known.T_base_board, board.points().mean(axis=0))
    normal = -known.T_base_board[:3, 2]
    towards = approach - (approach @ normal) * normal
    towards /= np.linalg.norm(towards)
    side = np.cross(normal, towards)
    rolls = [rotation_about_z(angle) for angle in np.radians(wishes.rolls_deg)]
    poses: list[Transform] = []
    for tilt in np.radians(wishes.tilts_deg):
        for azimuth in np.arange(wishes.azimuths if tilt > 0 else 1) * 2 * np.pi / wishes.azimuths:
            out = np.cos(tilt) * normal + np.sin(tilt) * (np.cos(azimuth) * towards + np.sin(azimuth) * side)
            for distance in wishes.distances_m:
                upright = look_at(middle + distance * out, middle, -towards)
                poses += [upright @ about for about in rolls]
    return poses


def _pushed(poses: Array, anchors: Array, camera: CameraModel, truth: _ToleranceDraws) -> Array:
    """Shift each pose in its image plane until the board touches the wanted side of the frame, or is centred."""
    size, margin = np.array([camera.width, camera.height]), _MARGIN * camera.width
    poses = poses.copy()
    for _ in range(_ROUNDS):
        pixels, depth = truth.pixels(poses)
        low, high = pixels.min(axis=(1, 2)), pixels.max(axis=(1, 2))
        left, right = margin - low, size - 1 - margin - high  # the range of shifts
        wanted = np.where(anchors < 0, left, np.where(anchors > 0, right, (left + right) / 2))
        # Moving the camera to the left moves the image to the right.
        shift = -wanted * depth.mean(axis=(1, 2))[:, None] / [camera.fx, camera.fy]
        poses[:, :3, 3] += np.einsum("cij,cj->ci", poses[:, :3, :2], shift)
    return poses


def _inside(poses: Array, camera: CameraModel, truth: _ToleranceDraws) -> NDArray[np.bool_]:
    pixels, depth = truth.pixels(poses)
    margin = 0.5 * _MARGIN * camera.width
    within = (pixels >= margin) & (pixels <= np.array([camera.width, camera.height]) - 1 - margin)
    return np.asarray(within.all(axis=(1, 2, 3)) & (depth > 0.05).all(axis=(1, 2)), dtype=np.bool_)


# Chooses board poses that cover the image and determine the camera and its mount as well as possible.
#
# Greedy optimal design on the linearised problems: first the poses that reach new cells of the image, then those
# that lower the predicted variances most. Each later pick looks only at a random sample of the remaining candidates
# ("stochastic greedy", Mirzasoleiman et al., "Lazier than lazy greedy", AAAI 2015), which also spreads the poses.


_CELLS = COVERAGE_GRID[0] * COVERAGE_GRID[1]
_CELL_SHARE = 0.8  # of a cell's sides: a corner nearer to its edge may end up in the next cell
_LEVER_M = 0.7  # from the camera to what it looks at
_OPEN = 50  # random candidates considered in a later pick
_TRIED = 40  # of the best ones, until the arm can take one


@dataclass(frozen=True, slots=True)
class CalibrationTargets:
    """The calibrations that the images are for, and their targets."""

    intrinsics: bool = True
    hand_eye: bool = True
    coverage: float = 0.97  # share of the image's cells
    corner_sigma_px: float = 0.1


@dataclass(frozen=True, slots=True)
class PlanPrediction:
    """The predicted result of a set of images.

    Attributes:
        images: number of images.
        coverage: share of the image's cells with a corner.
        coverage_map: (8, 12) corners in each cell.
        uncertainty_mm: uncertainty of a projected point at the board's distance, in mm, worst in the image; NaN if
            the images do not determine the camera.
        tilt_deg: largest tilt of the board.
        rotation_spread_deg: largest rotation between two images.
        hand_eye_sigma_mm, hand_eye_sigma_deg: standard deviation of T_flange_camera.
    """

    images: int
    coverage: float
    coverage_map: NDArray[np.int64]
    uncertainty_mm: float
    tilt_deg: float
    rotation_spread_deg: float
    hand_eye_sigma_mm: float
    hand_eye_sigma_deg: float


@dataclass(frozen=True, slots=True)
class ChosenViews:
    """Images taken or already chosen: T_base_camera (N, 4, 4) and the pixels of their corners, N arrays (M, 2)."""

    T_base_camera: Array
    pixels: tuple[Array, ...] = ()

    def plus(self, poses: Array, pixels: Sequence[Array]) -> ChosenViews:
        """Return these with further ones."""
        return ChosenViews(np.concatenate([self.T_base_camera, poses.reshape(-1, 4, 4)]), (*self.pixels, *pixels))


NOTHING = ChosenViews(np.zeros((0, 4, 4)))


@dataclass(frozen=True, slots=True)
class DesignProblem:
    """The unknowns that images of the board must determine, and how well.

    Attributes:
        known: estimates of camera, mount and board.
        board: the board.
        aims: calibrations and targets.
    """

    known: BoardKnowledge
    board: Board
    aims: CalibrationTargets

    def as_taken(self, T_base_camera: Array) -> ChosenViews:
        """Return poses (K, 4, 4) as if their images were taken, with the board's points at their expected pixels."""
        poses = T_base_camera.reshape(-1, 4, 4)
        return ChosenViews(poses, tuple(expected_pixels(self.known, self.board, poses)))

    def predict(self, taken: ChosenViews) -> PlanPrediction:
        """Predict the accuracy of calibrations from these images."""
        known, board, sigma_px = self.known, self.board, self.aims.corner_sigma_px
        counts = _counts(taken.pixels, known)
        boards = np.array([inverse(T) @ known.T_base_board for T in taken.T_base_camera]).reshape(-1, 4, 4)
        worst_mm = uncertainty_mm(boards, known.camera, board, sigma_px) if len(boards) >= 3 else np.nan
        sigma_mm = sigma_deg = np.nan
        if len(boards) >= 3:
            information = hand_eye_information(taken.T_base_camera, known, board, sigma_px).sum(axis=0)
            covariance = inverse_of(information[None])[0]
            sigma_mm = mm(float(np.sqrt(np.trace(covariance[:3, :3]))))
            sigma_deg = deg(np.sqrt(np.trace(covariance[3:6, 3:6])))
        tilts = np.degrees(np.arccos(np.clip(np.abs(boards[:, 2, 2]), 0, 1)))
        return PlanPrediction(
            images=len(boards),
            coverage=float(np.count_nonzero(counts)) / counts.size,
            coverage_map=counts,
            uncertainty_mm=worst_mm,
            tilt_deg=float(tilts.max(initial=0.0)),
            rotation_spread_deg=_spread_deg(boards),
            hand_eye_sigma_mm=sigma_mm,
            hand_eye_sigma_deg=sigma_deg,
        )


def choose_poses(
    problem: DesignProblem,
    candidates: Candidates,
    count: int,
    *,
    taken: ChosenViews = NOTHING,
    feasible: Callable[[Transform], bool] = lambda _T: True,
    enough: Callable[[PlanPrediction], bool] | None = None,
    seed: int = 0,
) -> Array:
    """Choose up to `count` of the candidates' poses (K, 4, 4), in the order of their gain.

    Args:
        problem: the unknowns that the images must determine.
        candidates: the poses to choose from.
        count: largest number of poses.
        taken: images that count already.
        feasible: says if the arm can go there; called only for the best candidates.
        enough: called after each pose; once it returns True, no more are chosen.
        seed: seed of the random samples of later picks.
    """
    rng = np.random.default_rng([seed, 0x9A5E])
    worth = _InformationGain(problem)
    cells = _cells(candidates.pixels, problem.known, _CELL_SHARE)
    covered = _covered(taken.pixels, problem.known)
    gains = worth.gains(candidates.T_base_camera)
    so_far = worth.start(taken.T_base_camera)
    open_ = np.ones(len(cells), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < count and open_.any():
        pool = np.flatnonzero(open_)
        fresh = (cells[pool] & ~covered).sum(axis=1)
        wanted = covered.mean() < problem.aims.coverage and bool((fresh > 0).any())
        if not wanted and len(pool) > _OPEN:
            pool = rng.choice(pool, _OPEN, replace=False)
        cost = worth.cost(so_far, gains, pool)
        order = np.lexsort((cost, -fresh)) if wanted else np.argsort(cost)
        best = _first(pool[order[:_TRIED]], open_, lambda k: feasible(candidates.T_base_camera[k]))
        if best is None:
            continue
        chosen.append(best)
        covered |= cells[best]
        so_far = worth.plus(so_far, gains, best)
        if enough is not None:
            more = candidates.take(np.array(chosen, dtype=np.int64))
            if enough(problem.predict(taken.plus(more.T_base_camera, list(more.pixels)))):
                break
    return candidates.T_base_camera[chosen]


def _first(ranked: NDArray[np.int64], open_: NDArray[np.bool_], feasible: Callable[[int], bool]) -> int | None:
    """Return the first feasible candidate, or None; it and those before it are no longer open."""
    for k in ranked.tolist():
        open_[k] = False
        if feasible(k):
            return k
    return None


class _InformationGain:
    """Information gained by poses, and the variance left by a set of them."""

    def __init__(self, problem: DesignProblem) -> None:
        self.known, self.board, self.aims = problem.known, problem.board, problem.aims
        self.prior = lens_prior(problem.known.camera)
        self.field = lens_field(problem.known.camera)

    def gains(self, T_base_camera: Array) -> tuple[Array, Array]:
        """Return (C, 8, 8) of the camera and (C, 12, 12) of mount and board."""
        count = len(T_base_camera)
        lens = np.zeros((count, *self.prior.shape))
        mount = np.zeros((count, 12, 12))
        if not count:
            return lens, mount
        if self.aims.intrinsics:
            boards = np.array([inverse(T) @ self.known.T_base_board for T in T_base_camera])
            lens = lens_information(boards, self.known.camera, self.board, self.aims.corner_sigma_px)
        if self.aims.hand_eye:
            mount = hand_eye_information(T_base_camera, self.known, self.board, self.aims.corner_sigma_px)
        return lens, mount

    def start(self, T_base_camera: Array) -> tuple[Array, Array]:
        """Sum the information (8, 8) and (12, 12) of images that count already and the prior of nominal values."""
        lens, mount = self.gains(T_base_camera)
        weak = np.diag(1 / np.array([*[0.01] * 3, *[0.05] * 3, *[0.05] * 3, *[0.2] * 3]) ** 2)
        return self.prior + lens.sum(axis=0), weak + mount.sum(axis=0)

    def plus(self, so_far: tuple[Array, Array], gains: tuple[Array, Array], k: int) -> tuple[Array, Array]:
        """Add the information of candidate `k`."""
        return so_far[0] + gains[0][k], so_far[1] + gains[1][k]

    def cost(self, so_far: tuple[Array, Array], gains: tuple[Array, Array], pool: NDArray[np.int64]) -> Array:
        """Return (K,) logarithm of the variance left after adding each candidate of the pool."""
        cost = np.zeros(len(pool))
        if self.aims.intrinsics:
            covariance = inverse_of(so_far[0] + gains[0][pool])
            cost += np.log(np.einsum("ij,nji->n", self.field, covariance))
        if self.aims.hand_eye:
            covariance = inverse_of(so_far[1] + gains[1][pool])
            shift = np.trace(covariance[:, :3, :3], axis1=1, axis2=2)
            turn = np.trace(covariance[:, 3:6, 3:6], axis1=1, axis2=2)
            cost += np.log(shift + _LEVER_M**2 * turn)
        return cost


def _cells(pixels: Array, known: BoardKnowledge, share: float) -> NDArray[np.bool_]:
    """Return (C, 96) whether each cell holds a corner of (C, P, 2) within the inner share of its sides."""
    if not len(pixels):
        return np.zeros((0, COVERAGE_GRID[0] * COVERAGE_GRID[1]), dtype=bool)
    place = (pixels + 0.5) / [known.camera.width, known.camera.height] * COVERAGE_GRID
    index = np.clip(np.floor(place).astype(np.int64), 0, np.array(COVERAGE_GRID) - 1)
    inner = (np.abs(place - index - 0.5) <= share / 2).all(axis=2)
    flat = index[..., 1] * COVERAGE_GRID[0] + index[..., 0] + np.arange(len(pixels))[:, None] * _CELLS
    counts = np.bincount(flat[inner], minlength=len(pixels) * _CELLS)
    return counts.reshape(len(pixels), -1) > 0


def _covered(pixels: Sequence[Array], known: BoardKnowledge) -> NDArray[np.bool_]:
    """Return (96,) whether each cell holds a corner of images that count already."""
    return _counts(pixels, known).ravel() > 0


def _counts(pixels: Sequence[Array], known: BoardKnowledge) -> NDArray[np.int64]:
    """Return (8, 12) corners in each cell."""
    if not pixels:
        return np.zeros(COVERAGE_GRID[::-1], dtype=np.int64)
    return coverage_map_of(pixels, (known.camera.width, known.camera.height))


def _spread_deg(boards: Array) -> float:
    """Return the largest rotation between two views, degrees."""
    if len(boards) < 2:
        return 0.0
    turns = Rotation.from_matrix(boards[:, :3, :3])
    return deg(max(float((turns[i].inv() * turns).magnitude().max()) for i in range(len(boards))))
