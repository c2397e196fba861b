"""Scan profiles: exports in the layouts of the scanners' programs, made by the tests. PLY views come from plyfile,
which we do not read with; meshes come from trimesh and E57 files from pye57, which also read them."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pye57
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement
from pydantic import ValidationError
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from drivers.errors import DeviceError, DriverMissingError, IncompleteExportError, UnreadableFileError
from drivers.interfaces import ScannedMesh
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from drivers.scan_profiles import profile_named, profile_names
from service.computations.job import JobContext, RecordedContext
from service.compute.surfaces.mesh_spheres import locate_spheres, wrong_unit
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.store.store import Store
from service.worker.loop import HANDLERS
from simulators.scan_station.formats import encode

RADIUS_MM = 15.0
CENTRES_MM = np.array([[-120.0, -60, 560], [110, -70, 590], [10, 80, 540], [-20, -10, 610]])
MESHES = ("artec_leo", "artec_space_spider", "shining3d", "structured_light")


def seen_mm(columns: int, rows: int) -> Array:
    """Points (rows, columns, 3) that a sensor sees of spheres before a tilted board; NaN beyond the board's edge."""
    u, v = np.meshgrid(np.linspace(-0.36, 0.36, columns), np.linspace(-0.24, 0.24, rows))
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    normal = np.array([0.1, -0.05, -1.0])
    depth = -650 / (ray @ normal)
    depth[np.abs(ray[..., 0]) > 0.34] = np.nan
    for centre in CENTRES_MM:
        a, b = np.sum(ray**2, -1), ray @ centre
        root = b**2 - a * (centre @ centre - RADIUS_MM**2)
        hit = root > 0
        depth[hit] = (b[hit] - np.sqrt(root[hit])) / a[hit]
    return ray * depth[..., None]


