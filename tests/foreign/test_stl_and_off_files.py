"""STL and OFF files as foreign programs write them, made byte by byte; what they hold is derived from a box."""

from __future__ import annotations

import gzip
import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drivers.errors import DeviceError, IncompleteExportError, UnreadableFileError
from drivers.meshes.mesh_file import read_mesh_file
from drivers.meshes.mesh_format import check_complete
from drivers.meshes.surface_file import read_surface_file
from tests.support.scenes.mesh_figures import BOX_AREA_MM2, BOX_FACES, BOX_MM, BOX_VOLUME_MM3, area_mm2, volume_mm3

TRIANGLES = [(a, b, c) for a, b, c, _ in BOX_FACES] + [(a, c, d) for a, _, c, d in BOX_FACES]


def facet(corners: tuple[int, ...]) -> str:
    rows = "".join("      vertex {} {} {}\n".format(*BOX_MM[corner]) for corner in corners)
    return f"  facet normal 0 0 0\n    outer loop\n{rows}    endloop\n  endfacet\n"


BOX = "solid box\n" + "".join(map(facet, TRIANGLES)) + "endsolid box\n"


def binary(header: bytes = b"") -> bytes:
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *(BOX_MM[list(corners)].ravel()), 0) for corners in TRIANGLES)
    return header.ljust(80, b" ") + struct.pack("<I", len(TRIANGLES)) + facets


