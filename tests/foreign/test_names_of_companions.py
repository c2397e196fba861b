"""The materials and textures of a mesh, whatever encoding their names have in the files, or on the disk."""

from __future__ import annotations

import os
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.meshes.companions import companion_names, companions
from drivers.meshes.mesh_file import read_mesh_file
from service.core.records.run_events import FilesKept
from service.dataset.run_data_set import scan_files
from service.dataset.summary import summarise
from tests.support.ct.fused_scene import CENTRES_M, scan_mesh, with_spheres
from tests.support.runs.bench_run import bench_store
from tests.support.runs.computing_run import TEXTURED, OneScanner, begin_computing_run

TRIANGLE = b"v 0 0 0\nv 300 0 0\nv 0 200 0\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("name", "encoding"),
    [
        ("Rücken.mtl", "utf-8"),
        ("Rücken.mtl", "latin-1"),
        ("Rücken.mtl", "cp850"),
        ("Rücken.mtl", "mac_roman"),
        ("Größe “1” – €.mtl", "cp1252"),
        ("背骨.mtl", "cp932"),
        ("ソ表.mtl", "cp932"),  # second bytes that are backslashes
        ("脊柱.mtl", "gb18030"),
        ("척추.mtl", "cp949"),
        ("позвоночник.mtl", "cp1251"),
        ("kręgosłup.mtl", "cp1250"),
    ],
)
@pytest.mark.parametrize("on_disk", ["NFC", "NFD", "capitals", "as in the file"])
def test_a_material_is_found_by_its_name_in_any_encoding(
    tmp_path: Path, name: str, encoding: str, on_disk: str
) -> None:
    raw = name.encode(encoding)
    there = {
        "NFC": name,
        "NFD": unicodedata.normalize("NFD", name),
        "capitals": name.upper(),
        "as in the file": os.fsdecode(raw),  # an archive of another system, unpacked here
    }[on_disk]
    (tmp_path / there).write_bytes(b"newmtl skin\n")
    (tmp_path / "other.mtl").write_bytes(b"newmtl skin\n")
    (tmp_path / "a.obj").write_bytes(b"mtllib " + raw + b"\n" + TRIANGLE)
    assert companions(tmp_path / "a.obj") == (tmp_path / there,)
    assert read_mesh_file(tmp_path / "a.obj", "mm").findings["faces"] == 1


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "cp932"])
def test_a_texture_is_found_so_too_in_a_subfolder(tmp_path: Path, encoding: str) -> None:
    name = "ソ骨.png" if encoding == "cp932" else "Häute.png"
    (tmp_path / "Tex").mkdir()
    (tmp_path / "Tex" / name).write_bytes(b"")
    (tmp_path / "a.mtl").write_bytes(b"newmtl a\r\n\tmap_Kd -s 1 1 1 tex\\" + name.encode(encoding) + b"\r\n")
    (tmp_path / "a.obj").write_bytes(b"\tmtllib\ta.mtl\r\n" + TRIANGLE)
    assert companions(tmp_path / "a.obj") == (tmp_path / "a.mtl", tmp_path / "Tex" / name)
    assert f"tex/{name}" in companion_names((tmp_path / "a.mtl").read_bytes())


def test_one_statement_may_name_several_materials_and_one_name_may_have_blanks(tmp_path: Path) -> None:
    for name in ("a.mtl", "b.mtl", "a b.mtl"):
        (tmp_path / name).write_bytes(b"newmtl a\n")
    (tmp_path / "two.obj").write_bytes(b"mtllib a.mtl b.mtl\n" + TRIANGLE)
    (tmp_path / "blank.obj").write_bytes(b"mtllib a b.mtl\n" + TRIANGLE)
    assert companions(tmp_path / "two.obj") == (tmp_path / "a.mtl", tmp_path / "b.mtl")
    assert companions(tmp_path / "blank.obj") == (tmp_path / "a b.mtl",)


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("fehlt für immer.mtl".encode("latin-1"), IncompleteExportError, "'fehlt für immer.mtl' is missing"),
        (b"..\\a.mtl", UnreadableFileError, "outside the export's folder"),
        (b"C:\\scans\\R\xfccken.mtl", UnreadableFileError, "outside the export's folder"),
        (b"/scans/R\xfccken.mtl", UnreadableFileError, "outside the export's folder"),
    ],
)
def test_what_is_not_there_is_named(tmp_path: Path, name: bytes, error: type[Exception], words: str) -> None:
    (tmp_path / "a.obj").write_bytes(b"mtllib " + name + b"\n" + TRIANGLE)
    with pytest.raises(error, match=words):
        companions(tmp_path / "a.obj")


def ply_of_scene(texture: bytes) -> bytes:
    """The scene with five spheres, as MeshLab writes them with a texture: wedges at the faces."""
    scene = with_spheres(scan_mesh(), CENTRES_M)
    head = b"ply\nformat binary_little_endian 1.0\ncomment VCGLIB generated\ncomment TextureFile " + texture
    head += f"\nelement vertex {len(scene.vertices_m)}\n".encode()
    head += b"property float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(scene.faces)}\nproperty list uchar int vertex_indices\n".encode()
    head += b"property list uchar float texcoord\nend_header\n"
    kind = np.dtype([("n", "u1"), ("index", "<i4", 3), ("m", "u1"), ("uv", "<f4", 6)])
    rows = np.zeros(len(scene.faces), dtype=kind)
    rows["n"], rows["index"], rows["m"], rows["uv"] = 3, scene.faces, 6, np.random.default_rng(0).uniform(size=6)
    return head + (1e3 * scene.vertices_m).astype("<f4").tobytes() + rows.tobytes()


@pytest.mark.parametrize("as_on_disk", [False, True])
def test_a_ply_and_its_texture_go_through_a_run_together(tmp_path: Path, as_on_disk: bool) -> None:
    """The texture's name is Latin-1 in the file; on the disk it is UTF-8, or Latin-1, as is the mesh's own."""
    raw = "Häute.png".encode("latin-1")
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / (os.fsdecode(raw) if as_on_disk else "Häute.png")).write_bytes(b"a picture")
    mesh = os.fsdecode("Rücken.ply".encode("latin-1")) if as_on_disk else "Rücken.ply"
    (tmp_path / "scans" / mesh).write_bytes(ply_of_scene(raw))
    rig = OneScanner()
    rig.folder = tmp_path / "scans"
    with bench_store(tmp_path / "data") as store:
        bench = begin_computing_run(store, TEXTURED, tmp_path, rig)
        state = bench.run()
        assert state.status == "completed", bench.operator.told
        assert state.steps["scan"].measures["scan_textures"] == 1
        assert state.steps["scan"].measures["scan_normals_computed"] == 1
        files = scan_files(summarise(store, bench.run_id, bench.protocol))
        assert {file.name for file in files} == {"Rücken.ply", "Häute.png"}
        assert any("Rücken.ply" in kept.note for kept in bench.payloads(FilesKept))
        bench.must_verify()
