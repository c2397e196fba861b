"""The job `calibrate`: the board's size by the robot is compared, its bow estimated and handed on to the hand-eye."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.computations.calibration import CALIBRATE
from service.computations.job import JobAnswer, JobContext, RecordedContext
from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError
from service.core.geometry import Array, apply
from service.store.store import Store
from service.worker.loop import HANDLERS
from tests.support.boards.board_sessions import BOARD, CAMERA, T_FLANGE_CAMERA, noisy_session

BOW_M = (1e-4, 0.0)


@pytest.fixture(scope="module")
def arguments(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[Store, dict[str, Any]]]:
    """The corners of 14 images of a bent board in a store, and arguments as an early version wrote them."""
    folder = tmp_path_factory.mktemp("job")
    store = Store.open(folder / "data")
    context: RecordedContext = JobContext({}, store, folder, lambda *_: None)
    session = noisy_session(14, 0.05, 0.005, 6)
    rng, points = np.random.default_rng(1), _bent()
    images: list[dict[str, Any]] = []
    corners: list[str] = []
    for k, (T_base_flange, T_camera_board) in enumerate(
        zip(session.T_base_flange, session.T_camera_board, strict=True)
    ):
        pixels = CAMERA.project(apply(T_camera_board, points))
        pixels += rng.normal(0, 0.05, pixels.shape)
        seen = {
            "size": [CAMERA.width, CAMERA.height],
            "indices": list(range(len(pixels))),
            "corners": pixels.tolist(),
        }
        corners.append(context.keep_json(seen, kind="board_corners", name=f"b{k}.json").sha256)
        images.append({"viewpoint": f"b{k}", "sha256": "0" * 64, "T_base_flange": T_base_flange.tolist()})
    yield (
        store,
        {
            "solve": ["intrinsics", "hand_eye"],
            "images": images,
            "corners": corners,
            "columns": BOARD.columns,
            "rows": BOARD.rows,
            "square_m": BOARD.square_m,
        },
    )
    store.close()


def _bent() -> Array:
    points, bends = BOARD.points(), BOARD.bends()
    points[:, 2] = bends @ BOW_M
    return points


def _done(arguments: tuple[Store, dict[str, Any]], **other: Any) -> JobAnswer:
    store, given = arguments
    return HANDLERS["calibrate"](JobContext(given | other, store, Path("unused"), lambda *_: None))


@pytest.mark.slow
def test_a_job_gives_the_bow_and_the_size_of_the_board(arguments: tuple[Store, dict[str, Any]]) -> None:
    done = _done(arguments)
    answer = CALIBRATE.read_answer(done.result)
    assert done.measures["board_bow_mm"] == pytest.approx(0.1, abs=0.003)
    assert abs(done.measures["hand_eye_board_size_percent"]) < 0.2
    assert done.measures["hand_eye_findings"] == 0
    assert answer.details.intrinsics is not None
    assert answer.details.intrinsics.board is not None
    assert answer.details.intrinsics.board.bow_mm == pytest.approx((0.1, 0.0), abs=0.003)
    assert answer.hand_eye is not None
    assert answer.hand_eye.board_size is not None
    assert "15 were given" in answer.hand_eye.board_size.words
    away_mm = 1e3 * np.linalg.norm((np.array(answer.T_flange_camera) - T_FLANGE_CAMERA)[:3, 3])
    assert answer.hand_eye.sigma.mm is not None
    assert away_mm < 3 * answer.hand_eye.sigma.mm
    # A hand-eye calibration of its own takes the bow from the camera's, and a record of an early version has none.
    camera = CameraModel.from_record(answer.camera.plain())
    assert abs(camera.fx - CAMERA.fx) < 3 * answer.details.intrinsics.sigma["fx"]
    alone: dict[str, Any] = {"solve": ["hand_eye"], "camera": answer.camera.plain()}
    seen = answer.details.intrinsics.board.plain()
    noise = [_done(arguments, **alone, **more).measures["corner_sigma_px"] for more in ({"seen": seen}, {})]
    assert noise[0] < 0.055 < noise[1]


def test_a_job_whose_board_has_another_size_fails_with_the_size_that_fits(
    arguments: tuple[Store, dict[str, Any]],
) -> None:
    with pytest.raises(ComputeError, match=r"the squares are 1[45]\.\d+ ± 0\.\d+ mm by the robot, 15\.5 were given"):
        _done(arguments, square_m=0.0155)
    with pytest.raises(ComputeError, match=r"tolerance is 0\.01 %"):
        _done(arguments, square_m=0.0155, size_tolerance=1e-4)


def test_a_protocol_that_states_a_flat_board_gets_one(arguments: tuple[Store, dict[str, Any]]) -> None:
    done = _done(arguments, solve=["intrinsics"], flatness_mm=0.0)
    assert "board_bow_mm" not in done.measures
    assert CALIBRATE.version == 5
