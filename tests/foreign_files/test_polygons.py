"""Polygons of foreign files: an outline is what the file says, at whichever corner it begins and whatever it is like.

The areas are derived by hand (a shoelace over the outline); MeshLab gives the same for those of the first test.
"""

from __future__ import annotations

import itertools
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import ScannedMesh
from drivers.meshes.mesh_file import read_mesh_file
from drivers.meshes.surface_file import read_surface_file
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from service.cli.main import app
from service.core.geometry import Array
from service.core.units import mm
from tests.support.scenes.mesh_figures import BOX_MM, L_AREA_MM2, L_MM, area_mm2, area_vector_mm2

Corners = list[int]


def as_obj(path: Path, points: Array, faces: list[Corners]) -> None:
    rows = ["v {} {} {}".format(*point) for point in points]
    rows += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces]
    path.with_suffix(".obj").write_text("\n".join(rows) + "\n")


def as_ascii_ply(path: Path, points: Array, faces: list[Corners]) -> None:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = ["{} {} {}".format(*point) for point in points]
    rows += [" ".join(map(str, [len(face), *face])) for face in faces]
    path.with_suffix(".ply").write_text(head + "\n".join(rows) + "\n")


def as_binary_ply(path: Path, points: Array, faces: list[Corners]) -> None:
    head = f"ply\nformat binary_big_endian 1.0\nelement vertex {len(points)}\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(faces)}\nproperty list ushort uint vertex_index\nend_header\n"
    rows = b"".join(struct.pack(f">H{len(face)}I", len(face), *face) for face in faces)
    path.with_suffix(".ply").write_bytes(head.encode() + points.astype(">f8").tobytes() + rows)


def as_off(path: Path, points: Array, faces: list[Corners]) -> None:
    rows = ["OFF", f"{len(points)} {len(faces)} 0", *("{} {} {}".format(*point) for point in points)]
    rows += [" ".join(map(str, [len(face), *face])) + " 255 0 0" for face in faces]
    path.with_suffix(".off").write_text("\n".join(rows))


Writer = Callable[[Path, Array, list[Corners]], None]
WRITERS: dict[str, tuple[Writer, str]] = {
    "obj": (as_obj, ".obj"), "ascii ply": (as_ascii_ply, ".ply"), "binary ply": (as_binary_ply, ".ply")
}  # fmt: skip


@pytest.mark.parametrize("form", WRITERS)
def test_a_concave_polygon_has_its_own_area_from_every_corner_and_in_either_winding(
    tmp_path: Path, form: str
) -> None:
    write, suffix = WRITERS[form]
    file = (tmp_path / "L").with_suffix(suffix)
    for start, step in itertools.product(range(6), (1, -1)):
        write(file, L_MM, [[(start + step * k) % 6 for k in range(6)]])
        assert area_mm2(file) == pytest.approx(L_AREA_MM2, rel=1e-6)
        assert area_vector_mm2(file) == pytest.approx([0, 0, step * L_AREA_MM2], rel=1e-6)


@pytest.mark.parametrize("writer", [as_obj, as_ascii_ply, as_off])
def test_what_is_compared_is_read_so_too(tmp_path: Path, writer: Writer) -> None:
    """`evaluate chamfer` and the benchmarks read any mesh; OFF is made of polygons."""
    file = tmp_path / f"L.{writer.__name__.split('_')[-1]}"
    writer(file, L_MM, [list(range(6))])
    surface = read_surface_file(file, "mm")
    corners = 1e3 * surface.vertices_m[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(L_AREA_MM2, rel=1e-6)


def of_scanner(file: Path) -> ScannedMesh:
    scanner = ScanFolder(ScanFolderConfig(folder=file.parent, stable_s=0, unit="mm"))
    (export,) = scanner.exports()
    return scanner.read(export)


def of_profile(file: Path) -> ScannedMesh:
    scanner = ScanFolder(ScanFolderConfig(folder=file.parent, stable_s=0, profile="structured_light"))
    (export,) = scanner.exports()
    return scanner.read(export)


def of_ct(file: Path) -> ScannedMesh:
    ct = DicomFolder(DicomFolderConfig(folder=file.parent, stable_s=0, mesh_unit="mm"))
    (export,) = ct.segmented_meshes()
    return ct.read_mesh(export)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("importer", [of_scanner, of_profile, of_ct])
def test_every_device_reads_it_so(tmp_path: Path, form: str, importer: Callable[[Path], ScannedMesh]) -> None:
    write, suffix = WRITERS[form]
    file = (tmp_path / "L").with_suffix(suffix)
    write(file, L_MM, [list(range(6))])
    mesh = importer(file).mesh
    corners = mm(mesh.vertices_m)[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(L_AREA_MM2, rel=1e-6)


def test_a_notch_is_no_longer_filled_for_a_chamfer_distance(tmp_path: Path) -> None:
    """From the first corner a fan covers the notch; from the fourth, which is the inner one, it does not."""
    for name, start in (("L", 0), ("from_inside", 3)):
        as_obj(tmp_path / name, L_MM, [[(start + k) % 6 for k in range(6)]])
    words = ["evaluate", "chamfer", str(tmp_path / "L.obj"), str(tmp_path / "from_inside.obj")]
    answer = CliRunner().invoke(app, [*words, "--spacing-mm", "5", "--json"])
    assert answer.exit_code == 0, answer.output
    score = json.loads(answer.stdout)
    assert score["pred_to_gt"]["to_surface_mean_mm"] == pytest.approx(0, abs=1e-9)
    assert score["n_pred"] == score["n_gt"]


SQUARE = [(0, 0), (400, 0), (400, 400), (0, 400)]
HOLE = [(100, 100), (100, 200), (200, 200), (200, 100)]
OUTLINES: dict[str, tuple[list[tuple[float, float]], float]] = {
    "dart": ([(0, 0), (200, 100), (0, 200), (50, 100)], 15_000),
    "corners on an edge": ([(0, 0), (100, 0), (200, 0), (300, 0), (300, 100), (150, 100), (0, 100)], 30_000),
    "a corner on the edge of a quadrangle": ([(0, 0), (100, 0), (200, 0), (100, 100)], 10_000),
    "a corner twice": ([(0, 0), (300, 0), (300, 0), (300, 100), (0, 100)], 30_000),
    "a corner twice in a quadrangle": ([(0, 0), (300, 0), (300, 0), (0, 100)], 15_000),
    # CAD programs join a hole to its outline by an edge that is passed in both directions.
    "a hole": ([*SQUARE, SQUARE[0], *HOLE, HOLE[0]], 150_000),
    "comb": ([(0, 0), (500, 0), (500, 200), (400, 50), (300, 200), (200, 50), (100, 200)], 60_000),
    "spiral": ([(0, 0), (300, 0), (300, 300), (0, 300), (0, 100), (200, 100), (200, 200), (100, 200), (100, 150),
                (150, 150), (150, 125), (50, 125), (50, 250), (250, 250), (250, 50), (0, 50)], 57_500),
}  # fmt: skip


def shoelace(outline: list[tuple[float, float]]) -> float:
    return abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(outline, outline[1:] + outline[:1], strict=True))) / 2


