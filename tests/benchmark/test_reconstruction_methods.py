"""The benchmark of reconstruction: exports, command lines, frames of meshes, and what is said without a program."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from service.benchmark.methods import Workplace, methods, missing
from service.benchmark.running import Trial, run_trial
from service.benchmark.table import figure_png, table_markdown, table_record
from service.computations.benchmark import BenchmarkResult, read_results
from service.compute.surfaces.chamfer import ChamferSettings
from service.core.errors import ComputeError, ConfigurationError, DataError, OrthocaptureError
from service.core.geometry import apply, inverse
from service.dataset.exporter import exporter, write_data_set
from service.dataset.formats.hdf5 import data_set_of_folder, scaled_data_set
from service.dataset.records import DataSet
from tests.support.processes import reconstruction_stand_in
from tests.support.scenes.posed import posed_data_set, scene

COARSE = ChamferSettings(spacing_m=1e-3)
PLACE = Workplace(Path("/d"), Path("/w"), Path("/c"), "python")
TRIANGULATED = "python -m service.benchmark.programs triangulate /d /w/dense"
COMMANDS = {
    "colmap": [
        TRIANGULATED,
        "colmap patch_match_stereo --workspace_path /w/dense --workspace_format COLMAP "
        "--PatchMatchStereo.geom_consistency true",
        "colmap stereo_fusion --workspace_path /w/dense --workspace_format COLMAP --input_type geometric "
        "--output_path /w/fused.ply",
        "colmap poisson_mesher --input_path /w/fused.ply --output_path /w/mesh.ply",
    ],
    "pycolmap": [
        TRIANGULATED,
        "python -m service.benchmark.programs patch_match /w/dense /w/fused.ply /w/mesh.ply",
    ],
    "openmvs": [
        TRIANGULATED,
        "InterfaceCOLMAP -w /w -i /w/dense -o scene.mvs --image-folder /w/dense/images",
        "DensifyPointCloud -w /w -i scene.mvs -o scene_dense.mvs",
        "ReconstructMesh -w /w -i scene_dense.mvs -o scene_mesh.ply",
        "RefineMesh -w /w -i scene_dense.mvs -m scene_mesh.ply -o scene_mesh_refined.ply",
    ],
    "instant-ngp": [
        "python /c/scripts/run.py --scene /d --n_steps 35000 --save_mesh /w/mesh.ply --marching_cubes_res 512 "
        "--marching_cubes_density_thresh 2.5"
    ],
    "neus2": [
        "python /c/scripts/run.py --scene /d/transform.json --name orthocapture --network dtu.json --n_steps 15000"
    ],
    "sugar": [
        "python /c/gaussian_splatting/train.py -s /d -m /w/gaussians --iterations 7000",
        "python /c/train.py -s /d -c /w/gaussians -i 7000 -r density -o /w/sugar --eval False",
    ],
    "stereo": ["python -m service.benchmark.programs stereo /d /w/mesh.ply"],
    "gsplat": ["python -m service.benchmark.programs gaussians /d /w/mesh.ply"],
}
STAND_INS = ("colmap", "openmvs", "instant-ngp", "neus2", "sugar")
PROGRAMS = ("colmap", "InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh")
CHECKOUTS = {"INSTANT_NGP": ("scripts/run.py",), "NEUS2": ("scripts/run.py",)} | {
    "SUGAR": ("gaussian_splatting/train.py", "train.py")
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export in the format hdf5."""
    place = tmp_path_factory.mktemp("exported")
    (place / "photographs").mkdir()
    write_data_set(posed_data_set(place / "photographs", 9), exporter("hdf5"), place / "dataset")
    return place / "dataset"


@pytest.fixture(scope="module")
def dataset(folder: Path) -> DataSet:
    return data_set_of_folder(folder)


