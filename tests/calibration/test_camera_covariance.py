"""The camera's calibration uncertainty is included in the stated uncertainty of hand-eye and camera poses."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from service.compute.calibration.hand_eye import HandEyeViews, calibrate_hand_eye
from service.compute.calibration.reprojection import BoardCorners
from service.compute.camera_model import CameraCovariance, CameraModel, read_camera_covariance
from service.compute.sfm.bundle import AdjustmentData, BundleState, Sigmas, linearise, moved, normal_equations
from service.compute.sfm.estimate import blocks, similarity_covariance
from service.compute.sfm.features import Tracks
from service.core.errors import DataError
from service.core.geometry import Array, align_points
from tests.support.boards.board_sessions import BOARD, CAMERA, T_FLANGE_CAMERA, locate, noisy_session
from tests.support.scenes.tracked_scene import tracked_scene

NAMES = ("fx", "fy", "cx", "cy")


def _known(sigma_f_px: float, sigma_c_px: float) -> CameraCovariance:
    matrix = np.diag(np.square([sigma_f_px, sigma_f_px, sigma_c_px, sigma_c_px]))
    matrix[0, 1] = matrix[1, 0] = 0.99 * sigma_f_px**2  # the errors of both focal lengths are correlated
    return CameraCovariance(NAMES, matrix)


@pytest.mark.slow
def test_hand_eye_states_what_another_calibration_of_the_camera_would_change() -> None:
    known = _known(12.0, 4.0)
    session = noisy_session(24, 0.02, 0.002, 2)
    rng = np.random.default_rng(5)
    without: list[float] = []
    stated: list[float] = []
    for _ in range(4):
        off = dict(zip(NAMES, rng.multivariate_normal(np.zeros(4), known.matrix), strict=True))
        camera = dataclasses.replace(CAMERA, **{name: getattr(CAMERA, name) + d for name, d in off.items()})
        pixels = session.corners.corners_px
        boards = np.array(
            [locate(BOARD.points(), p, camera, T) for p, T in zip(pixels, session.T_camera_board, strict=True)]
        )
        result = calibrate_hand_eye(
            HandEyeViews(session.T_base_flange, boards, corners=BoardCorners(BOARD.points(), pixels, camera)),
            camera_covariance=known,
            bootstrap=30,
        )
        error_mm = 1e3 * float(np.linalg.norm((result.T_flange_camera - T_FLANGE_CAMERA)[:3, 3]))
        alone = result.covariance - result.camera_share
        without.append(error_mm / (1e3 * float(np.sqrt(np.trace(alone[:3, :3])))))
        stated.append(error_mm / result.sigma_mm)
    assert np.sqrt(np.mean(np.square(without))) > 5
    assert 0.3 < np.sqrt(np.mean(np.square(stated))) < 2.5


def _adjusted(tracks: Tracks, poses: Array, camera: CameraModel) -> BundleState:
    """Poses and points that minimise the reprojection errors of the tracks, with the camera held fixed."""
    state, data = BundleState(poses, tracks.points, np.empty((0, 4, 4)), camera), AdjustmentData(tracks)
    for _ in range(25):
        normal = normal_equations([linearise(state, data, Sigmas())["tracks"]])
        state = moved(state, data, *normal.step(1e-7))
    return state


def test_poses_from_images_state_what_a_wrong_camera_does_to_them() -> None:
    made = tracked_scene(3, track_px=0.05)
    right = _adjusted(made.tracks, made.poses, made.camera)
    for parameter, sigma in (("fx", 10.0), ("cx", 5.0), ("k1", 0.01)):
        known = CameraCovariance((parameter,), np.array([[sigma**2]]))
        off = dataclasses.replace(made.camera, **{parameter: getattr(made.camera, parameter) + sigma})
        wrong = _adjusted(made.tracks, right.cameras, off)
        T, scale = align_points(right.cameras[:, :3, 3], wrong.cameras[:, :3, 3], with_scale=True)
        moved_to = scale * wrong.cameras[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
        error = float(np.sqrt(np.mean(np.sum((moved_to - right.cameras[:, :3, 3]) ** 2, axis=1))))
        tracks = dataclasses.replace(made.tracks, points=right.points)
        plain = similarity_covariance(right.cameras, tracks, made.camera)
        whole = similarity_covariance(right.cameras, tracks, made.camera, known)
        share = np.trace(blocks(whole - plain)[:, :3, :3], axis1=1, axis2=2)
        assert float(np.sqrt(np.mean(share))) == pytest.approx(error, rel=0.25), parameter
        noise = np.trace(blocks(plain)[:, :3, :3], axis1=1, axis2=2)
        assert error > 2 * float(np.sqrt(np.mean(noise))), parameter  # what was stated before


def test_camera_json_is_read_for_it(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(CAMERA.record()))
    assert read_camera_covariance(path) is None
    stated = {"parameters": list(NAMES), "matrix": np.diag([1.0, 1, 4, 4]).tolist()}
    path.write_text(json.dumps({**CAMERA.record(), "covariance": stated}))
    found = read_camera_covariance(path)
    assert found is not None
    assert sum((c.cx - CAMERA.cx) ** 2 for c in found.deviations(CAMERA)) == pytest.approx(4.0)
    # The size of the image is exact: it is no parameter that a calibration could determine.
    unknown = ({"parameters": [name], "matrix": [[1]]} for name in ("zoom", "width", "height"))
    for wrong in ({"parameters": ["fx"], "matrix": [[1, 2]]}, *unknown, []):
        path.write_text(json.dumps({**CAMERA.record(), "covariance": wrong}))
        with pytest.raises(DataError, match="not a square matrix"):
            read_camera_covariance(path)


def test_the_covariance_of_the_lens_has_each_parameter_in_its_place() -> None:
    """Parameters that the calibration held fixed are all but exact; a lens of another model has none."""
    known = CameraCovariance(("cy", "fx", "p2"), np.array([[4.0, 0.5, 0.1], [0.5, 9.0, 0.2], [0.1, 0.2, 1.0]]))
    found = known.of_lens()
    assert found is not None
    expected = 1e-18 * np.eye(8)  # fx, fy, cx, cy, k1, k2, p1, p2
    for i, a in enumerate((3, 0, 7)):
        for j, b in enumerate((3, 0, 7)):
            expected[a, b] = known.matrix[i, j]
    assert np.array_equal(found, expected)
    assert CameraCovariance(("fx", "k3"), np.eye(2)).of_lens() is None


def test_deviations_of_the_camera_add_up_to_its_covariance() -> None:
    """Parameters of a thousand pixels and of thousandths alike, as they are correlated."""
    names, sigma = ("fx", "cy", "k1"), np.array([12.0, 3.0, 1e-4])
    matrix = np.array([[1.0, 0.6, -0.7], [0.6, 1.0, 0.1], [-0.7, 0.1, 1.0]]) * np.outer(sigma, sigma)
    moved_by = np.array(
        [
            [getattr(other, name) - getattr(CAMERA, name) for name in names]
            for other in CameraCovariance(names, matrix).deviations(CAMERA)
        ]
    )
    assert len(moved_by) == 3
    assert np.allclose(moved_by.T @ moved_by, matrix, rtol=1e-6, atol=1e-9 * np.outer(sigma, sigma))
