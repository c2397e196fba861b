"""Robot poses as robots write them: Universal Robots' pendant and RTDE, KUKA, FANUC, with or without header.

The first rows are those of a UR10e's file in metres and rotation vectors. The expected rotations come from Rodrigues'
formula (axis = v / |v|, angle = |v|), written out here, not from the reader under test.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.compute.poses.robot_files import matched_rows, read_robot_poses
from service.core.errors import DataError
from service.core.geometry import Array

ROWS = ("1.000401 -0.062028 0.490841 -2.033123 -1.699513 0.166847", "0.775209 -0.184027 0.497083 0 0 1.570796")
POSITIONS = ((1.000401, -0.062028, 0.490841), (0.775209, -0.184027, 0.497083))


def _rodrigues(v: Array) -> Array:
    angle = float(np.linalg.norm(v))
    x, y, z = v / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


EXPECTED = np.array([_rodrigues(np.array([float(cell) for cell in row.split()[3:]])) for row in ROWS])
RTDE = "timestamp " + " ".join(f"actual_TCP_pose_{k}" for k in range(6)) + " robot_mode"


@pytest.mark.parametrize(
    "lines",
    [
        ROWS,
        [row.replace(" ", ",") for row in ROWS],
        [f"p[{row.replace(' ', ', ')}]" for row in ROWS],
        [f"b{k}.jpg {row}" for k, row in enumerate(ROWS)],
        ["x y z rx ry rz", *ROWS],
        ["image,x,y,z,rx,ry,rz", *(f"b{k}.jpg,{row.replace(' ', ',')}" for k, row in enumerate(ROWS))],
        [RTDE, *(f"{k}.002 {row} 7" for k, row in enumerate(ROWS))],
    ],
    ids=["blanks", "commas", "urscript", "names", "header", "header and names", "rtde"],
)
def test_a_universal_robots_poses_are_read(tmp_path: Path, lines: list[str]) -> None:
    (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
    table = read_robot_poses(tmp_path / "poses.txt")
    np.testing.assert_allclose(table.poses()[:, :3, 3], POSITIONS, atol=1e-12)
    np.testing.assert_allclose(table.poses()[:, :3, :3], EXPECTED, atol=1e-9)
    assert matched_rows(table, ["b1.jpg", "b0.jpg"], tmp_path / "poses.txt") == {"b0.jpg": 0, "b1.jpg": 1}


def test_millimetres_are_read_by_their_option_or_their_header(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("1000.401 -62.028 490.841 -2.033123 -1.699513 0.166847\n")
    np.testing.assert_allclose(read_robot_poses(path, unit="mm").poses()[0, :3, 3], POSITIONS[0], atol=1e-12)
    path.write_text("image,x_mm,y_mm,z_mm,rx,ry,rz\nb0.jpg,1000.401,-62.028,490.841,-2.033123,-1.699513,0.166847\n")
    np.testing.assert_allclose(read_robot_poses(path).poses()[0, :3, 3], POSITIONS[0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "R"),
    [
        # KUKA: A about z, then B about the new y, then C about the new x, in degrees; positions in mm.
        ("image,X,Y,Z,A,B,C\na.jpg,500,0,250,90,0,0\n", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ("image,X,Y,Z,A,B,C\na.jpg,500,0,250,90,0,90\n", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        # FANUC: W, P, R about the fixed x, y and z.
        ("image,X,Y,Z,W,P,R\na.jpg,500,0,250,90,0,90\n", [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        # Scalar first, as the header says.
        ("image,x,y,z,qw,qx,qy,qz\na.jpg,0.5,0,0.25,0,0,0,1\n", [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]),
    ],
)
def test_a_header_says_how_rotations_are_written(tmp_path: Path, text: str, R: list[list[float]]) -> None:
    (tmp_path / "p.csv").write_text(text)
    (T,) = read_robot_poses(tmp_path / "p.csv").poses()
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [0.5, 0, 0.25], atol=1e-12)


def test_rows_without_names_need_one_for_each_image(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(ROWS))
    table = read_robot_poses(path)
    assert matched_rows(table, ["v10.jpg", "v2.jpg"], path) == {"v2.jpg": 0, "v10.jpg": 1}
    with pytest.raises(DataError, match="2 rows without names of images, 3 images"):
        matched_rows(table, ["a.jpg", "b.jpg", "c.jpg"], path)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "no pose"),
        ("image,x,y,z\n", "the first line is"),
        ("1 2 3\n", "3 numbers in the first line"),
        (f"image,x,y,z,rx,ry,rz\na.jpg,{ROWS[0].replace(' ', ',')},9\n", "8 fields instead of 7"),
        ("image,x,y,z,qx,qy,qz,qw\na.jpg,0,0,0,0,0,0,0.9\n", "length is 0.9000, not 1"),
        ("image,x,y,z,rx,ry,rz\na.jpg,0,0,0,0,0,x\n", "not a number"),
        ("image,x,y,z,rx,ry,rz\na.jpg,0,0,0,0,0,1\na.jpg,0,0,0,0,0,1\n", "two poses"),
    ],
)
def test_tables_that_are_wrong_are_refused(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(DataError, match=what):
        read_robot_poses(tmp_path / "p.csv")


def test_names_are_matched_as_those_of_camera_poses_are(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    rows = [f"{name},{row.replace(' ', ',')}\n" for name, row in zip(("C:\\scans\\B0", "B1.JPG"), ROWS, strict=False)]
    path.write_text("".join(("image,x,y,z,rx,ry,rz\n", *rows)))
    assert matched_rows(read_robot_poses(path), ["b1.jpg", "b0.jpg"], path) == {"b0.jpg": 0, "b1.jpg": 1}
    with pytest.raises(DataError, match="it is not clear whose pose it is"):
        matched_rows(read_robot_poses(path), ["b0.jpg", "b0.png"], path)