@pytest.fixture
def stand_ins(tmp_path: Path, dataset: DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs that find the solid from the exported poses, in the place of those that are not installed."""
    corners = np.asarray(scene().mesh.vertices)
    rays = {view.name: apply(inverse(view.T_world_camera), corners) for view in dataset.views}
    known = {name: (p[:, :2] / p[:, 2:]).tolist() for name, p in rays.items()}
    (tmp_path / "known.json").write_text(json.dumps({"rays": known, "faces": scene().mesh.faces.tolist()}))
    source = f"#!{sys.executable}\n" + Path(reconstruction_stand_in.__file__).read_text(encoding="utf-8")
    places = [tmp_path / "bin" / program for program in PROGRAMS]
    for name, scripts in CHECKOUTS.items():
        places += [tmp_path / name / script for script in scripts]
        monkeypatch.setenv(f"ORTHOCAPTURE_{name}", str(tmp_path / name))
        monkeypatch.setenv(f"ORTHOCAPTURE_{name}_PYTHON", sys.executable)
    for place in places:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(source, encoding="utf-8")
        place.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=":")
    monkeypatch.setenv("STAND_IN", str(tmp_path / "known.json"))


def exact(result: BenchmarkResult) -> bool:
    """Whether the mesh is the truth: its distances are those of the sampling alone."""
    assert result.score is not None, result.failure
    return abs(result.score.chamfer_mm - result.score.floor_mm) < 0.01 and result.score.outside_percent < 0.01


def test_the_folder_holds_the_data_set_that_was_exported(folder: Path, dataset: DataSet, tmp_path: Path) -> None:
    original = posed_data_set(tmp_path, 9)
    assert dataset.splits == original.splits
    assert dataset.simulated
    for ours, theirs in zip(dataset.views, original.views, strict=True):
        assert (ours.name, ours.camera) == (theirs.name, theirs.camera)
        assert np.array_equal(ours.T_world_camera, theirs.T_world_camera)
        assert np.array_equal(dataset.pixels.colours(ours), original.pixels.colours(theirs))
        assert np.array_equal(dataset.pixels.depth_m(ours), original.pixels.depth_m(theirs))
        assert np.array_equal(dataset.pixels.markers(ours), original.pixels.markers(theirs))
    assert np.array_equal(dataset.mesh.vertices_m, original.mesh.vertices_m)


def test_a_changed_file_and_another_format_are_refused(folder: Path, dataset: DataSet, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    write_data_set(dataset, exporter("hdf5"), copy)
    with (copy / "splits.json").open("a") as file:
        file.write(" ")
    with pytest.raises(DataError, match=r"splits\.json was altered"):
        data_set_of_folder(copy)
    write_data_set(dataset, exporter("colmap"), tmp_path / "colmap")
    with pytest.raises(DataError, match="not a data set in the format hdf5"):
        data_set_of_folder(tmp_path / "colmap")


def test_smaller_images_show_the_same_place(dataset: DataSet) -> None:
    small = scaled_data_set(dataset, 80)
    for view, large in zip(small.views, dataset.views, strict=True):
        assert small.pixels.colours(view).shape == (60, 80, 3)
        assert small.pixels.depth_m(view).shape == (60, 80)
        corner = apply(inverse(view.T_world_camera), np.asarray(scene().mesh.vertices))
        expected = (large.camera.project(corner) + 0.5) / 2 - 0.5
        assert np.abs(view.camera.project(corner) - expected).max() < 1e-9
    with pytest.raises(DataError, match="160 px wide, less than 200 px"):
        scaled_data_set(dataset, 200)


@pytest.mark.parametrize("name", COMMANDS)
def test_command_lines(name: str) -> None:
    assert set(COMMANDS) == set(methods())
    assert [shlex.join(command) for command in methods()[name].commands(PLACE)] == COMMANDS[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.sweep) for name in STAND_INS])
@pytest.mark.usefixtures("stand_ins")
def test_a_method_is_run_and_its_mesh_comes_back_into_the_world(name: str, dataset: DataSet, tmp_path: Path) -> None:
    method = methods()[name]
    assert missing(method) == ""
    result = run_trial(Trial(method, "sparse", tmp_path / "out", settings=COARSE), dataset)
    assert exact(result), result
    assert result.views == 8
    assert result.effort is not None
    assert result.effort.wall_s > 0
    assert result.effort.peak_memory_mb > 10
    assert read_results(tmp_path / "out") == (result,)
    kept = trimesh.load_mesh(tmp_path / "out" / f"{name}-sparse" / "mesh.ply")
    assert np.abs(kept.bounds - scene().mesh.bounds).max() < 1e-6
    # It was made from the eight exported images alone.
    assert len(json.loads((tmp_path / "out" / f"{name}-sparse" / "data" / "splits.json").read_text())["dense"]) == 8


@pytest.mark.slow
@pytest.mark.parametrize("simulated", [True, pytest.param(False, marks=pytest.mark.sweep)])
@pytest.mark.usefixtures("stand_ins")
def test_meshes_and_pictures_of_a_simulated_data_set_say_so(
    dataset: DataSet, tmp_path: Path, simulated: bool
) -> None:
    known = dataclasses.replace(dataset, simulated=simulated)
    run_trial(Trial(methods()["instant-ngp"], "sparse", tmp_path, settings=COARSE), known)
    kept = [*tmp_path.glob("truth-*.ply"), *(tmp_path / "instant-ngp-sparse").glob("*.p[ln][yg]")]
    assert {path.name for path in kept} >= {"mesh.ply", "heat_map.png"}
    drawn = figure_png(tmp_path, read_results(tmp_path), methods())
    for data in (*(path.read_bytes() for path in kept), drawn):
        assert (b"SIMULATED: made by a simulated rig" in data) == simulated


@pytest.mark.slow
@pytest.mark.usefixtures("stand_ins")
def test_a_mesh_made_elsewhere_is_scored_and_another_frame_is_noticed(dataset: DataSet, tmp_path: Path) -> None:
    ngp, neus2 = methods()["instant-ngp"], methods()["neus2"]
    run_trial(Trial(ngp, "sparse", tmp_path / "out", settings=COARSE), dataset)
    made = tmp_path / "out" / "instant-ngp-sparse" / "work" / "mesh.ply"
    result = run_trial(Trial(ngp, "dense", tmp_path / "out", made, settings=COARSE), dataset)
    assert exact(result)
    assert result.elsewhere
    assert result.effort is None
    # The solid is not symmetric: read with another method's axes, it does not fit.
    try:
        wrong = run_trial(Trial(neus2, "dense", tmp_path / "out", made, settings=COARSE), dataset)
    except OrthocaptureError:
        return
    assert not exact(wrong)
    assert wrong.score is not None
    assert wrong.score.chamfer_mm > 3


def test_what_is_expected_is_said_and_the_data_are_there(dataset: DataSet, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        run_trial(Trial(methods()["neus2"], "sparse", tmp_path), dataset)
    assert caught.value.what == "NeuS2 cannot run here: ORTHOCAPTURE_NEUS2 is not set"
    assert "commit 61f9cbf" in caught.value.remedy
    data = tmp_path / "neus2-sparse" / "data"
    assert f"$ORTHOCAPTURE_NEUS2/scripts/run.py --scene {data}/transform.json" in caught.value.remedy
    assert len(list((data / "images").iterdir())) == 8
    assert read_results(tmp_path) == ()


@pytest.mark.usefixtures("stand_ins")
def test_a_method_that_makes_no_mesh_has_a_result_that_says_why(
    dataset: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN", str(tmp_path / "nothing.json"))
    result = run_trial(Trial(methods()["instant-ngp"], "sparse", tmp_path / "out"), dataset)
    assert result.score is None
    assert "ended with status 1" in result.failure
    assert "nothing.json" in result.failure
    text = table_markdown(read_results(tmp_path / "out"), methods())
    assert "| Instant-NGP | – | – |" in text
    assert "Instant-NGP, sparse: no mesh." in text


def test_a_mesh_outside_the_box_of_the_truth_is_refused(dataset: DataSet, tmp_path: Path) -> None:
    far = scene().mesh.copy().apply_translation([1.0, 0.0, 0.0])
    far.export(tmp_path / "far.ply")
    with pytest.raises(DataError, match="no face within the box"):
        run_trial(Trial(methods()["colmap"], "dense", tmp_path, tmp_path / "far.ply"), dataset)


@pytest.mark.slow
def test_what_the_method_sees_beyond_the_truth_is_cut_off(dataset: DataSet, tmp_path: Path) -> None:
    wall = trimesh.creation.box(extents=[0.4, 0.4, 0.001]).apply_translation([0.0, 0.0, -0.01])
    fine = trimesh.util.concatenate([scene().mesh.subdivide().subdivide(), wall])
    fine.export(tmp_path / "room.ply")
    trial = Trial(methods()["colmap"], "dense", tmp_path, tmp_path / "room.ply", settings=COARSE)
    result = run_trial(trial, dataset)
    assert result.score is not None, result.failure
    assert abs(result.score.chamfer_mm - result.score.floor_mm) < 0.01
    assert result.score.outside_percent > 50


@pytest.mark.slow
@pytest.mark.usefixtures("stand_ins")
def test_the_table_has_dense_and_sparse_and_what_was_not_run(dataset: DataSet, tmp_path: Path) -> None:
    for scenario in ("dense", "sparse"):
        run_trial(Trial(methods()["neus2"], scenario, tmp_path, settings=COARSE), dataset)
    text = table_markdown(read_results(tmp_path), methods())
    dense, sparse = (result.score for result in read_results(tmp_path))
    assert dense is not None
    assert sparse is not None
    assert "| Chamfer distance (mm) | Dense | Sparse |" in text
    assert f"| NeuS2 | **{dense.chamfer_mm:.2f}** | **{sparse.chamfer_mm:.2f}** |" in text
    assert f"| NeuS2 | sparse | 8 | 160 × 120 | {sparse.chamfer_mm:.3f} |" in text
    assert "It was made by a simulated rig." in text
    assert "scripts/run.py --scene" in text
    drawn = figure_png(tmp_path, read_results(tmp_path), methods())
    picture = cv2.imdecode(np.frombuffer(drawn, np.uint8), 1)
    assert picture is not None
    top, bottom = np.array_split(picture, 2)
    assert all(len(np.unique(half.reshape(-1, 3), axis=0)) > 100 for half in (top, bottom))
    record = table_record(read_results(tmp_path), methods())
    assert {entry["method"] for entry in record["not_run"]} == set(methods()) - {"neus2"}
    sugar = next(entry for entry in record["not_run"] if entry["method"] == "sugar")
    assert sugar["commands"][0] == (
        "python '$ORTHOCAPTURE_SUGAR/gaussian_splatting/train.py' -s DATA -m WORK/gaussians --iterations 7000"
    )


@pytest.mark.parametrize(("built", "lacks"), [("with CUDA", ""), ("without CUDA", "colmap is built without CUDA")])
def test_colmap_is_asked_whether_it_can_match(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built: str, lacks: str
) -> None:
    program = tmp_path / "colmap"
    program.write_text(f"#!/bin/sh\necho 'COLMAP 3.8 (Commit Unknown on Unknown {built})'\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert missing(methods()["colmap"]) == lacks


def test_gsplat_says_which_packages_or_device_it_lacks() -> None:
    lacks = [name for name in ("torch", "gsplat") if importlib.util.find_spec(name) is None]
    said = missing(methods()["gsplat"])
    assert said == f"{', '.join(lacks)} not installed" if lacks else said in {"", "torch finds no CUDA GPU"}


def test_a_failed_comparison_is_an_error_not_a_result(dataset: DataSet, tmp_path: Path) -> None:
    sheet = trimesh.Trimesh([[0, 0, 0], [1e-9, 0, 0], [0, 0, 0.0]], [[0, 1, 2]], process=False)
    sheet.export(tmp_path / "nothing.ply")
    with pytest.raises((DataError, ComputeError)):
        run_trial(Trial(methods()["colmap"], "dense", tmp_path, tmp_path / "nothing.ply"), dataset)
    assert read_results(tmp_path) == ()
