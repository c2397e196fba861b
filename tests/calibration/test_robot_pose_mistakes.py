"""Every usual mistake in a file of robot poses is named: units, rotations, orders of names, a lost row, a tool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.arm_kinematics import active_tool, forward
from service.compute.calibration.hand_eye_setup import PoseReading, PosesAsRead, check_setup
from service.compute.poses.robot_files import matched_rows, other_orders, read_robot_poses
from service.core.arms import arm_model
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse, look_at, transform

T_FLANGE_CAMERA = transform(Rotation.from_rotvec([0.02, -0.03, 1.55]), np.array([0.012, -0.055, 0.093]))
T_BASE_BOARD = transform(Rotation.from_euler("xyz", [176, 3, 40], degrees=True), np.array([0.7, -0.1, 0.05]))
NAMES = tuple(f"b{k}.jpg" for k in range(1, 15))
QUATERNIONS = "image,x,y,z,qx,qy,qz,qw"
VECTORS = "image,x,y,z,rx,ry,rz"


@dataclass(frozen=True)
class Session:
    """T_base_flange and T_camera_board of the images NAMES."""

    hands: Array
    boards: Array


@pytest.fixture(scope="module")
def session() -> Session:
    rng = np.random.default_rng(5)
    hands: list[Array] = []
    boards: list[Array] = []
    for _ in NAMES:
        tilt, azimuth = np.deg2rad(rng.uniform(10, 40)), rng.uniform(0, 2 * np.pi)
        eye = -rng.uniform(0.4, 0.7) * np.array(
            [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
        )
        T_board_camera = look_at(eye, rng.uniform(-0.05, 0.05, 3), rng.normal(0, 1, 3))
        hand = T_BASE_BOARD @ T_board_camera @ inverse(T_FLANGE_CAMERA)
        hand[:3, 3] += rng.normal(0, 1e-4, 3)
        hands.append(hand)
        boards.append(inverse(T_board_camera))
    return Session(np.array(hands), np.array(boards))


def _written(path: Path, header: str, position: Array, rotation: Array, names: tuple[str, ...] = NAMES) -> Path:
    lines = [
        ",".join([name, *(f"{v:.9g}" for v in (*p, *r))])
        for name, p, r in zip(names, position, rotation, strict=True)
    ]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def _quaternions(hands: Array) -> Array:
    return Rotation.from_matrix(hands[:, :3, :3]).as_quat()


def _check(path: Path, session: Session) -> None:
    """What the command does with a file before it solves."""
    table = read_robot_poses(path)
    rows = matched_rows(table, NAMES, path)
    every, taken = table.poses(), np.array([rows[name] for name in NAMES])
    readings = [PoseReading(poses[taken], words, remedy) for poses, words, remedy in table.other_readings()]
    readings += [
        PoseReading(every[[order[name] for name in NAMES]], words, "Give each image its own pose")
        for order, words in other_orders(rows)
    ]
    poses = PosesAsRead(every, taken, NAMES, tuple(readings))
    check_setup(every[taken], session.boards, point_m=np.zeros(3), setup="eye-in-hand", poses=poses)


def _turned(form: Literal["xyz", "ZYX", "XYZ", "ZYZ"], *, degrees: bool) -> Callable[[Array], Array]:
    return lambda hands: Rotation.from_matrix(hands[:, :3, :3]).as_euler(form, degrees=degrees)


def test_poses_as_they_should_be_pass(session: Session, tmp_path: Path) -> None:
    _check(_written(tmp_path / "p.csv", QUATERNIONS, session.hands[:, :3, 3], _quaternions(session.hands)), session)


@pytest.mark.parametrize(
    ("factor", "words", "option"),
    [(1e3, "in millimetres", "mm"), (1e2, "in centimetres", "cm"), (1 / 0.0254, "in inches", "in")],
)
def test_other_units_are_named_with_their_option(
    session: Session, tmp_path: Path, factor: float, words: str, option: str
) -> None:
    path = _written(tmp_path / "p.csv", QUATERNIONS, factor * session.hands[:, :3, 3], _quaternions(session.hands))
    with pytest.raises(ComputeError, match=words) as refused:
        _check(path, session)
    assert f"--length {option}" in refused.value.remedy


@pytest.mark.parametrize(
    ("header", "rotation", "words"),
    [
        (QUATERNIONS, lambda hands: _quaternions(hands)[:, [3, 0, 1, 2]], "quaternions w, x, y, z"),
        (QUATERNIONS, lambda hands: _quaternions(hands) * [-1, -1, -1, 1], r"inverted \(conjugated\)"),
        (VECTORS, lambda hands: np.degrees(Rotation.from_matrix(hands[:, :3, :3]).as_rotvec()), "vectors in degrees"),
        (VECTORS, _turned("xyz", degrees=False), "roll, pitch, yaw in radians"),
        (VECTORS, _turned("ZYX", degrees=False), "yaw, pitch, roll in radians"),
        (VECTORS, _turned("ZYX", degrees=True), "yaw, pitch, roll in degrees"),
        (VECTORS, _turned("XYZ", degrees=True), "turning x, y and z axes in degrees"),
        (VECTORS, _turned("ZYZ", degrees=True), "turning z, y and z axes in degrees"),
    ],
)
def test_rotations_written_in_another_way_are_named(
    session: Session, tmp_path: Path, header: str, rotation: Callable[[Array], Array], words: str
) -> None:
    path = _written(tmp_path / "p.csv", header, session.hands[:, :3, 3], rotation(session.hands))
    with pytest.raises(ComputeError, match=words):
        _check(path, session)


def test_two_mistakes_at_once_are_both_named(session: Session, tmp_path: Path) -> None:
    rotation = _quaternions(session.hands)[:, [3, 0, 1, 2]]
    path = _written(tmp_path / "p.csv", QUATERNIONS, 1e3 * session.hands[:, :3, 3], rotation)
    with pytest.raises(ComputeError, match="in millimetres and with the rotations as quaternions w, x, y, z"):
        _check(path, session)


@pytest.mark.parametrize("first", [0, 3, 7, 10])
def test_a_lost_row_is_named_with_the_first_image_after_it(session: Session, tmp_path: Path, first: int) -> None:
    hands = session.hands.copy()
    hands[first:-1] = hands[first + 1 :]
    path = _written(tmp_path / "p.csv", QUATERNIONS, hands[:, :3, 3], _quaternions(hands))
    begin = "each image" if first == 0 else f"from {NAMES[first]} on each"
    with pytest.raises(ComputeError, match=f"if {begin} has the pose of the row before its own"):
        _check(path, session)


def test_files_in_the_order_1_10_2_are_named(session: Session, tmp_path: Path) -> None:
    listed = sorted(NAMES)
    path = _written(
        tmp_path / "p.csv", QUATERNIONS, session.hands[:, :3, 3], _quaternions(session.hands), tuple(listed)
    )
    with pytest.raises(ComputeError, match="in the order 1, 10, 2 in which a folder lists its files"):
        _check(path, session)


def test_poses_of_an_active_tool_are_told_by_the_joints() -> None:
    arm, q = arm_model("UR10e"), np.random.default_rng(0).uniform(-2, 2, (12, 6))
    T_flange_tool = transform(Rotation.from_rotvec([0.1, 0.2, 0]), np.array([0.01, 0.0, 0.12]))
    found = active_tool(q, forward(arm, q) @ T_flange_tool)
    assert found is not None
    assert found[0].name == "UR10e"
    np.testing.assert_allclose(found[1], T_flange_tool, atol=1e-9)
    assert active_tool(q, forward(arm, q[::-1]) @ T_flange_tool) is None