def plyfile_points(path: Path, points: Array, *, colours: bool, normals: Array | None = None) -> None:
    fields: list[tuple[str, str]] = [(axis, "f4") for axis in "xyz"]
    columns: list[NDArray[Any]] = list(points.reshape(-1, 3).T)
    if normals is not None:
        fields += [(name, "f4") for name in ("nx", "ny", "nz")]
        columns += list(normals.reshape(-1, 3).T)
    if colours:
        fields += [(name, "u1") for name in ("red", "green", "blue", "alpha")]
        columns += [np.full(points.size // 3, 200)] * 4
    table = np.empty(points.size // 3, dtype=fields)
    for (name, _), column in zip(fields, columns, strict=True):
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(path))


def bodies(scale: float = 1.0) -> trimesh.Trimesh:
    parts = [trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_MM).apply_translation(c) for c in CENTRES_MM]
    return trimesh.util.concatenate(
        [*parts, trimesh.creation.box(bounds=[[-200, -200, 630], [200, 200, 650]])]
    ).apply_scale(scale)


def textured(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    image = Image.new("RGB", (8, 8), (180, 90, 70))
    uv = np.random.default_rng(1).random((len(mesh.vertices), 2))
    material = SimpleMaterial(image=image)
    mesh.visual = TextureVisuals(uv=uv, material=material)
    return mesh


def scanned(folder: Path, profile: str, unit: str = "auto") -> ScannedMesh:
    config = ScanFolderConfig.model_validate({"folder": folder, "profile": profile, "stable_s": 0, "unit": unit})
    scanner = ScanFolder(config)
    scanner.open()
    assert scanner.report().problems == ()
    (export,) = scanner.exports()
    return scanner.read(export)


def refused(folder: Path, profile: str, words: str, kind: type[DeviceError] = UnreadableFileError) -> None:
    with pytest.raises(kind, match=words) as caught:
        scanned(folder, profile)
    assert caught.value.remedy


def spheres_are_found(scan: ScannedMesh, tolerance_mm: float) -> None:
    found = locate_spheres(scan.mesh.vertices_m, scan.mesh.faces, RADIUS_MM / 1000, expected=len(CENTRES_MM))
    centres = np.array([sphere.centre_m for sphere in found]) * 1000
    distance = np.linalg.norm(centres[:, None] - CENTRES_MM, axis=2)
    assert sorted(distance.argmin(axis=1)) == list(range(len(CENTRES_MM)))
    assert distance.min(axis=1).max() < tolerance_mm


def test_every_profile_is_found_by_name_and_has_advice() -> None:
    assert set(profile_names()) >= {*MESHES, "zivid", "photoneo"}
    for name in profile_names():
        profile = profile_named(name)
        assert profile.scanner
        assert profile.software
        assert profile.advice[-1] != "."


def test_a_profile_that_is_not_installed_is_refused_with_those_that_are(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match=r"no scan profile 'artek'.*artec_leo"):
        ScanFolderConfig(folder=tmp_path, profile="artek")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ply", "obj"])
@pytest.mark.parametrize("profile", ["artec_leo", "artec_space_spider"])
def test_what_the_simulated_artec_studio_exports_is_read_with_its_texture(
    tmp_path: Path, profile: str, kind: str
) -> None:
    mesh = bodies()
    for name, data in encode(kind, f"scan 1.{kind}", np.array(mesh.vertices), np.array(mesh.faces), None, artec=True):
        (tmp_path / name).write_bytes(data)
    scan = scanned(tmp_path, profile)
    assert scan.findings["textures"] == 1
    assert len(scan.source.files) == (2 if kind == "ply" else 3)
    spheres_are_found(scan, 0.02)


@pytest.mark.parametrize("profile", MESHES)
@pytest.mark.parametrize("suffix", ["ply", "stl", "obj"])
def test_meshes_in_millimetres_are_read_with_their_spheres(tmp_path: Path, profile: str, suffix: str) -> None:
    bodies().export(tmp_path / f"scan.{suffix}")
    scan = scanned(tmp_path, profile)
    assert scan.unit == "mm"
    assert scan.findings["textures"] == 0
    spheres_are_found(scan, 0.02)


def test_a_textured_obj_keeps_material_and_texture(tmp_path: Path) -> None:
    textured(bodies()).export(tmp_path / "scan.obj")
    scan = scanned(tmp_path, "artec_leo")
    assert scan.findings["textures"] == 1
    assert {path.suffix for path in scan.source.files} == {".obj", ".mtl", ".png"}
    spheres_are_found(scan, 0.02)


@pytest.mark.parametrize("profile", MESHES)
def test_metres_are_refused_where_millimetres_are_exported(tmp_path: Path, profile: str) -> None:
    bodies(0.001).export(tmp_path / "scan.ply")
    refused(tmp_path, profile, "unit mm contradicts the size")


@pytest.mark.parametrize(("factor", "words"), [(25.4, "inches taken as mill"), (10.0, "centimetres taken as mill")])
def test_the_spheres_tell_a_wrong_unit_that_the_size_does_not(tmp_path: Path, factor: float, words: str) -> None:
    bodies(1 / factor).export(tmp_path / "scan.ply")
    scan = scanned(tmp_path, "shining3d", "mm")
    found = wrong_unit(scan.mesh.vertices_m, scan.mesh.faces, RADIUS_MM / 1000)
    assert found is not None
    assert (found.factor, found.spheres) == (factor, len(CENTRES_MM))
    assert words in found.words


def test_a_scene_of_the_right_size_has_no_wrong_unit(tmp_path: Path) -> None:
    bodies().export(tmp_path / "scan.ply")
    scan = scanned(tmp_path, "shining3d")
    assert wrong_unit(scan.mesh.vertices_m, scan.mesh.faces, 0.002) is None


def test_a_view_of_zivid_becomes_a_mesh(tmp_path: Path) -> None:
    plyfile_points(tmp_path / "view.ply", seen_mm(486, 300), colours=True)
    scan = scanned(tmp_path, "zivid")
    assert scan.unit == "mm"
    assert scan.findings["normals_computed"] == 1
    assert np.mean(scan.mesh.normals[:, 2] < 0) > 0.99  # towards the sensor
    spheres_are_found(scan, 0.1)


@pytest.mark.slow
def test_a_view_of_photoneo_keeps_its_normals_and_drops_its_zero_points(tmp_path: Path) -> None:
    points = seen_mm(1032, 772)
    normals = np.broadcast_to([0.0, 0.6, -0.8], points.shape)
    plyfile_points(tmp_path / "view.ply", np.nan_to_num(points), colours=False, normals=normals)
    scan = scanned(tmp_path, "photoneo")
    assert scan.findings["normals_computed"] == 0
    np.testing.assert_allclose(scan.mesh.normals, np.broadcast_to([0, 0.6, -0.8], scan.mesh.normals.shape), atol=1e-6)
    assert np.linalg.norm(scan.mesh.vertices_m, axis=1).min() > 0.5
    spheres_are_found(scan, 0.05)


def test_steps_in_depth_are_not_bridged(tmp_path: Path) -> None:
    plyfile_points(tmp_path / "view.ply", seen_mm(486, 300), colours=True)
    scan = scanned(tmp_path, "zivid")
    corners = scan.mesh.vertices_m[scan.mesh.faces]
    assert np.ptp(corners[..., 2], axis=1).max() < 0.012
    assert scan.findings["components"] == 1 + len(CENTRES_MM)


def test_points_without_the_order_of_pixels_are_refused(tmp_path: Path) -> None:
    points = seen_mm(486, 300)
    plyfile_points(tmp_path / "view.ply", points[np.isfinite(points).all(axis=-1)], colours=True)
    refused(tmp_path, "zivid", "not one for each pixel")


def test_a_view_behind_its_sensor_is_refused(tmp_path: Path) -> None:
    points = seen_mm(486, 300)
    points[..., 2] *= -1
    plyfile_points(tmp_path / "view.ply", points, colours=True)
    refused(tmp_path, "zivid", "axis negated")


def test_a_view_in_metres_is_refused(tmp_path: Path) -> None:
    plyfile_points(tmp_path / "view.ply", seen_mm(486, 300) / 1000, colours=True)
    refused(tmp_path, "zivid", "unit mm contradicts the size")


def test_a_view_without_neighbouring_points_has_no_surface(tmp_path: Path) -> None:
    points = seen_mm(486, 300)
    points[::2] = np.nan
    plyfile_points(tmp_path / "view.ply", points, colours=True)
    refused(tmp_path, "zivid", "no neighbouring pixels")


def e57(path: Path, *views: tuple[Array, Array], structured: bool = True) -> None:
    """Views (rows, columns, 3) in metres, each with its translation (3,) in the file's frame."""
    with pye57.E57(str(path), mode="w") as file:
        for points, translation in views:
            rows, columns, _ = points.shape
            row, column = np.mgrid[:rows, :columns]
            invalid = ~np.isfinite(points).all(axis=-1)
            x, y, z = np.nan_to_num(points).reshape(-1, 3).T
            data: dict[str, Any] = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
            if structured:
                data |= {"rowIndex": row.ravel(), "columnIndex": column.ravel()}
                data["cartesianInvalidState"] = invalid.ravel().astype(np.int8)
            file.write_scan_raw(data, translation=translation)


@pytest.mark.slow
def test_views_of_an_e57_file_are_put_at_their_poses(tmp_path: Path) -> None:
    points = seen_mm(486, 300) / 1000
    left, right = points.copy(), points.copy()
    left[:, 290:], right[:, :200] = np.nan, np.nan
    shift = np.array([0.1, 0.2, 0.3])
    e57(tmp_path / "scan.e57", (left, shift), (right, shift))
    scan = scanned(tmp_path, "structured_light")
    assert scan.unit == "m"
    moved = ScannedMesh(
        type(scan.mesh)(scan.mesh.vertices_m - shift, scan.mesh.faces, scan.mesh.normals),
        scan.unit,
        scan.unit_evidence,
        scan.findings,
        scan.source,
    )
    spheres_are_found(moved, 0.1)


def test_an_e57_of_points_only_is_refused(tmp_path: Path) -> None:
    e57(tmp_path / "scan.e57", (seen_mm(60, 40) / 1000, np.zeros(3)), structured=False)
    refused(tmp_path, "structured_light", "without rows and columns")


@pytest.mark.parametrize("fraction", [0.0, 0.001, 0.4, 0.98])
def test_a_half_written_e57_is_incomplete(tmp_path: Path, fraction: float) -> None:
    path = tmp_path / "scan.e57"
    e57(path, (seen_mm(60, 40) / 1000, np.zeros(3)))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, profile="structured_light", stable_s=0))
    assert scanner.exports() == ()
    assert re.search("cut short|empty", scanner.report().problems[0])


