"""The bow of a board: estimated with the camera, harmless where there is none; and lenses that are too wide."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.computations.calibration import BoardSeen
from service.computations.conversion import intrinsics_record, seen_board
from service.compute.calibration import intrinsics_adjustment
from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.intrinsics import IntrinsicsResult, calibrate_intrinsics, locate_view
from service.compute.calibration.intrinsics_adjustment import LensModel
from service.compute.calibration.intrinsics_quality import (
    board_distance_m,
    calibration_warnings,
    cross_validate,
    projection_uncertainty,
)
from service.compute.camera_model import CameraModel
from service.core.geometry import Array, apply, inverse, look_at, transform

BOARD = Board(10, 14, 0.025)
SMALL = Board(9, 6, 0.02)
FLAT = dataclasses.replace(BOARD, flatness_m=0.0)
LENS = CameraModel(4752, 3168, 6650.0, 6652.0, 2380.0, 1580.0, -0.05, 0.03, 2e-4, -3e-4)
WIDE = CameraModel(1000, 800, 420.0, 420.0, 500.0, 400.0, 0.3, 0.02, 0.0, 0.0, 0.001, 0.62, 0.1, 0.002)


def _poses(
    count: int, seed: int, away_m: float = 0.72, *, board: Board = BOARD, beside_m: float = 0.03
) -> list[Array]:
    """T_camera_board of a camera that looks at the board, or up to `beside_m` beside its middle, from all sides."""
    rng, middle = np.random.default_rng(seed), board.points().mean(axis=0)
    out: list[Array] = []
    for k in range(count):
        tilt, azimuth = np.deg2rad(rng.uniform(4, 40)), 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count
        out_ = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
        roll = transform(Rotation.from_euler("z", rng.choice([0, 12, 180, 168]), degrees=True), np.zeros(3))
        target = middle + np.append(rng.uniform(-beside_m, beside_m, 2), 0.0)
        out.append(inverse(look_at(middle + away_m * out_, target, np.array([1.0, 0.0, 0.0])) @ roll))
    return out


def _views(board: Board, poses: Sequence[Array], camera: CameraModel, seed: int = 0) -> list[BoardView]:
    rng, points = np.random.default_rng(seed), board.points()
    views: list[BoardView] = []
    for pose in poses:
        pixels = camera.project(apply(pose, points))
        pixels += rng.normal(0, 0.05, pixels.shape)
        inside = ((pixels > 0) & (pixels < np.array([camera.width, camera.height]) - 1)).all(axis=1)
        views.append(BoardView(np.flatnonzero(inside), pixels[inside]))
    return views


def _bent(x_m: float, y_m: float) -> Board:
    return dataclasses.replace(BOARD, bow_m=(x_m, y_m))


def _away_m(views: Sequence[BoardView], poses: Sequence[Array], answer: IntrinsicsResult) -> float:
    """The largest error of a camera's distance from the board."""
    found = [locate_view(view, answer.board, answer.camera)[0] for view in views]
    return float(np.max([np.linalg.norm((T - true)[:3, 3]) for T, true in zip(found, poses, strict=True)]))


def _size(camera: CameraModel) -> tuple[int, int]:
    return camera.width, camera.height


@pytest.mark.parametrize("bow_m", [(1e-4, 0.0), (0.6e-4, 0.8e-4)])
def test_a_bent_board_gives_the_camera_and_its_bow(bow_m: tuple[float, float]) -> None:
    poses = _poses(16, 1)
    views = _views(_bent(*bow_m), poses, LENS)
    result = calibrate_intrinsics(views, BOARD, _size(LENS))
    assert abs(result.camera.fx - LENS.fx) < 3 * result.sigma["fx"]
    assert result.board.bow_m == pytest.approx(bow_m, abs=2e-6)
    assert result.rms_px == pytest.approx(0.07, abs=0.005)
    # What a flat board would have done with the same images.
    flat = calibrate_intrinsics(views, FLAT, _size(LENS))
    assert abs(flat.camera.fx - LENS.fx) > 20 * result.sigma["fx"]
    moved, kept = (_away_m(views, poses, answer) for answer in (flat, result))
    assert kept < 5e-5
    assert moved > 2e-4
    record = intrinsics_record(
        result, None, projection_uncertainty(result, board_distance_m(result)), (), [f"{k}" for k in range(16)], {}
    )
    assert record.board is not None
    assert record.board.bow_mm == pytest.approx([1e3 * v for v in bow_m], abs=2e-3)
    assert "across its columns" in record.board.bow_words
    again = seen_board(BOARD, BoardSeen.model_validate(record.board.plain()))
    np.testing.assert_allclose(again.points(), result.board.points(), atol=1e-12)


def test_a_flat_board_loses_nothing() -> None:
    ratios: list[float] = []
    for seed in range(3):
        views = _views(BOARD, _poses(14, seed), LENS, seed)
        free, flat = (calibrate_intrinsics(views, board, _size(LENS)) for board in (BOARD, FLAT))
        assert abs(free.camera.fx - LENS.fx) < 3 * free.sigma["fx"]
        assert np.abs(free.board.bow_m).max() < 3e-6
        assert flat.board.bow_m == (0.0, 0.0)
        ratios += [free.sigma[name] / flat.sigma[name] for name in free.sigma]
        known = [projection_uncertainty(result, 0.7).worst_mm for result in (free, flat)]
        assert known[0] < 1.1 * known[1]
    assert float(np.median(ratios)) < 1.1


def test_a_bow_beyond_the_stated_flatness_is_a_reason_for_care() -> None:
    board = dataclasses.replace(BOARD, flatness_m=5e-5)
    result = calibrate_intrinsics(_views(_bent(3e-4, 0.0), _poses(10, 2), LENS), board, _size(LENS))
    words = " ".join(calibration_warnings(result, None, projection_uncertainty(result, 0.7)))
    assert "the board is bent by 0.30 mm, more than its stated flatness of 0.05 mm" in words


def test_a_lens_too_wide_for_its_model_is_named_with_the_model_that_fits() -> None:
    views = _views(SMALL, _poses(16, 3, 0.12, board=SMALL, beside_m=0.07), WIDE)
    result = calibrate_intrinsics(views, SMALL, _size(WIDE))
    words = " ".join(calibration_warnings(result, None, projection_uncertainty(result, 0.12)))
    assert "a wide lens: the model opencv4 fits to" in words
    assert "calibrate with --model rational" in words
    narrow = calibrate_intrinsics(_views(BOARD, _poses(10, 3), LENS), BOARD, _size(LENS))
    assert "wide" not in " ".join(calibration_warnings(narrow, None, projection_uncertainty(narrow, 0.7)))


def test_the_rational_model_needs_few_more_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Terms that the images do not determine once made it nine times slower: the steps wandered along a valley."""
    views = _views(BOARD, _poses(14, 4), LENS)
    projected: dict[LensModel, int] = {}
    project = intrinsics_adjustment.project_with_jacobian
    for model in ("opencv4", "rational"):
        counted: list[int] = []

        def counting(
            points: Array, pose: Array, camera: CameraModel, counted: list[int] = counted
        ) -> tuple[Array, Array, Array]:
            counted.append(len(points))
            return project(points, pose, camera)

        monkeypatch.setattr(intrinsics_adjustment, "project_with_jacobian", counting)
        result = calibrate_intrinsics(views, BOARD, _size(LENS), model=model)
        projected[model] = len(counted)
        assert result.camera.fx == pytest.approx(LENS.fx, abs=4 * result.sigma["fx"])
    assert projected["rational"] < 4 * projected["opencv4"]
    assert cross_validate(result).five_fold_rms_px < 0.09
