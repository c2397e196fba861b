"""PLY files as foreign programs write them, made byte by byte.

What they hold is derived by hand, from a box, and read by plyfile 1.1, which shares no code with ours or trimesh.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData

from drivers.errors import DeviceError, IncompleteExportError, UnreadableFileError
from drivers.meshes.mesh_file import read_mesh_file
from drivers.meshes.mesh_format import check_complete
from drivers.meshes.ply import read_ply, read_rows
from drivers.meshes.point_cloud import is_point_cloud, read_point_cloud
from tests.support.scenes.mesh_figures import (
    BOX_AREA_MM2,
    BOX_FACES,
    BOX_MM,
    BOX_VOLUME_MM3,
    area_mm2,
    volume_mm3,
)

# As Blender writes a box of which one side was cut into triangles: four corners, then three.
MIXED: tuple[tuple[int, ...], ...] = (*BOX_FACES[:-1], (2, 0, 4), (2, 4, 6))
FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
Row = Sequence[tuple[str, Any]]  # letters as in struct and values; a list has its count before it


def ply(form: str, elements: Sequence[tuple[str, Sequence[str], Sequence[Row]]], *, newline: str = "\n") -> bytes:
    """A PLY file: for each element its name, its properties as the header says them, and its rows."""
    lines = ["ply", f"format {form} 1.0", "comment made byte by byte", "obj_info also allowed"]
    for name, properties, rows in elements:
        lines += [f"element {name} {len(rows)}", *(f"property {words}" for words in properties)]
    head = (newline.join([*lines, "end_header"]) + newline).encode()
    rows_of_all = [row for _, _, rows in elements for row in rows]
    if form == "ascii":
        return head + b"".join((" ".join(f"{value:g}" for _, value in row) + newline).encode() for row in rows_of_all)
    order = "<" if form == "binary_little_endian" else ">"
    return head + b"".join(struct.pack(order + letter, value) for row in rows_of_all for letter, value in row)


def vertex(*more: tuple[str, str, Sequence[float]]) -> tuple[str, list[str], list[Row]]:
    """The element of the box's vertices, with further properties: type, name, and the value of each vertex."""
    kinds = {"uchar": "B", "float": "f", "ushort": "H"}
    properties = ["float x", "float y", "float z", *(f"{kind} {name}" for kind, name, _ in more)]
    rows: list[Row] = [
        [*(("f", value) for value in point), *((kinds[kind], values[n]) for kind, _, values in more)]
        for n, point in enumerate(BOX_MM.tolist())
    ]
    return "vertex", properties, rows


def face(faces: Sequence[Sequence[int]], words: str = "list uchar int vertex_indices", letters: str = "Bi") -> Any:
    count, index = letters
    return "face", [words], [[(count, len(one)), *((index, corner) for corner in one)] for one in faces]


def check_box(path: Path) -> None:
    check_complete(path)
    assert area_mm2(path) == pytest.approx(BOX_AREA_MM2, rel=1e-7)
    assert volume_mm3(path) == pytest.approx(BOX_VOLUME_MM3, rel=1e-7)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("faces", [BOX_FACES, MIXED, tuple(reversed(MIXED))])
def test_triangles_and_quadrangles_together(tmp_path: Path, form: str, faces: Sequence[Sequence[int]]) -> None:
    path = tmp_path / "box.ply"
    path.write_bytes(ply(form, [vertex(), face(faces)]))
    check_box(path)
    foreign: Any = PlyData.read(path)
    assert [list(one) for one in foreign["face"]["vertex_indices"]] == [list(one) for one in faces]


