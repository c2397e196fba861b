"""Simulated scanner and CT suite, read through the drivers: accuracy of spheres, frames, incomplete files, faults."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import IncompleteExportError
from drivers.interfaces import Array, CtVolume, ScannedMesh
from drivers.meshes.mesh_file import read_mesh_file
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from service.compute.surfaces.isosurface import surface
from service.core.geometry import apply, inverse
from simulators.ct_suite.suite import true_frames, write_series
from simulators.ct_suite.volume import Grid, voxelise
from simulators.faults import FaultPlan
from simulators.scene.world import Scene
from tests.support.rig.simulator_process import simulator

pytestmark = [pytest.mark.timeout(400)]
COMPUTED_S = 300.0  # longer than a scan takes to compute on a machine with much other work

SEED = 7
SCENE = Scene.generate(SEED)
RADIUS_M = 0.015


@dataclass(frozen=True)
class Fit:
    centre_m: Array
    radius_m: float
    rms_m: float
    points: int


def fit_sphere(points: Array, near: Array, band_m: float) -> Fit:
    """Algebraic least squares through the points within `band_m` of a sphere of RADIUS_M around `near`."""
    distance = np.linalg.norm(points - near, axis=1)
    p = points[np.abs(distance - RADIUS_M) < band_m]
    a = np.column_stack([2 * (p - near), np.ones(len(p))])
    x = np.linalg.lstsq(a, np.sum((p - near) ** 2, axis=1))[0]
    centre = near + x[:3]
    radius = float(np.sqrt(x[3] + x[:3] @ x[:3]))
    rms = float(np.sqrt(np.mean((np.linalg.norm(p - centre, axis=1) - radius) ** 2)))
    return Fit(centre, radius, rms, len(p))


@dataclass(frozen=True)
class Scanned:
    mesh: ScannedMesh
    T_world_scan: Array

    @property
    def world_m(self) -> Array:
        return apply(self.T_world_scan, self.mesh.mesh.vertices_m)

    def tissue_area_m2(self) -> float:
        p = self.world_m[self.mesh.mesh.faces]
        middle = p.mean(axis=1)
        inside = (np.abs(middle[:, 0]) < 0.15) & (np.abs(middle[:, 1]) < 0.08) & (middle[:, 2] > 0.005)
        return float(np.sum(np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)[inside]) / 2)


def scanned(folder: Path, *options: str) -> Scanned:
    with simulator("scanner", "--scene", str(SEED), "--folder", str(folder), "--once", *options) as running:
        truth = np.array(running.ready["truth"]["T_world_scan"])
        assert running.process.wait(COMPUTED_S) == 0
    return Scanned(read_mesh_file(folder / running.ready["export"]), truth)


@pytest.fixture(scope="module")
def sprayed(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    return scanned(tmp_path_factory.mktemp("sprayed"), "--spray")


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    """The sprayed scan with fewer vertices, for what does not depend on their number."""
    return scanned(tmp_path_factory.mktemp("coarse"), "--spray", "--spacing-mm", "1.6")


@pytest.fixture(scope="module")
def glossy(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    return scanned(tmp_path_factory.mktemp("glossy"), "--control-spheres", "--no-normals")


@pytest.mark.slow
@pytest.mark.sweep
def test_scanned_spheres_are_where_they_are(sprayed: Scanned, glossy: Scanned) -> None:
    for scan, centres in (
        (sprayed, SCENE.registration_m),
        (glossy, np.concatenate([SCENE.registration_m, SCENE.control_m])),
    ):
        for centre in centres:
            fit = fit_sphere(scan.world_m, centre, 0.3e-3)
            assert fit.points > 4000
            assert np.linalg.norm(fit.centre_m - centre) < 0.03e-3
            assert abs(fit.radius_m - RADIUS_M) < 0.01e-3
            assert 0.035e-3 < fit.rms_m < 0.08e-3


@pytest.mark.slow
@pytest.mark.sweep
def test_the_scan_is_in_a_frame_of_its_own_and_in_millimetres(sprayed: Scanned, glossy: Scanned) -> None:
    assert sprayed.mesh.unit == "mm"
    assert np.linalg.det(sprayed.T_world_scan[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm(sprayed.T_world_scan[:3, 3]) > 0.01
    assert (sprayed.mesh.findings["normals_computed"], glossy.mesh.findings["normals_computed"]) == (0.0, 1.0)
    assert 300_000 < sprayed.mesh.findings["faces"] < 1_200_000


def test_the_underside_and_what_lies_deep_are_missing(coarse: Scanned) -> None:
    world = coarse.world_m
    assert world[:, 2].min() > -0.0185
    assert np.count_nonzero((world[:, 2] < -0.010) & (np.abs(world[:, 0]) < 0.2) & (np.abs(world[:, 1]) < 0.14)) == 0
    assert coarse.mesh.findings["holes"] > 5


@pytest.mark.slow
@pytest.mark.sweep
def test_without_spray_more_is_missing(sprayed: Scanned, glossy: Scanned) -> None:
    assert glossy.mesh.findings["holes"] > 3 * sprayed.mesh.findings["holes"]
    assert glossy.tissue_area_m2() < 1.1 * sprayed.tissue_area_m2()


def test_normals_face_outwards(coarse: Scanned) -> None:
    normals = coarse.mesh.mesh.normals @ coarse.T_world_scan[:3, :3].T
    board = np.abs(coarse.world_m[:, 2]) < 0.0005
    assert np.median(normals[board, 2]) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("form", ["obj", pytest.param("stl", marks=pytest.mark.sweep)])
def test_other_formats_hold_the_same_scan(tmp_path: Path, form: str) -> None:
    scan = scanned(tmp_path, "--format", form, "--spacing-mm", "1.6", "--spray")
    fit = fit_sphere(scan.world_m, SCENE.registration_m[4], 0.3e-3)
    assert np.linalg.norm(fit.centre_m - SCENE.registration_m[4]) < 0.05e-3
    names = {path.name for path in scan.mesh.source.files}
    assert names == ({"scan_01.obj", "scan_01.MTL", "scan_01_0.PNG"} if form == "obj" else {"scan_01.stl"})


@pytest.mark.slow
def test_a_scan_appears_gradually_and_is_not_taken_before_it_is_whole(tmp_path: Path) -> None:
    scanner = ScanFolder(ScanFolderConfig(folder=tmp_path, unit="mm", stable_s=0.0))
    seen: list[str] = []
    done = threading.Event()

    def watch() -> None:
        while not done.is_set():
            seen.extend(scanner.report().problems)
            for export in scanner.exports():
                scanner.read(export)
                done.set()
            done.wait(0.01)

    plan = json.dumps([{"device": "scanner", "on": "export", "kind": "stall", "value": 2.0}])
    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        scanned(tmp_path, "--spacing-mm", "2", "--faults", plan)
    finally:
        watcher.join(COMPUTED_S)
        done.set()
    assert any("cut short" in text for text in seen)


def test_a_truncated_scan_is_recognised(tmp_path: Path) -> None:
    plan = json.dumps([{"device": "scanner", "on": "export", "kind": "truncate", "value": 0.7}])
    with pytest.raises(IncompleteExportError, match="cut short"):
        scanned(tmp_path, "--spacing-mm", "2", "--faults", plan)


# CT

VOXEL_MM = 1.25


@dataclass(frozen=True)
class Ct:
    volume: CtVolume
    T_world_ct: Array


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Ct:
    folder = tmp_path_factory.mktemp("ct")
    words = ("ct", "--scene", str(SEED), "--folder", str(folder), "--once", "--voxel-mm", str(VOXEL_MM))
    with simulator(*words, "--implicit-vr") as running:
        truth = np.array(running.ready["truth"]["T_world_ct"])
        assert running.process.wait(COMPUTED_S) == 0
    source = DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0))
    (series,) = source.series()
    assert series.problems == ()
    return Ct(source.read(series), truth)


@pytest.mark.slow
def test_the_products_of_one_acquisition_are_delivered_together(tmp_path: Path) -> None:
    words = ("ct", "--scene", str(SEED), "--folder", str(tmp_path), "--once", "--products", "--voxel-mm", "4")
    with simulator(*words) as running:
        assert running.process.wait(COMPUTED_S) == 0
    found = DicomFolder(DicomFolderConfig(folder=tmp_path, stable_s=0.0)).series()
    assert len(found) == 3
    assert not any(series.problems for series in found)
    assert len({series.frame_of_reference for series in found}) == 1


@pytest.mark.slow
def test_ct_spheres_are_where_they_are_to_a_tenth_of_a_voxel(ct: Ct) -> None:
    vertices, _ = surface(ct.volume.hounsfield, ct.volume.T_ct_voxel, -425)
    world = apply(ct.T_world_ct, vertices)
    for centre in np.concatenate([SCENE.registration_m, SCENE.control_m]):
        fit = fit_sphere(world, centre, 0.4e-3)
        assert np.linalg.norm(fit.centre_m - centre) < 0.1e-3
        assert abs(fit.radius_m - RADIUS_M) < 0.1e-3


@pytest.mark.slow
def test_ct_surface_lies_on_the_specimen(ct: Ct) -> None:
    vertices, _ = surface(ct.volume.hounsfield, ct.volume.T_ct_voxel, -475)
    world = apply(ct.T_world_ct, vertices)
    # The specimen's back away from wires and spheres: heights compared with the true grid.
    grid = SCENE.specimen.grid_m
    i, j = np.meshgrid(np.arange(40, 280, 7), [50, 60, 160, 170], indexing="ij")
    truth = grid[i, j].reshape(-1, 3)
    normal = np.cross(grid[i + 1, j] - grid[i - 1, j], grid[i, j + 1] - grid[i, j - 1]).reshape(-1, 3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    reach_m = 1.5e-3
    world = world[np.all((world > truth.min(axis=0) - reach_m) & (world < truth.max(axis=0) + reach_m), axis=1)]
    gaps = [
        float(np.median((world[near] - point) @ n))
        for near, point, n in zip(cKDTree(world).query_ball_point(truth, reach_m), truth, normal, strict=True)
        if near
    ]
    assert len(gaps) > 100
    assert abs(np.median(gaps)) < 0.05e-3


@pytest.mark.parametrize("corner_m", [(-0.1162, 0.001, 0.0832), (-0.1042, -0.0082, 0.0832)])
def test_ct_has_only_air_above_the_specimen_also_where_a_ray_meets_an_edge(
    corner_m: tuple[float, float, float],
) -> None:
    T = np.eye(4)
    T[:3, 3] = corner_m
    volume = voxelise(Scene.generate(296), Grid(T, 4e-4, (32, 15, 16)), control_spheres=False)
    assert volume.max() < -850  # such a ray filled half a voxel all the way up: -450


@pytest.mark.slow
def test_ct_materials_and_noise(ct: Ct) -> None:
    T_voxel_world = inverse_affine(ct.volume.T_ct_voxel) @ inverse(ct.T_world_ct)

    def around(point: Array) -> Array:
        i, j, k = np.rint(apply(T_voxel_world, point)).astype(int)
        return ct.volume.hounsfield[k - 2 : k + 3, j - 2 : j + 3, i - 2 : i + 3].astype(np.float64)

    plastic = around(SCENE.registration_m[1])
    assert plastic.mean() == pytest.approx(150, abs=5)
    assert 5 < plastic.std() < 20
    assert around(np.array([0.0, 0.0, 0.2]) * 0.6)[0, 0, 0] < -900
    assert around(np.array([0.0, 0.065, 0.02])).mean() == pytest.approx(50, abs=10)
    assert around(np.array([-0.2, -0.15, -0.009])).mean() == pytest.approx(-480, abs=10)


@pytest.mark.slow
def test_ct_frame_is_oblique(ct: Ct) -> None:
    assert (
        np.max(np.abs(ct.T_world_ct[:3, :3] @ ct.volume.T_ct_voxel[:3, :3] / (1e-3 * VOXEL_MM)), axis=1).min()
        < 0.9999
    )
    assert np.linalg.det(ct.T_world_ct[:3, :3]) == pytest.approx(1.0)


def inverse_affine(T: Array) -> Array:
    return np.linalg.inv(T).astype(np.float64)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"on": "slice", "nth": 20, "kind": "drop", "times": 2}, "gap: 2 slices"),
        ({"on": "slice", "nth": 20, "kind": "truncate"}, "cut short"),
        ({"on": "slice", "nth": 20, "kind": "duplicate"}, "duplicate"),
        ({"on": "slice", "nth": 20, "kind": "tilt"}, "mixed orientation"),
        ({"on": "series", "kind": "localiser"}, "localiser"),
    ],
)
def test_ct_faults_are_found(tmp_path: Path, fault: dict[str, object], words: str) -> None:
    plan = FaultPlan.parse(json.dumps([{"device": "ct", **fault}]))
    grid = Grid(np.eye(4), 4e-4, (40, 24, 16))
    volume = np.zeros(grid.shape, dtype=np.int16)
    write_series(tmp_path, volume, grid, true_frames(SEED)[0], "1.2.3", faults=plan)
    (series,) = DicomFolder(DicomFolderConfig(folder=tmp_path, stable_s=0.0)).series()
    assert words in " ".join(series.problems)


@pytest.mark.slow
def test_a_ct_fault_plan_reaches_the_simulator(tmp_path: Path) -> None:
    plan = json.dumps([{"device": "ct", "on": "slice", "nth": 20, "kind": "drop", "times": 2}])
    words = ("ct", "--scene", str(SEED), "--folder", str(tmp_path), "--once", "--voxel-mm", "4", "--faults", plan)
    with simulator(*words) as running:
        assert running.process.wait(COMPUTED_S) == 0
    (series,) = DicomFolder(DicomFolderConfig(folder=tmp_path, stable_s=0.0)).series()
    assert "gap: 2 slices" in " ".join(series.problems)
