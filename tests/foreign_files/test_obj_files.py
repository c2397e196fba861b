"""OBJ files as foreign programs write them, made byte by byte; what they hold is derived by hand, from a box."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.meshes.mesh_file import read_mesh_file
from drivers.meshes.mesh_format import check_complete
from drivers.meshes.obj import read_obj
from service.cli.main import app
from tests.support.scenes.mesh_figures import (
    BOX_AREA_MM2,
    BOX_FACES,
    BOX_MM,
    BOX_VOLUME_MM3,
    area_mm2,
    volume_mm3,
)

VERTICES = ["v " + " ".join(f"{value:g}" for value in point) for point in BOX_MM]
FACES = ["f " + " ".join(str(corner + 1) for corner in face) for face in BOX_FACES]
BOX = "\n".join([*VERTICES, *FACES, ""])


def check_box(path: Path) -> None:
    assert area_mm2(path) == pytest.approx(BOX_AREA_MM2, rel=1e-9)
    assert volume_mm3(path) == pytest.approx(BOX_VOLUME_MM3, rel=1e-9)
    assert read_mesh_file(path, "mm").findings["vertices"] == 8


def back(corner: int) -> str:
    return str(corner - 8)  # -1 is the last vertex


WRITTEN: dict[str, bytes] = {
    "tabs": BOX.replace(" ", "\t").encode(),
    "indented": "\n".join("  " + line for line in BOX.split("\n")).encode(),
    "indented with tabs": "\n".join("\t" + line for line in BOX.split("\n")).encode(),
    "many blanks": BOX.replace(" ", "   ").replace("\n", "  \n").encode(),
    "no last newline": BOX.rstrip("\n").encode(),
    "CRLF": BOX.replace("\n", "\r\n").encode(),
    "CR": BOX.replace("\n", "\r").encode(),
    "CR without the last": BOX.rstrip("\n").replace("\n", "\r").encode(),
    "lines that go on": BOX.replace(" ", " \\\n", 3).replace("f 1 3 4 2", "f 1 3 \\\n  4 \\\r\n2").encode(),
    "negative indices": "\n".join(
        [*VERTICES, *("f " + " ".join(back(corner) for corner in face) for face in BOX_FACES)]
    ).encode(),
    "faces first": "\n".join([*FACES, *VERTICES, ""]).encode(),
    "remarks behind numbers": BOX.replace("\n", " # 1 2 3\n").encode(),
    "a remark that ends with a folder": b"# C:\\scans\\\n" + BOX.encode(),
    "UTF-8 with a mark": b"\xef\xbb\xbf" + BOX.encode(),
    "UTF-16 with a mark": BOX.encode("utf-16"),
    "UTF-16, big endian, with a mark": b"\xfe\xff" + BOX.encode("utf-16-be"),
    "UTF-16 without a mark": BOX.encode("utf-16-le"),
    "Latin-1": "# für die Wirbelsäule\no Rücken\n".encode("latin-1") + BOX.encode(),
    "Latin-1 at the end": BOX.encode() + "# Ende der Prüfung".encode("latin-1"),
    "Windows-1252": "# “Schädel” – 5 €\n".encode("cp1252") + BOX.encode(),
    # The second byte of these characters is a backslash: the next line does not belong to theirs.
    "Shift-JIS": "o ソ\nusemtl 表\n".encode("cp932") + BOX.encode(),
    "GBK": "o 脊柱\n".encode("gbk") + BOX.encode(),
    "a zero byte in a remark": b"# \0\n" + BOX.encode(),
    "exponents": BOX.replace("300", "3.0E+02").replace("200", "2e2").encode(),
    "a weight": "\n".join([*(line + " 1.0" for line in VERTICES), *FACES, ""]).encode(),
    "texture coordinates of three numbers": BOX.replace("\nf", "\nvt 0 0 0\nf", 1).encode(),
    "points and lines too": BOX.encode() + b"p 1 2\nl 1 2 3\n",
    "ends with a line of another kind": BOX.encode() + b"l 1 2",
    "a remark with a count beyond belief": b"# " + b"9" * 5000 + b" vertices\n" + BOX.encode(),
    "ends with a group without a name": BOX.encode() + b"g",
    "several objects": BOX.replace("\nf", "\no one\nf", 1).encode() + b"g two\ns off\n",
    "pixels without a measurement": b"v nan nan nan\n" + "\n".join([*VERTICES, "v nan nan nan", *(
        "f " + " ".join(str(corner + 2) for corner in face) for face in BOX_FACES
    )]).encode(),
    "capitals of keywords in names": BOX.encode() + b"o V 1 2 3\n",
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_however_it_is_written_the_box_is_a_box(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Trimesh would like to have it for text that is not UTF-8; our installations do not.
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    path = tmp_path / "box.obj"
    path.write_bytes(WRITTEN[name])
    check_complete(path)
    check_box(path)


def test_an_index_below_zero_counts_from_the_line_where_it_is(tmp_path: Path) -> None:
    """Programs that append one object after another write each with its own vertices and -1, -2, …"""
    lines: list[str] = []
    for shift in (0, 400):
        lines += [f"v {x + shift:g} {y:g} {z:g}" for x, y, z in BOX_MM]
        lines += ["f " + " ".join(back(corner) for corner in face) for face in BOX_FACES]
    path = tmp_path / "two.obj"
    path.write_text("\n".join(lines))
    assert volume_mm3(path) == pytest.approx(2 * BOX_VOLUME_MM3, rel=1e-9)
    assert read_mesh_file(path, "mm").findings["components"] == 2


def test_what_belongs_to_corners_stays_with_them(tmp_path: Path) -> None:
    """Normals, texture coordinates and colours, in a file whose seam gives a vertex two texture coordinates."""
    path = tmp_path / "square.obj"
    path.write_text(
        "v 0 0 0 1 0 0\nv 300 0 0 0 1 0\nv 300 200 0 0 0 1\nv 0 200 0 1 1 1\n"
        "vn 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .5 .5\n"
        "f 1/1/1 2/2/1 3/3/1\nf 1/5/1 3/3/1 4/4/1\n"
    )
    raw = read_obj(path)
    assert raw.normals is not None
    assert raw.colours is not None
    assert raw.texture_uv is not None
    assert raw.normals.tolist() == [[0, 0, 1]] * 4
    assert raw.colours.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    assert raw.texture_uv.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0.5, 0.5], [1, 1], [0, 1]]]
    assert read_mesh_file(path, "mm").findings["normals_computed"] == 0


@pytest.mark.parametrize(
    ("faces", "computed"),
    [
        ("f 1//1 2//1 3//1", 0),
        ("f 1/1/1 2/1/1 3/1/1", 0),
        ("f 1 2 3", 1),  # it has normals, and no face refers to them
        ("f 1/1 2/1 3/1", 1),  # a texture with seams, as MeshLab writes wedges
        ("f 1//1 2//1 3//1\nf 1 3 4", 1),  # not each corner has one
    ],
)
def test_the_record_says_whether_the_normals_are_the_files(tmp_path: Path, faces: str, computed: int) -> None:
    """The file's normal leans, the computed one does not."""
    path = tmp_path / "square.obj"
    vertices = "v 0 0 0\nv 300 0 0\nv 300 200 0\nv 0 200 0\nvt 0 0\nvn 0 0.6 0.8\nvn 0 0.6 0.8\nvn 0 0.6 0.8\n"
    path.write_text(vertices + "vn 0 0.6 0.8\n" + faces + "\n")
    scan = read_mesh_file(path, "mm")
    assert scan.findings["normals_computed"] == computed
    wanted = [0, 0, 1] if computed else [0, 0.6, 0.8]
    np.testing.assert_allclose(scan.mesh.normals[:3], [wanted] * 3, atol=1e-12)