@pytest.mark.parametrize("form", FORMS)
def test_what_else_a_file_has_is_read_past_and_what_belongs_to_it_is_kept(tmp_path: Path, form: str) -> None:
    """Colours and normals at the vertices; at the faces a flag, a name's length, wedges; edges, cameras."""
    rng = np.random.default_rng(0)
    unit = BOX_MM - BOX_MM.mean(axis=0)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    colours = rng.integers(0, 256, (8, 4))
    properties = [("float", name, unit[:, k].tolist()) for k, name in enumerate(("nx", "ny", "nz"))]
    properties += [
        ("uchar", name, colours[:, k].tolist()) for k, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    uv = [(rng.integers(0, 9, 2 * len(one)) / 8).tolist() for one in MIXED]
    rows: list[Row] = []
    for one, wedges in zip(MIXED, uv, strict=True):
        row: list[tuple[str, Any]] = [("H", 7), ("B", len(one)), *(("I", corner) for corner in one), ("b", -1)]
        row += [("B", 2), ("h", -5), ("h", 5), ("I", len(wedges)), *(("f", value) for value in wedges), ("i", 3)]
        rows.append(row)
    faces = (
        "face",
        ["ushort flags", "list uint8 uint vertex_index", "char side", "list uchar short extra",
         "list uint float texcoord", "int texnumber"],
        rows,
    )  # fmt: skip
    camera = ("camera", ["float view_px", "list uchar double k"], [[("f", 1.5), ("B", 2), ("d", 2.0), ("d", 0.25)]])
    edges = ("edge", ["int vertex1", "int vertex2"], [[("i", 0), ("i", 1)], [("i", 1), ("i", 3)]])
    path = tmp_path / "box.ply"
    path.write_bytes(ply(form, [camera, vertex(*properties), edges, faces]))
    check_box(path)
    assert read_mesh_file(path, "mm").findings["normals_computed"] == 0

    raw, foreign = read_ply(path), PlyData.read(path)
    vertices: Any = foreign["vertex"]
    assert raw.normals is not None
    assert raw.colours is not None
    np.testing.assert_allclose(raw.normals, np.stack([vertices[name] for name in ("nx", "ny", "nz")], axis=1), 1e-6)
    np.testing.assert_allclose(raw.colours, colours[:, :3] / 255)
    assert raw.texture_uv is not None
    seen = {
        (int(v), *map(float, one)) for v, one in zip(raw.faces.ravel(), raw.texture_uv.reshape(-1, 2), strict=True)
    }
    wanted = {
        (int(corner), *map(float, one))
        for index, wedges in zip(foreign["face"]["vertex_index"], foreign["face"]["texcoord"], strict=True)
        for corner, one in zip(index, wedges.reshape(-1, 2), strict=True)
    }
    assert seen == wanted
    for name, rows_read in read_rows(path).items():
        for column, values in rows_read.columns.items():
            np.testing.assert_allclose(values, foreign[name][column], 1e-6)
        for column, (values, counts) in rows_read.lists.items():
            np.testing.assert_array_equal(values, np.concatenate(foreign[name][column]))
            assert counts.tolist() == [len(one) for one in foreign[name][column]]


def test_a_texture_with_seams_leaves_the_normals_of_the_file(tmp_path: Path) -> None:
    """Wedges split the vertices for a renderer, and are no reason to compute normals and say that none were."""
    leaning = [("float", "nx", [0.6] * 8), ("float", "ny", [0.0] * 8), ("float", "nz", [0.8] * 8)]
    rows: list[Row] = [
        [("B", 4), *(("i", corner) for corner in one), ("B", 8), *(("f", value) for value in np.arange(8.0) + n)]
        for n, one in enumerate(BOX_FACES)
    ]
    faces = ("face", ["list uchar int vertex_indices", "list uchar float texcoord"], rows)
    path = tmp_path / "box.ply"
    path.write_bytes(ply("binary_little_endian", [vertex(*leaning), faces]))
    scan = read_mesh_file(path, "mm")
    assert scan.findings["normals_computed"] == 0
    np.testing.assert_allclose(scan.mesh.normals, [[0.6, 0, 0.8]] * 8, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "letters"),
    [
        ("list uchar int vertex_index", "Bi"),
        ("list uint8 uint32 vertex_indices", "BI"),
        ("list int int vertex_indices", "ii"),
        ("list ushort ushort vertex_indices", "HH"),
        ("list char uchar vertex_indices", "bB"),
        ("list uchar int Vertex_Indices", "Bi"),
        ("list uchar int indices", "Bi"),
    ],
)
@pytest.mark.parametrize("form", FORMS)
def test_the_list_of_corners_has_several_names_and_types(tmp_path: Path, form: str, words: str, letters: str) -> None:
    path = tmp_path / "box.ply"
    path.write_bytes(ply(form, [vertex(), face(MIXED, words, letters)]))
    check_box(path)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("newline", ["\r\n", "\r"])
