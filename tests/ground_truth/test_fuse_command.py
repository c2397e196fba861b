"""`orthocapture fuse`: a CT and a scan of one scene with spheres, in files and frames of their own."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from typer.testing import CliRunner, Result

from service.cli.common import shipped_protocols
from service.cli.fuse import TRANSPORT_GATE
from service.cli.main import app
from service.core.geometry import Array, apply, inverse
from tests.support.ct.fused_scene import (
    BIAS_M,
    CENTRES_M,
    HALF_M,
    RADIUS_M,
    T_WORLD_CT,
    ct_mesh,
    height,
    scan_mesh,
    with_spheres,
)


def run(tmp_path: Path, ct_centres_m: Array, *more: object) -> Result:
    ct, scan = with_spheres(ct_mesh(), ct_centres_m), with_spheres(scan_mesh(), CENTRES_M)
    ct = ct.moved(inverse(T_WORLD_CT))
    trimesh.Trimesh(1e3 * ct.vertices_m, ct.faces, process=False).export(tmp_path / "ct.ply")
    trimesh.Trimesh(scan.vertices_m, scan.faces, process=False).export(tmp_path / "scan.ply")
    files = ("--ct", tmp_path / "ct.ply", "--scan", tmp_path / "scan.ply", "--out", tmp_path / "truth.ply")
    words = ["fuse", *map(str, files), "--radius-mm", "6", "--spacing-mm", "0.5", *map(str, more)]
    return CliRunner().invoke(app, words, catch_exceptions=False)


@pytest.mark.slow
def test_the_command_fuses_measures_and_cuts_out_the_spheres(tmp_path: Path) -> None:
    done = run(tmp_path, CENTRES_M, "--cut-posts-mm", "2", "--heat-map", tmp_path / "heat.ply",
               "--picture", tmp_path / "both.png", "--json")  # fmt: skip
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert np.array(record["T_scan_ct"]) == pytest.approx(T_WORLD_CT, abs=2e-5)
    assert record["distance_change_mm"] < 0.02
    assert record["spheres"] == 5
    assert record["ct_above_scan_mm"] == pytest.approx(1e3 * BIAS_M, abs=0.02)
    assert record["chamfer_floor_mm"] < record["chamfer_ct_scan_mm"]
    truth = trimesh.load_mesh(tmp_path / "truth.ply", process=False)
    p = np.asarray(truth.vertices, dtype=np.float64)
    assert np.min(np.linalg.norm(p[:, None] - CENTRES_M[None], axis=2)) > RADIUS_M
    told = truth.metadata["_ply_raw"]["vertex"]["data"]
    assert set(np.unique(told["source"])) == {0, 1, 2}
    assert np.all(np.asarray(told["sigma_mm"]) > 0)
    top = (p[:, 2] > 0.01) & np.all(np.abs(p[:, :2]) < np.array(HALF_M) - 0.006, axis=1)
    flat = top & (np.hypot(p[:, 0], p[:, 1]) > 0.018)
    assert np.sqrt(np.mean((p[flat, 2] - height(p[flat, 0], p[flat, 1])) ** 2)) < 4e-5
    heat = trimesh.load_mesh(tmp_path / "heat.ply", process=False)
    picture = cv2.imread(str(tmp_path / "both.png"))
    assert picture is not None
    assert picture.shape[1] > 2 * picture.shape[0]  # three views side by side
    assert picture.std() > 10
    spread = np.linalg.norm(apply(T_WORLD_CT, np.zeros((1, 3))))
    assert np.all(np.linalg.norm(np.asarray(heat.vertices), axis=1) < spread + 0.2)


@pytest.mark.slow
def test_a_sphere_that_moved_in_transport_fails_the_gate_by_name_of_its_distance(tmp_path: Path) -> None:
    moved = CENTRES_M.copy()
    moved[0] += [0.0008, 0.0, 0.0]
    done = run(tmp_path, moved)
    assert done.exit_code == 1
    words = " ".join(done.output.split())
    assert "limit 0.3 mm" in words
    assert "1 moved" in words
    assert (tmp_path / "truth.ply").is_file()


@pytest.mark.slow
def test_a_sphere_that_the_scan_lacks_is_cut_out_of_the_ct(tmp_path: Path) -> None:
    taken_m = np.array([0.018, 0.012, 0.0360])  # on the specimen, as a control sphere
    done = run(tmp_path, np.vstack([CENTRES_M, taken_m]), "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert (record["spheres"], record["taken_away"]) == (5, 1)
    p = np.asarray(trimesh.load_mesh(tmp_path / "truth.ply", process=False).vertices, dtype=np.float64)
    above = p[np.linalg.norm(p - taken_m, axis=1) < RADIUS_M + 0.0008]
    assert len(above) > 20  # the scan's surface, which the sphere nearly touched
    assert above[:, 2] == pytest.approx(height(above[:, 0], above[:, 1]), abs=1e-4)


def test_its_limit_is_the_gate_of_the_shipped_protocols() -> None:
    steps = [
        step for file in shipped_protocols().glob("*.yaml") for step in yaml.safe_load(file.read_text())["steps"]
    ]
    gates = [gate for step in steps for gate in step.get("gates", ()) if gate["measure"] == TRANSPORT_GATE.measure]
    assert len(gates) >= 3
    assert {(gate["max"], gate["unit"], gate["why"]) for gate in gates} == {
        (TRANSPORT_GATE.max, TRANSPORT_GATE.unit, TRANSPORT_GATE.why)
    }


def test_a_wrong_radius_is_told(tmp_path: Path) -> None:
    done = run(tmp_path, CENTRES_M, "--radius-mm", "9", "--json")
    assert done.exit_code == 1
    assert "radius 9.00 mm" in json.loads(done.stdout)["error"]["what"]