@pytest.mark.parametrize("place", [60, 0.3, 0.6, 0.99])
def test_a_damaged_e57_is_refused(tmp_path: Path, place: float) -> None:
    path = tmp_path / "scan.e57"
    e57(path, (seen_mm(60, 40) / 1000, np.zeros(3)))
    data = bytearray(path.read_bytes())
    at = int(place) if place > 1 else int(len(data) * place)
    data[at : at + 8] = bytes(byte ^ 0xFF for byte in data[at : at + 8])
    path.write_bytes(data)
    with pytest.raises((UnreadableFileError, IncompleteExportError)):
        scanned(tmp_path, "structured_light")


def test_without_its_package_an_e57_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    e57(tmp_path / "scan.e57", (seen_mm(60, 40) / 1000, np.zeros(3)))
    monkeypatch.setitem(sys.modules, "pye57", None)
    refused(tmp_path, "structured_light", "package pye57", DriverMissingError)


def test_the_report_says_what_the_profile_expects(tmp_path: Path) -> None:
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, profile="zivid", stable_s=0))
    report = scanner.report()
    assert "Zivid" in report.identity.model
    assert "ply in mm" in report.details["profile"]
    assert "ordered" in report.details["profile"]


def test_a_file_that_the_profile_does_not_read_is_told(tmp_path: Path) -> None:
    bodies().export(tmp_path / "scan.stl")
    (tmp_path / "notes.txt").write_text("no scan")
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, profile="zivid", stable_s=0))
    assert scanner.exports() == ()
    (problem,) = scanner.report().problems
    assert problem.startswith(
        "scan.stl: the profile zivid does not read this kind of file, only PLY. In Zivid Studio"
    )


@pytest.mark.parametrize("parts", [1, 2])
def test_the_search_for_spheres_says_that_the_unit_is_wrong(tmp_path: Path, parts: int) -> None:
    bodies(1 / 25.4).export(tmp_path / "scan.ply")
    mesh = scanned(tmp_path, "artec_leo", "mm").mesh
    buffer = io.BytesIO()
    np.savez(buffer, vertices_m=mesh.vertices_m, faces=mesh.faces)
    with Store.open(tmp_path / "data") as store:
        kept = store.put_bytes(buffer.getvalue(), kind="scan_mesh", media_type="application/x-npz", original_name="a")
        files: dict[str, Any] = {"mesh": kept.sha256} if parts == 1 else {"meshes": [kept.sha256] * parts}
        arguments = {**files, "radius_m": RADIUS_MM / 1000, "expected": len(CENTRES_MM)}
        context: RecordedContext = JobContext(arguments, store, tmp_path, lambda *_: None)
        with pytest.raises(ComputeError, match=r"inches taken as millimetres") as caught:
            HANDLERS["locate_spheres" if parts == 1 else "merge_scans"](context)
    assert "multiplied by 25.4 it has 4 spheres of 15 mm radius" in caught.value.what
    assert "rig.yaml" in caught.value.remedy