def test_lines_of_the_header_end_in_three_ways(tmp_path: Path, form: str, newline: str) -> None:
    """A first byte of the data that is a newline is none, if the header's lines end with a return."""
    path = tmp_path / "box.ply"
    first = ("first", ["uchar a"], [[("B", 10)]])
    path.write_bytes(ply(form, [first, vertex(), face(MIXED)], newline=newline))
    check_box(path)


@pytest.mark.parametrize("comment", ["für die Wirbelsäule", "“Schädel”", "背骨", "脊柱", "позвоночник"])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "cp1252", "cp932", "gbk", "cp1251", "utf-8-sig"])
def test_a_comment_may_be_in_any_encoding(tmp_path: Path, comment: str, encoding: str) -> None:
    path = tmp_path / "box.ply"
    raw = comment.encode(encoding, "replace").removeprefix(b"\xef\xbb\xbf")
    content = ply("binary_little_endian", [vertex(), face(BOX_FACES)]).replace(b"made byte by byte", raw)
    path.write_bytes((b"\xef\xbb\xbf" if encoding == "utf-8-sig" else b"") + content)
    check_box(path)


def test_a_text_without_a_last_newline_or_with_odd_blanks(tmp_path: Path) -> None:
    path = tmp_path / "box.ply"
    content = ply("ascii", [vertex(), face(MIXED)])
    head, _, rows = content.partition(b"end_header\n")
    for written in (content.rstrip(b"\n"), head + b"end_header\n" + rows.replace(b" ", b" \t "), content + b"\n\n"):
        path.write_bytes(written)
        check_box(path)


