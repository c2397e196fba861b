"""The scanner's folder: formats, units, defects, and every way in which an export can be wrong."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from trimesh.exchange.ply import export_ply

from drivers.errors import DeviceError, DeviceUnavailableError, IncompleteExportError, UnreadableFileError
from drivers.interfaces import ScannedMesh
from drivers.meshes.mesh_file import merge_equal, read_mesh_file
from drivers.scan_folder import DRIVER, ScanFolder, ScanFolderConfig
from tests.support.record.counting import calls_of

SPHERE = trimesh.creation.icosphere(subdivisions=3, radius=150.0)


def write(folder: Path, name: str, mesh: trimesh.Trimesh = SPHERE, *, ascii_stl: bool = False) -> Path:
    path = folder / name
    mesh.export(path, file_type="stl_ascii" if ascii_stl else path.suffix[1:].lower())
    return path


def refused(path: Path, kind: type[DeviceError], words: str, unit: str = "auto") -> None:
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(kind, match=words) as caught:
        read_mesh_file(path, unit)  # pyright: ignore[reportArgumentType] - wrong units are tried too
    assert path.name in caught.value.where
    assert caught.value.remedy
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before


@pytest.mark.parametrize("name", ["scan.ply", "scan.stl", "scan.obj", "SCAN.PLY"])
def test_reads_each_format_in_metres(tmp_path: Path, name: str) -> None:
    scan = read_mesh_file(write(tmp_path, name))
    assert scan.unit == "mm"
    assert "519.6" in scan.unit_evidence
    assert scan.mesh.faces.dtype == np.int32
    np.testing.assert_allclose(np.linalg.norm(scan.mesh.vertices_m, axis=1), 0.150, atol=1e-7)
    assert np.all(np.sum(scan.mesh.normals * scan.mesh.vertices_m, axis=1) > 0.149)
    assert scan.findings["holes"] == scan.findings["non_manifold_edges"] == scan.findings["degenerate_faces"] == 0
    assert scan.findings["components"] == 1
    assert scan.findings["vertices"] == len(SPHERE.vertices)


def test_ascii_stl_and_ascii_ply(tmp_path: Path) -> None:
    text = write(tmp_path, "a.stl", ascii_stl=True)
    assert read_mesh_file(text).findings["faces"] == len(SPHERE.faces)
    ply = tmp_path / "a.ply"
    ply.write_bytes(export_ply(SPHERE, encoding="ascii"))
    assert read_mesh_file(ply).findings["faces"] == len(SPHERE.faces)


def test_normals_of_the_file_are_kept_and_missing_ones_computed(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(export_ply(SPHERE, vertex_normal=True))
    assert read_mesh_file(path).findings["normals_computed"] == 0
    path.write_bytes(export_ply(SPHERE, vertex_normal=False))
    assert read_mesh_file(path).findings["normals_computed"] == 1


def test_findings_name_holes_components_and_bad_edges(tmp_path: Path) -> None:
    vertices = np.array(SPHERE.vertices)
    faces = np.array(SPHERE.faces)
    open_sphere = faces[~np.any((faces == 0) | (faces == 100), axis=1)]  # remove two vertices and their faces
    island = open_sphere + len(vertices)
    # A third face on an edge that already has two, and a degenerate face.
    extra = np.array([[*open_sphere[0, :2], island[0, 0]], [5, 5, 6]])
    mesh = trimesh.Trimesh(
        np.concatenate([vertices, vertices + 400.0]), np.concatenate([open_sphere, extra, island]), process=False
    )
    findings = read_mesh_file(write(tmp_path, "a.ply", mesh)).findings
    assert findings["non_manifold_edges"] == 1
    assert findings["degenerate_faces"] == 1
    assert findings["components"] == 1  # the extra face connects them
    assert findings["unreferenced_vertices"] == 4
    mesh = trimesh.Trimesh(mesh.vertices, np.concatenate([open_sphere, island]), process=False)
    findings = read_mesh_file(write(tmp_path, "b.ply", mesh)).findings
    assert (findings["components"], findings["holes"]) == (2, 4)


def test_uv_seams_do_not_split_a_textured_mesh(tmp_path: Path) -> None:
    path = tmp_path / "patch.obj"
    corners = "v 0 0 0\nv 100 0 0\nv 100 100 0\nv 0 100 0\nv 0 0 0\nv 100 100 0\n"
    uv = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0.2 0.1\nvt 0.3 0.9\nvt 0 1\n"
    path.write_text(corners + uv + "f 1/1 2/2 3/3\nf 5/4 6/5 4/6\n")
    findings = read_mesh_file(path).findings
    assert (findings["components"], findings["holes"], findings["vertices"]) == (1, 1, 4)


def test_quads_and_groups_are_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("o one\nv 0 0 0\nv 90 0 0\nv 90 90 0\nv 0 90 0\nf 1 2 3 4\no two\nv 0 0 60\nusemtl b\nf 1 2 5\n")
    assert read_mesh_file(path).findings["faces"] == 3


@pytest.mark.parametrize("name", ["scan.ply", "scan.stl", "scan.obj"])
@pytest.mark.parametrize("fraction", [0.0, 0.001, 0.3, 0.97])
def test_half_written_files_are_incomplete(tmp_path: Path, name: str, fraction: float) -> None:
    path = write(tmp_path, name)
    data = path.read_bytes()
    cut = data[: int(len(data) * fraction)]
    if name.endswith("obj"):
        cut = cut.rstrip(b"\n")
    path.write_bytes(cut)
    refused(path, IncompleteExportError, "cut short|empty|middle of a line")


def test_half_written_text_files_are_incomplete(tmp_path: Path) -> None:
    stl = write(tmp_path, "a.stl", ascii_stl=True)
    stl.write_bytes(stl.read_bytes()[:-200])
    refused(stl, IncompleteExportError, "endsolid")
    ply = tmp_path / "a.ply"
    ply.write_bytes(export_ply(SPHERE, encoding="ascii").rstrip()[:-300])
    refused(ply, IncompleteExportError, "cut short")
    obj = tmp_path / "a.obj"
    obj.write_text("# 4 vertices\n# 2 faces\nv 0 0 0\nv 100 0 0\nv 0 100 0\nv 0 0 100\nf 1 2 3\n")
    refused(obj, IncompleteExportError, "1 faces of 2")


def test_meshes_without_faces_are_refused(tmp_path: Path) -> None:
    cloud = tmp_path / "points.ply"
    trimesh.PointCloud(SPHERE.vertices).export(cloud)
    refused(cloud, UnreadableFileError, "no faces")
    strips = tmp_path / "strips.ply"
    head = b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    strips.write_bytes(head + b"0 0 0\n100 0 0\n0 100 0\n100 100 0\n4 0 1 2 3\n")
    refused(strips, UnreadableFileError, "strips")
    obj = tmp_path / "points.obj"
    obj.write_text("v 0 0 0\nv 100 0 0\nv 0 100 0\n")
    refused(obj, UnreadableFileError, "no faces")
    stl = tmp_path / "none.stl"
    stl.write_bytes(b"\0" * 84)
    refused(stl, UnreadableFileError, "no faces")


def test_damaged_content_is_refused(tmp_path: Path) -> None:
    vertices = np.array(SPHERE.vertices)
    vertices[7] = np.nan
    bad = write(tmp_path, "nan.ply", trimesh.Trimesh(vertices, SPHERE.faces, process=False))
    refused(bad, UnreadableFileError, "not numbers, first vertex 7")
    obj = tmp_path / "index.obj"
    obj.write_text("v 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 9\n")
    refused(obj, UnreadableFileError, ".")
    fake = tmp_path / "fake.ply"
    fake.write_bytes(b"\x89PNG not a mesh at all")
    refused(fake, UnreadableFileError, "does not begin")
    other = tmp_path / "scan.wrl"
    other.write_text("#VRML")
    refused(other, UnreadableFileError, "not supported")
    with pytest.raises(UnreadableFileError, match="no such file"):
        read_mesh_file(tmp_path / "missing.ply")


def test_units_are_inferred_or_refused_but_never_scaled_silently(tmp_path: Path) -> None:
    metres = write(tmp_path, "m.ply", trimesh.creation.icosphere(subdivisions=2, radius=0.15))
    scan = read_mesh_file(metres)
    assert (scan.unit, float(np.ptp(scan.mesh.vertices_m[:, 0]))) == ("m", pytest.approx(0.3, rel=0.01))
    refused(metres, UnreadableFileError, "contradicts", unit="mm")
    assert read_mesh_file(metres, "m").unit_evidence.startswith("configured")
    odd = write(tmp_path, "inch.ply", trimesh.creation.icosphere(subdivisions=2, radius=6.0))
    refused(odd, UnreadableFileError, "unit cannot be determined")
    with pytest.raises(ValidationError):
        ScanFolderConfig.model_validate({"folder": tmp_path, "unit": "inch"})


def test_companions_are_found_whatever_their_case(tmp_path: Path) -> None:
    obj = tmp_path / "scan.obj"
    obj.write_text("mtllib Scan.mtl\nv 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\n")
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, stable_s=0.0))
    assert "Scan.mtl' is missing" in scanner.report().problems[0]
    assert scanner.exports() == ()
    (tmp_path / "SCAN.MTL").write_text("newmtl a\nmap_Kd -s 1 1 1 textures\\Skin 0.PNG\n")
    assert "Skin 0.PNG' is missing" in scanner.report().problems[0]
    (tmp_path / "Textures").mkdir()
    (tmp_path / "Textures" / "skin 0.png").write_bytes(b"image")
    (export,) = scanner.exports()
    assert [path.name for path in export.files] == ["scan.obj", "SCAN.MTL", "skin 0.png"]
    assert scanner.read(export).findings["faces"] == 1


@pytest.mark.parametrize("name", ["../secret.mtl", "/etc/passwd", "C:\\x.mtl", "a/../../b.mtl"])
def test_companions_outside_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret.mtl").write_text("newmtl a\n")
    folder = tmp_path / "scans"
    folder.mkdir()
    obj = folder / "scan.obj"
    obj.write_text(f"mtllib {name}\nv 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\n")
    refused(obj, UnreadableFileError, "outside")


def test_a_companion_that_links_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.mtl").write_text("newmtl a\n")
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / "a.mtl").symlink_to(tmp_path / "secret.mtl")
    obj = folder / "scan.obj"
    obj.write_text("mtllib a.mtl\nv 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\n")
    refused(obj, UnreadableFileError, "link")


def test_an_export_counts_when_it_has_stopped_changing(tmp_path: Path) -> None:
    now_s = 0.0
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, stable_s=5.0), monotonic=lambda: now_s)
    assert scanner.open().kind == "scanner"
    data = write(tmp_path, "template.ply").read_bytes()
    (tmp_path / "template.ply").unlink()
    path = tmp_path / "scan.ply"
    path.write_bytes(data[: len(data) // 2])
    assert "cut short" in scanner.report().problems[0]
    path.write_bytes(data)
    assert scanner.exports() == ()
    assert (scanner.report().details["arriving"], scanner.report().problems) == ("1", ())
    now_s = 3.0
    path.write_bytes(data)  # written again: the waiting time restarts
    os.utime(path, (1.0, 1.0))
    scanner.exports()
    now_s = 7.9
    assert scanner.exports() == ()
    now_s = 8.1
    (export,) = scanner.exports()
    assert scanner.report().problems == ()
    assert scanner.read(export).source == export
    path.unlink()
    with pytest.raises(IncompleteExportError, match="gone"):
        scanner.read(export)
    assert scanner.exports() == ()


def test_an_obj_without_a_newline_at_its_end_counts_once_it_is_stable(tmp_path: Path) -> None:
    whole = write(tmp_path, "template.obj").read_bytes().rstrip()
    (tmp_path / "template.obj").unlink()
    now_s = 0.0
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, stable_s=5.0), monotonic=lambda: now_s)
    path = tmp_path / "scan.obj"
    path.write_bytes(whole)
    assert scanner.exports() == ()
    assert scanner.report().details["arriving"] == "1"
    now_s = 5.1
    (export,) = scanner.exports()
    assert scanner.read(export).findings["faces"] == len(SPHERE.faces)


@pytest.mark.parametrize(
    "end", ["f 1 2", "f 1//1 2//2 3/", "f 1//1 2//2 3//", "f 1//1 2//2 3", "f", "v 1.0 2.0", "vn 0"]
)
def test_an_obj_that_ends_within_a_line_is_incomplete(tmp_path: Path, end: str) -> None:
    path = tmp_path / "scan.obj"
    head = "v 0 0 0\nv 900 0 0\nv 0 900 0\nvn 0 0 1\nvn 0 0 1\nvn 0 0 1\nf 1//1 2//2 3//3\n"
    path.write_text(head + "f 3//3 2//2 1//1")
    assert read_mesh_file(path, "mm").findings["faces"] == 2
    path.write_text(head + end)
    refused(path, IncompleteExportError, "middle of a line", "mm")
    announced = tmp_path / "announced.obj"
    announced.write_text("# 3 faces\n" + head + "f 3//3 2//2 1//1")
    refused(announced, IncompleteExportError, "2 faces of 3", "mm")


def test_bad_exports_stay_pending_with_the_reason(tmp_path: Path) -> None:
    trimesh.PointCloud(SPHERE.vertices).export(tmp_path / "points.ply")
    (tmp_path / ".hidden.ply").write_bytes(b"ply")
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, stable_s=0.0))
    report = scanner.report()
    assert len(report.problems) == 1
    assert "no faces" in report.problems[0]
    assert report.free_bytes
    assert (tmp_path / "points.ply").exists()


def test_a_missing_folder_is_a_missing_device(tmp_path: Path) -> None:
    scanner = DRIVER.build(DRIVER.config.model_validate({"folder": tmp_path / "none"}))
    with pytest.raises(DeviceUnavailableError, match="no such folder"):
        scanner.open()
    scanner.close()


def test_merging_agrees_with_numpy() -> None:
    rng = np.random.default_rng(3)
    vertices = rng.integers(-3, 3, (4000, 3)).astype(np.float64)
    first, index = merge_equal(vertices)
    assert len(first) == len(np.unique(vertices, axis=0))
    np.testing.assert_array_equal(vertices[first[index]], vertices)
    assert np.all(np.diff(first) > 0)


@pytest.mark.slow
def test_a_million_faces_are_read_without_a_call_for_each(tmp_path: Path) -> None:
    path = write(tmp_path, "big.ply", trimesh.creation.icosphere(subdivisions=8, radius=150.0))
    meshes: list[ScannedMesh] = []
    assert calls_of(lambda: meshes.append(read_mesh_file(path))) < 10_000
    assert meshes[0].findings["faces"] == 1_310_720