@pytest.mark.parametrize("name", OUTLINES)
def test_every_outline_keeps_its_area_turned_in_space_and_from_every_corner(tmp_path: Path, name: str) -> None:
    outline, area = OUTLINES[name]
    assert shoelace(outline) == area
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    points = np.column_stack([outline, np.zeros(len(outline))]) @ turn.T
    for start in range(len(outline)):
        as_obj(tmp_path / "a", points, [[(start + k) % len(outline) for k in range(len(outline))]])
        assert area_mm2(tmp_path / "a.obj") == pytest.approx(area, rel=1e-6)
        assert read_mesh_file(tmp_path / "a.obj", "mm").findings["polygons_in_doubt"] == 0


def test_a_polygon_that_is_not_flat_is_the_same_surface_from_every_corner(tmp_path: Path) -> None:
    bent = L_MM + np.array([[0, 0, 0], [0, 0, 20], [0, 0, 5], [0, 0, -15], [0, 0, 10], [0, 0, 0]])
    quadrangle = BOX_MM[[0, 1, 3, 2]] + np.array([[0, 0, 0], [0, 0, 40], [0, 0, 0], [0, 0, 0]])
    for points in (bent, quadrangle):
        areas: list[float] = []
        for start in range(len(points)):
            as_obj(tmp_path / "a", points, [[(start + k) % len(points) for k in range(len(points))]])
            areas.append(area_mm2(tmp_path / "a.obj"))
        assert np.ptp(areas) < 1e-6 * areas[0]


def test_triangles_quadrangles_and_polygons_stay_in_order(tmp_path: Path) -> None:
    points = np.concatenate([L_MM, BOX_MM + np.array([0, 0, 50])])
    as_binary_ply(tmp_path / "a", points, [[6, 8, 9], [0, 1, 2, 3, 4, 5], [6, 7, 11, 10], [6, 9, 7]])
    surface = read_surface_file(tmp_path / "a.ply", "mm")
    owner = [0, 1, 1, 1, 1, 2, 2, 3]
    assert [int(face.min()) >= 6 for face in surface.faces] == [polygon != 1 for polygon in owner]
    assert surface.faces[0].tolist() == [6, 8, 9]
    assert surface.faces[-1].tolist() == [6, 9, 7]


@pytest.mark.parametrize(
    "outline",
    [
        [(0, 0), (300, 300), (300, 0), (0, 300)],  # an eight
        [(0, 0), (300, 0), (0, 200), (300, 200), (150, -100)],  # crosses itself
        [(200 * np.cos(4 * np.pi * k / 5), 200 * np.sin(4 * np.pi * k / 5)) for k in range(5)],  # a star
        [(0, 0), (100, 0), (200, 0), (300, 0), (400, 0)],  # no area
        [(0, 0), (300, 300)],  # a line
    ],
)
def test_a_polygon_without_an_inside_is_cut_in_a_defined_way_and_said(
    tmp_path: Path, outline: list[tuple[float, float]]
) -> None:
    points = np.concatenate([np.column_stack([outline, np.zeros(len(outline))]), BOX_MM])
    n = len(outline)
    as_obj(tmp_path / "a", points, [list(range(n)), [n, n + 2, n + 3, n + 1]])
    scan = read_mesh_file(tmp_path / "a.obj", "mm")
    assert scan.findings["polygons_in_doubt"] == 1
    assert scan.findings["faces"] == n - 2 + 2
    words = ["evaluate", "chamfer", str(tmp_path / "a.obj"), str(tmp_path / "a.obj"), "--spacing-mm", "50"]
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 0, answer.output
    assert "a.obj: 1 of its polygons" in answer.stderr


def test_a_face_that_refers_to_no_vertex_is_refused_whatever_its_corners(tmp_path: Path) -> None:
    for face in ([0, 1, 9], [0, 1, 2, 9], [0, 1, 2, 3, 9]):
        as_obj(tmp_path / "a", L_MM, [face])
        with pytest.raises(UnreadableFileError, match="vertex 9 of 6"):
            read_mesh_file(tmp_path / "a.obj", "mm")