def test_no_library_complains_on_the_terminal(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """Trimesh logged a traceback where a texture was named."""
    content = ply("ascii", [vertex(), face(BOX_FACES)])
    path = tmp_path / "box.ply"
    path.write_bytes(content.replace(b"comment made", b"comment TextureFile skin.png\ncomment made"))
    (tmp_path / "skin.png").write_bytes(b"a picture")
    with caplog.at_level(logging.WARNING):
        scan = read_mesh_file(path, "mm")
    assert scan.source.files == (path, tmp_path / "skin.png")
    assert scan.findings["textures"] == 1
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_a_cloud_is_read_by_the_same_reader(tmp_path: Path) -> None:
    """Also one that says it has faces, and has none, and one whose comment is Latin-1."""
    path = tmp_path / "points.ply"
    for form in FORMS:
        content = ply(form, [vertex(), face([])]).replace(b"made byte", "für".encode("latin-1"))
        path.write_bytes(content)
        assert is_point_cloud(path)
        np.testing.assert_allclose(1e3 * read_point_cloud(path, "mm").points_m, BOX_MM, atol=1e-3)


@pytest.mark.parametrize("form", FORMS)
def test_a_file_that_lacks_its_end_is_never_read_as_a_smaller_one(tmp_path: Path, form: str) -> None:
    path = tmp_path / "box.ply"
    content = ply(form, [vertex(), face(MIXED)])
    start = content.index(b"end_header\n") + len(b"end_header\n")
    for end in range(len(content) - (2 if form == "ascii" else 0)):  # the last figure may be half a number
        path.write_bytes(content[:end])
        with pytest.raises((IncompleteExportError, UnreadableFileError)) as caught:
            read_mesh_file(path, "mm")
        assert caught.value.where == str(path)
        # A count that was cut in two may be any number; everything else is known to be cut short.
        if end < start - 1 or form != "ascii":
            assert isinstance(caught.value, IncompleteExportError)


def artec(faces: Sequence[Sequence[int]] = BOX_FACES, uv: tuple[str, str] = ("u", "v")) -> bytes:
    """A PLY with two textures, with the header that Artec Studio writes (openscenegraph/OpenSceneGraph#908)."""
    corners = [(number, corner) for number, one in enumerate(faces) for corner in one]
    places: list[Row] = [[("B", number % 2), ("f", 0.5), ("f", corner / 8)] for number, corner in corners]
    ends = np.cumsum([len(one) for one in faces]).tolist()
    wedges: list[Row] = [
        [("B", n % 2), ("I", n % 2), ("B", len(one)), *(("i", ends[n] - len(one) + k) for k in range(len(one)))]
        for n, one in enumerate(faces)
    ]
    content = ply(
        "binary_little_endian",
        [
            vertex(),
            face(faces),
            ("multi_texture_vertex", ["uchar tx", *(f"float {name}" for name in uv)], places),
            (
                "multi_texture_face",
                ["uchar tx", "uint tn", "list uchar int texture_vertex_indices"],
                wedges,
            ),
        ],
    )
    maker = b"comment File exported by Artec Group 3D Scanning Solutions\ncomment www.artec-group.com\n"
    return content.replace(b"comment made byte by byte\nobj_info also allowed\n", maker)


@pytest.mark.parametrize("uv", [("u", "v"), ("texture_u", "texture_v")])
@pytest.mark.parametrize("faces", [BOX_FACES, MIXED])
def test_the_textures_of_an_artec_ply_come_with_it_though_it_does_not_name_them(
    tmp_path: Path, uv: tuple[str, str], faces: Sequence[Sequence[int]]
) -> None:
    path = tmp_path / "ein scan.ply"
    path.write_bytes(artec(faces, uv))
    check_complete(path)
    for present in ((), ("ein scan_0.jpg",), ("Ein Scan_0.JPG",)):
        for name in present:
            (tmp_path / name).write_bytes(b"a picture")
        with pytest.raises(IncompleteExportError, match=rf"texture ein scan_{len(present)} .* is missing"):
            read_mesh_file(path, "mm")
    (tmp_path / "Ein Scan_0.JPG").unlink()
    (tmp_path / "ein scan_1.png").write_bytes(b"another")
    (tmp_path / "ein scan_3.jpg").write_bytes(b"of another scan")
    scan = read_mesh_file(path, "mm")
    assert scan.source.files == (path, tmp_path / "ein scan_0.jpg", tmp_path / "ein scan_1.png")
    assert scan.findings["textures"] == 2
    check_box(path)
    places = read_ply(path).texture_uv
    assert places is not None
    corners = read_ply(path).faces
    assert np.allclose(places[..., 1], corners / 8)


def test_an_artec_ply_without_textures_needs_none(tmp_path: Path) -> None:
    path = tmp_path / "box.ply"
    path.write_bytes(artec().split(b"element multi")[0] + b"end_header\n" + ply(
        "binary_little_endian", [vertex(), face(BOX_FACES)]
    ).partition(b"end_header\n")[2])  # fmt: skip
    assert read_mesh_file(path, "mm").findings["textures"] == 0


@pytest.mark.parametrize("faces", [[(0, 1, 3), (0, 3, 2)] * 8, MIXED])
def test_an_artec_ply_that_is_still_being_written_is_incomplete_wherever_it_ends(
    tmp_path: Path, faces: Sequence[Sequence[int]]
) -> None:
    path = tmp_path / "box.ply"
    content = artec(faces)
    for name in ("box_0.jpg", "box_1.jpg"):
        (tmp_path / name).write_bytes(b"a picture")
    for end in range(0, len(content), 7):
        path.write_bytes(content[:end])
        with pytest.raises(IncompleteExportError):
            read_mesh_file(path, "mm")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ((b"float z", b"float w"), "no vertices with x, y and z"),
        ((b"list uchar int vertex_indices", b"list uchar int friends"), "no list of vertices, only friends"),
        ((b"float z", b"float128 z"), "header is wrong"),
        ((b"format binary_little_endian", b"format binary_mixed_endian"), "header is wrong"),
        ((b"element face 7", b"element face -7"), "header is wrong"),
        ((b"element face 7", b"element face 6"), "longer than its header announces"),
        ((b"element face 7", b"element face 700000000"), "cut short"),
        ((b"ply\n", "ply\n".encode("utf-16")), "UTF-16"),
        ((b"ply\n", b"plz\n"), "does not begin like a PLY"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: tuple[bytes, bytes], words: str) -> None:
    path = tmp_path / "box.ply"
    path.write_bytes(ply("binary_little_endian", [vertex(), face(MIXED)]).replace(*change, 1))
    with pytest.raises(DeviceError, match=words) as caught:
        read_mesh_file(path, "mm")
    assert caught.value.where == str(path)
    assert caught.value.remedy
