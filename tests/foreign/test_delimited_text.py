"""Tables as spreadsheets and programs of other countries write them: read in one way only, or refused by name.

The values are derived by hand: each file is written here byte by byte from the numbers that it must give.
"""

from __future__ import annotations

import codecs
from pathlib import Path

import pytest

from service.compute.poses.pose_files import read_poses
from service.compute.poses.robot_files import read_joints_csv, read_stations
from service.core.errors import DataError
from service.core.text_files import TextTable, read_table

POSE = (0.25, -1.5, 0.125)  # x y z; the quaternion is that of no rotation
DOTS = ("0.25", "-1.5", "0.125", "0", "0", "0", "1.0")
COMMAS = ("0,25", "-1,5", "0,125", "0", "0", "0", "1,0")
HEADER = ("image", "x", "y", "z", "qx", "qy", "qz", "qw")


def _file(separator: str, numbers: tuple[str, ...], end: str = "\n") -> str:
    return end.join([separator.join(HEADER), separator.join(("a.jpg", *numbers)), ""])


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(_file(",", DOTS).encode(), id="plain"),
        pytest.param(_file(";", DOTS).encode(), id="semicolons"),
        pytest.param(_file("\t", DOTS).encode(), id="tabs"),
        pytest.param(_file(" ", DOTS).encode(), id="spaces"),
        pytest.param(_file(", ", DOTS).encode(), id="commas and spaces"),
        pytest.param(_file(";", COMMAS).encode(), id="semicolons and decimal commas"),
        pytest.param(_file("\t", COMMAS).encode(), id="tabs and decimal commas"),
        pytest.param(_file("  ", COMMAS).encode(), id="spaces and decimal commas"),
        pytest.param(_file(";", COMMAS, "\r\n").encode(), id="line ends of Windows"),
        pytest.param(_file(",", DOTS, "\r").encode(), id="line ends of old Macs"),
        pytest.param(codecs.BOM_UTF8 + _file(";", COMMAS).encode(), id="UTF-8 with a mark"),
        pytest.param(_file(",", DOTS).encode("utf-16"), id="UTF-16"),
        pytest.param(codecs.BOM_UTF16_BE + _file("\t", DOTS).encode("utf-16-be"), id="UTF-16, high byte first"),
        pytest.param(_file(";", COMMAS).encode("utf-16-le"), id="UTF-16 without a mark"),
        pytest.param(b"sep=;\r\n" + _file(";", COMMAS, "\r\n").encode(), id="Excel's line sep="),
        pytest.param(_file(",", DOTS).replace("\n", ",,\n").encode(), id="empty columns of a spreadsheet"),
        pytest.param(_file(",", DOTS).replace("-1.5", "\N{MINUS SIGN}1.5").encode(), id="typographic minus"),
        pytest.param(_file(",", tuple(f'"{n}"' for n in COMMAS)).encode(), id="quoted decimal commas"),
        pytest.param(_file(";", DOTS).replace("a.jpg", '"a.jpg"').encode(), id="quoted name"),
        pytest.param(b"# by a program\n\n" + _file(",", DOTS).encode() + b"\n\x1a", id="comment and end mark"),
    ],
)
def test_one_pose_is_read_from_every_form_that_has_one_meaning(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_bytes(data)
    (T,) = read_poses(tmp_path / "poses.csv", ["a.jpg"]).values()
    assert tuple(T[:3, 3]) == POSE


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (_file(",", (*COMMAS[:3], "0,0", "0,0", "0,0", "1,0")), "looks like one number with a decimal comma"),
        (_file(";", ("0,25", "-1.5", *DOTS[2:])), "both a decimal comma (0,25) and a decimal point (-1.5)"),
        (_file(";", ("1.234,5", *COMMAS[1:])), "1.234,5 has marks between its thousands"),
        (_file(";", ("1,234", "985", "2", "0", "0", "0", "1")), "1,234 can be a thousand or have a decimal comma"),
    ],
)
def test_a_form_with_two_meanings_is_refused_by_name(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(DataError) as caught:
        read_poses(tmp_path / "poses.csv", ["a.jpg"])
    assert words in str(caught.value)
    assert str(tmp_path / "poses.csv") in caught.value.where
    assert caught.value.remedy


def test_points_without_a_header_are_not_read_as_twice_as_many_numbers() -> None:
    with pytest.raises(DataError, match="looks like one number with a decimal comma"):
        read_table(b"8,2028,-4,5805,10,7645\n1,8838,-9,1624,11,1790\n", "points.txt")
    # The second numbers of the pairs are negative: they are no decimals.
    assert len(read_table(b"8,-28,-4,-58,10,-76\n1,-88,-9,-62,11,-79\n", "points.txt").rows) == 2


def test_points_with_decimal_commas_and_spaces_are_read() -> None:
    table = read_table(b"8,2028 -4,5805 10,7645\n1,8838 -9,1624 11,1790\n-5,3938  -2,4490\t16,9315", "points.txt")
    assert [row.cells for row in table.rows][2] == ("-5.3938", "-2.4490", "16.9315")
    assert [row.line for row in table.rows] == [1, 2, 3]


def test_words_that_are_not_utf8_are_refused_with_the_line_unless_only_numbers_matter() -> None:
    data = b"Punkt;H\xf6he\nP1;1,5\n"
    with pytest.raises(DataError, match="not UTF-8") as caught:
        read_table(data, "points.csv")
    assert caught.value.where == "points.csv:1"
    table: TextTable = read_table(data, "points.csv", numbers_only=True)
    assert table.rows[1].cells == ("P1", "1.5")


def test_joints_and_stations_are_read_from_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "joints.csv").write_text("image;q1;q2\nimages\\A.JPG;0,5;-1,25\n")
    assert read_joints_csv(tmp_path / "joints.csv", ["a.jpg"])["a.jpg"].tolist() == [0.5, -1.25]
    (tmp_path / "stations.csv").write_bytes("image\tstation\nC:\\a\tl\u00e4ngs\n".encode("utf-16"))
    assert read_stations(tmp_path / "stations.csv", ["a.jpg"]) == {"a.jpg": "l\u00e4ngs"}