WRITTEN: dict[str, bytes] = {
    "plain": BOX.encode(),
    "capitals": BOX.upper().encode(),
    "capitals as words": BOX.replace("vertex", "Vertex").replace("facet normal", "Facet Normal").encode(),
    "tabs": BOX.replace("    ", "\t").replace(" ", "\t").encode(),
    "CRLF": BOX.replace("\n", "\r\n").encode(),
    "CR": BOX.replace("\n", "\r").encode(),
    "no last newline": BOX.rstrip().encode(),
    "one line": BOX.replace("\n", " ").replace("solid box ", "solid box\n", 1).encode(),
    "exponents": BOX.replace("300.0", "3.000000E+002").replace("200.0", "+2e2").encode(),
    "UTF-8 with a mark": b"\xef\xbb\xbf" + BOX.encode(),
    "a name in Latin-1": BOX.replace("box", "Wirbelsäule").encode("latin-1"),
    "a name in Shift-JIS": BOX.replace("box", "背骨 ソ").encode("cp932"),
    "a name with the format's words": BOX.replace("solid box", "solid a vertex of endloop 1 2 3").encode(),
    "no name": BOX.replace(" box", "").encode(),
    "several solids": (BOX.replace("endsolid box", "endsolid box\nsolid other\nendsolid other")).encode(),
    "quadrangles": ("solid\n" + "".join(map(facet, BOX_FACES)) + "endsolid\n").encode(),
    "binary": binary(),
    "binary that begins like a text": binary(b"solid exported by a program"),
    "binary with a name in Latin-1": binary("solid Wirbelsäule".encode("latin-1")),
    "binary with zero bytes": binary(b"solid \0\0"),
    "binary with colours": binary(b"COLOR=\xff\x00\x00\xff,MATERIAL="),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_however_it_is_written_the_box_is_a_box(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    path = tmp_path / "box.stl"
    path.write_bytes(WRITTEN[name])
    check_complete(path)
    assert area_mm2(path) == pytest.approx(BOX_AREA_MM2, rel=1e-7)
    assert volume_mm3(path) == pytest.approx(BOX_VOLUME_MM3, rel=1e-7)
    assert read_mesh_file(path, "mm").findings["vertices"] == 8


@pytest.mark.parametrize(
    ("content", "words", "error"),
    [
        (BOX.replace("300.0", "300,0").encode(), "a decimal comma", UnreadableFileError),
        (BOX.encode("utf-16"), "UTF-16", UnreadableFileError),
        (BOX.replace("vertex 0.0", "vertex", 1).encode(), "more or fewer than three numbers", UnreadableFileError),
        (BOX.replace("    endloop\n", "").encode(), "outside its facets", UnreadableFileError),
        (b"solid nothing\nendsolid nothing\n", "no faces", UnreadableFileError),
        (BOX.encode()[:-30], "cut short", IncompleteExportError),
        (binary()[:-1], "cut short", IncompleteExportError),
        (binary() + b"\0", "does not agree", UnreadableFileError),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, content: bytes, words: str, error: type[DeviceError]) -> None:
    path = tmp_path / "box.stl"
    path.write_bytes(content)
    with pytest.raises(error, match=words) as caught:
        read_mesh_file(path, "mm")
    assert caught.value.where == str(path)
    assert caught.value.remedy


VERTICES = "\n".join("{} {} {}".format(*point) for point in BOX_MM)
FACES = "\n".join(" ".join(map(str, [4, *face])) for face in BOX_FACES)
OFF: dict[str, str] = {
    "plain": f"OFF\n8 6 12\n{VERTICES}\n{FACES}\n",
    "counts in the first line": f"OFF 8 6 0\n{VERTICES}\n{FACES}",
    "remarks and empty lines": f"OFF # of a program\n# another\n\n8 6 0\n\n{VERTICES}\n# faces\n{FACES}\n",
    "colours of faces": f"OFF\n8 6 0\n{VERTICES}\n" + FACES.replace("\n", " 255 0 0\n"),
    "colours of vertices": "COFF\n8 6 0\n" + VERTICES.replace("\n", " 0 255 0 255\n") + f" 0 0 0 0\n{FACES}\n",
    "CRLF and tabs": f"OFF\n8 6 0\n{VERTICES}\n{FACES}\n".replace("\n", "\r\n").replace(" ", "\t"),
}


@pytest.mark.parametrize("name", OFF)
def test_an_off_is_made_of_polygons(tmp_path: Path, name: str) -> None:
    path = tmp_path / "box.off"
    path.write_bytes(OFF[name].encode())
    surface = read_surface_file(path, "mm")
    corners = 1e3 * surface.vertices_m[surface.faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(crosses, axis=1).sum() / 2 == pytest.approx(BOX_AREA_MM2)
    assert np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6 == pytest.approx(
        BOX_VOLUME_MM3
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (OFF["plain"][:-20], "shorter than it announces|fewer corners"),
        (OFF["plain"].replace("OFF", "FFO"), "does not begin with OFF"),
        (OFF["plain"].replace("OFF", "OFF BINARY"), "binary OFF"),
        (OFF["plain"].replace("8 6 12", "8"), "parsed as a OFF"),
        ("OFF\n", "parsed as a OFF"),
        (OFF["plain"].replace("300.0", "300,0"), "decimal comma"),
        (OFF["plain"].replace("\n4 0", "\n4 9"), "vertex 9 of 8"),
    ],
)
def test_a_wrong_off_is_refused_by_name(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "box.off"
    path.write_text(content)
    with pytest.raises(UnreadableFileError, match=words) as caught:
        read_surface_file(path, "mm")
    assert caught.value.where == str(path)


def test_a_file_of_another_kind_than_its_name_says_is_refused_with_the_right_name(tmp_path: Path) -> None:
    """People rename files, and programs add the extension that was typed."""
    contents = {
        ".stl": BOX.encode(),
        ".off": OFF["plain"].encode(),
        ".ply": b"ply\nformat ascii 1.0\nelement vertex 0\nelement face 0\nend_header\n",
        ".obj": b"# of a program\nmtllib a.mtl\no box\nv 0 0 0\nv 300 0 0\nv 0 300 0\nf 1 2 3\n",
        ".glb": b"glTF" + bytes(2000),
    }
    others = {
        "PK": b"PK\x03\x04" + bytes(100),
        "gzip": gzip.compress(BOX.encode()),
        "LFS": b"version https://git-lfs",
    }
    for suffix in contents:
        path = tmp_path / f"a{suffix}"
        for right, content in contents.items():
            if right != suffix:
                path.write_bytes(content)
                with pytest.raises(UnreadableFileError, match=f"a name that ends with {right}"):
                    read_surface_file(path, "mm")
        for content in others.values():
            path.write_bytes(content)
            with pytest.raises(UnreadableFileError, match="Unpack it, or export"):
                read_surface_file(path, "mm")


@pytest.mark.parametrize("wrong", [8, 60_000])
def test_a_glb_whose_face_refers_to_no_vertex_is_refused(tmp_path: Path, wrong: int) -> None:
    """It was an IndexError before."""
    exported = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="glb")
    assert isinstance(exported, bytes)
    content = bytearray(exported)
    length = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + length])
    (primitive,) = document["meshes"][0]["primitives"]
    accessor = document["accessors"][primitive["indices"]]
    start = 28 + length + document["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
    struct.pack_into({5123: "<H", 5125: "<I"}[accessor["componentType"]], content, start, wrong)
    path = tmp_path / "box.glb"
    path.write_bytes(content)
    with pytest.raises(UnreadableFileError, match=f"a face refers to vertex {wrong} of 8"):
        read_surface_file(path)