@pytest.mark.parametrize(
    ("end", "words"),
    [
        (b"f 1 2", "middle of a line"),
        (b"f", "middle of a line"),
        (b"v 1 2", "middle of a line"),
        (b"f 1 2 \\", "middle of a line"),
        (b"usemt", "middle of a line"),
        (b"# 20 faces\n", "6 faces of 20"),
        (b"# faces: 20", "6 faces of 20"),
    ],
)
def test_a_file_that_is_still_written_is_waited_for(tmp_path: Path, end: bytes, words: str) -> None:
    path = tmp_path / "box.obj"
    path.write_bytes(BOX.encode() + end)
    with pytest.raises(IncompleteExportError, match=words):
        check_complete(path)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("v 1,5 2,5 3,5", r"line 15: '1,5' is not a number \(a decimal comma\)"),
        ("v 1 2", "line 15: 2 numbers in a line of 3"),
        ("f 1 2 zwei", "line 15: 'zwei' is not a number"),
        ("f 1 2 1.5", "line 15: '1.5' is not a number"),
        ("f 1 2 0", "line 15: a corner must be"),
        ("f 1 2 /3", "line 15: a corner must be"),
        ("f 1/1/1/1 2 3", "line 15: a corner must be"),
        ("f 1 2 99", "vertex 98 of 8"),
        ("f 1 2 -99", "vertex -91 of 8"),
    ],
)
def test_a_wrong_line_is_refused_by_its_number(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "box.obj"
    path.write_text(f"{BOX}{line}\nf 1 2 3\n")
    with pytest.raises(UnreadableFileError, match=words) as caught:
        read_mesh_file(path, "mm")
    assert caught.value.where == str(path)


def test_the_command_reads_what_a_german_program_wrote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball of 30 mm on a plate, with an object's name in Latin-1 and a material whose name is in Latin-1."""
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    (tmp_path / "Rücken.mtl").write_bytes("newmtl Haut\n".encode("latin-1"))
    plate = [f"v {x + 200:g} {y:g} {z:g}" for x, y, z in BOX_MM]
    plate += ["f " + " ".join(back(corner) for corner in face) for face in BOX_FACES]
    content = ball() + "\n".join(plate).encode()
    (tmp_path / "ball.obj").write_bytes("mtllib Rücken.mtl\no Wirbelsäule\n".encode("latin-1") + content)
    words = [
        "spheres",
        "--mesh",
        str(tmp_path / "ball.obj"),
        "--radius-mm",
        "30",
        "--out",
        str(tmp_path / "out.json"),
    ]
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 0, answer.output
    (centre,) = json.loads((tmp_path / "out.json").read_text())["registration_mm"]
    np.testing.assert_allclose(centre, [0, 0, 300], atol=0.01)


def ball() -> bytes:
    """A ball of radius 30 mm around (0, 0, 300) by latitude and longitude, its faces quadrangles and triangles."""
    n, m = 40, 60
    polar = np.pi * np.arange(1, n) / n
    around = 2 * np.pi * np.arange(m) / m
    ring = np.stack(np.broadcast_arrays(
        np.sin(polar)[:, None] * np.cos(around), np.sin(polar)[:, None] * np.sin(around), np.cos(polar)[:, None]
    ), axis=2).reshape(-1, 3)  # fmt: skip
    points = 30 * np.concatenate([[[0, 0, 1]], ring, [[0, 0, -1]]]) + np.array([0, 0, 300])
    last = len(points)

    def at(row: int, column: int) -> int:
        return 2 + row * m + column % m

    faces = [f"f 1 {at(0, k)} {at(0, k + 1)}" for k in range(m)]
    faces += [
        f"f {at(r, k)} {at(r + 1, k)} {at(r + 1, k + 1)} {at(r, k + 1)}" for r in range(n - 2) for k in range(m)
    ]
    faces += [f"f {last} {at(n - 2, k + 1)} {at(n - 2, k)}" for k in range(m)]
    rows = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in points]
    return ("\n".join([*rows, *faces]) + "\n").encode()
