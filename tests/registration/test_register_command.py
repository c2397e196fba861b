"""`orthocapture register` on photographs of a scene with ground truth, with every kind of input."""

from __future__ import annotations

import dataclasses
import importlib
import json
import shutil
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from service.cli.common import shipped_protocols
from service.cli.main import app
from service.compute.camera_model import CameraModel
from service.compute.poses.pose_files import write_camera_json, write_poses_csv, write_transforms_json
from service.core.geometry import apply, inverse
from simulators.scan_station.formats import encode
from simulators.scan_station.station import scan_scene
from simulators.scene.world import RADIUS_M, Scene
from tests.support.grounded_weights import tiny_weights
from tests.support.scenes.colmap_model import write_colmap_text
from tests.support.scenes.scene_photographs import photograph, pose_above

Array = NDArray[np.float64]

WIDTH, N_IMAGES, SEED = 576, 6, 7
KEYS = {
    "T_world_scan", "scale", "covariance", "rms_px", "mean_radial_error_mm", "mean_reprojection_error_px", "n_images",
    "markers", "images",
}  # fmt: skip


@dataclass(frozen=True)
class Capture:
    """Photographs and everything that is known about them."""

    folder: Path
    camera: CameraModel
    T_world_camera: dict[str, Array]
    T_world_scan: Array
    mesh: Path
    registration_scan_m: Array
    control_scan_m: Array

    def spheres_json(self) -> dict[str, Any]:
        return {
            "radius_mm": 1e3 * RADIUS_M,
            "registration_mm": (1e3 * self.registration_scan_m).tolist(),
            "control_mm": (1e3 * self.control_scan_m).tolist(),
        }


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Six photographs from two sides, a scan with the control spheres, and all the files a user would have."""
    folder = tmp_path_factory.mktemp("capture")
    scene = Scene.generate(SEED)
    camera = CameraModel(**dataclasses.asdict(scene.camera_intrinsics(WIDTH)))
    poses = {
        f"DSC{i + 1:05d}.JPG": pose_above(2 * np.pi * (i + 0.3) / N_IMAGES, np.deg2rad(18 + 9 * (i % 3)))
        for i in range(N_IMAGES)
    }
    photograph(scene, poses, WIDTH, folder / "images")
    scan = scan_scene(scene, spray=True, control_spheres=True, spacing_m=1.6e-3)
    (_, data), *_ = encode("ply", "scan.ply", 1e3 * scan.vertices_m, scan.faces, scan.normals)
    (folder / "scan.ply").write_bytes(data)
    T_scan_world = inverse(scan.T_world_scan)
    made = Capture(
        folder, camera, poses, scan.T_world_scan, folder / "scan.ply",
        apply(T_scan_world, scene.registration_m), apply(T_scan_world, scene.control_m),
    )  # fmt: skip
    write_camera_json(folder / "camera.json", camera)
    (folder / "spheres.json").write_text(json.dumps(made.spheres_json()))
    write_poses_csv(folder / "poses.csv", poses)
    return made


@pytest.fixture
def few(capture: Capture, tmp_path: Path, one_processor: None) -> Path:
    """Three of the photographs, processed within this process."""
    folder = tmp_path / "few"
    folder.mkdir()
    for name in ("DSC00001.JPG", "DSC00003.JPG", "DSC00005.JPG"):
        shutil.copy(capture.folder / "images" / name, folder)
    return folder


@pytest.fixture(scope="module")
def record(capture: Capture) -> dict[str, Any]:
    """The result of registering all photographs, with spheres.json and CSV."""
    out = capture.folder / "result.json"
    result = register(capture, out, workers=1)  # to start more takes longer than what they do
    assert f"{N_IMAGES} images" in result.output
    assert "written:" in result.output
    return registered(result, out)


def register(capture: Capture, out: Path, **changes: object) -> Result:
    """The command with the capture's files; `spheres`, `poses`, … replace an option, None omits it."""
    options: dict[str, object] = {
        "images": capture.folder / "images",
        "camera": capture.folder / "camera.json",
        "poses": capture.folder / "poses.csv",
        "spheres": capture.folder / "spheres.json",
        "out": out,
        **changes,
    }
    words = ["register"]
    for name, value in options.items():
        if value is True:
            words.append(f"--{name.replace('_', '-')}")
        elif value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    result = CliRunner().invoke(app, words, catch_exceptions=False)
    assert "Traceback" not in result.output
    return result


def registered(result: Result, out: Path) -> dict[str, Any]:
    assert result.exit_code == 0, result.output
    record = json.loads(out.read_text())
    assert set(record) >= KEYS
    return record


def true_error_mm(record: dict[str, Any], capture: Capture) -> float:
    """Largest distance of a sphere from its true position."""
    points = np.concatenate([capture.registration_scan_m, capture.control_scan_m])
    gap = apply(np.array(record["T_world_scan"]), points) - apply(capture.T_world_scan, points)
    return 1e3 * float(np.linalg.norm(gap, axis=1).max())


# --- what it computes -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_spheres_and_csv(capture: Capture, record: dict[str, Any]) -> None:
    assert true_error_mm(record, capture) < 0.1
    assert record["scale"] == 1.0
    assert record["n_images"] == N_IMAGES
    assert record["rms_px"] < 0.5
    assert record["mean_radial_error_mm"] < 0.2
    assert record["mean_reprojection_error_px"] < 0.5
    assert len(record["markers"]) >= 9
    sigma_m = np.sqrt(np.diag(record["covariance"]))
    assert sigma_m.shape == (6,)
    assert np.all((sigma_m > 1e-7) & (sigma_m < 1e-2))


@pytest.mark.slow
def test_its_limits_of_control_spheres_are_the_gates_of_the_shipped_protocol(record: dict[str, Any]) -> None:
    protocol = yaml.safe_load((shipped_protocols() / "exvivo_spine.yaml").read_text())
    gates = [gate for step in protocol["steps"] if step["id"] == "evaluation" for gate in step["gates"]]
    limits = {gate["measure"]: (gate.get("min"), gate.get("max")) for gate in gates}
    own = {gate["measure"]: (gate["minimum"], gate["maximum"]) for gate in record["gates"]}
    both = ("best_mean_radial_error_mm", "worst_control_sphere_mm", "control_outlines_share")
    assert [own[measure] for measure in both] == [limits[measure] for measure in both]


@pytest.mark.slow
def test_detections_lie_on_the_spheres_they_are_said_to_be(capture: Capture, record: dict[str, Any]) -> None:
    assert [entry["image"] for entry in record["images"]] == sorted(capture.T_world_camera)
    seen = 0
    for entry in record["images"]:
        T_camera_scan = inverse(capture.T_world_camera[entry["image"]]) @ capture.T_world_scan
        assert np.allclose(inverse(np.array(entry["T_scan_camera"])), T_camera_scan, atol=1e-3)
        for detection in entry["detections"]:
            for key, centres in (("marker", capture.registration_scan_m), ("control", capture.control_scan_m)):
                if detection[key] is not None:
                    x, y, z = apply(T_camera_scan, centres[detection[key]])
                    pinhole = np.array([capture.camera.fx * x / z, capture.camera.fy * y / z])
                    middle = np.array([capture.camera.cx, capture.camera.cy])
                    # Distortion and the ellipse's eccentricity shift it by less.
                    assert np.linalg.norm(pinhole + middle - detection["centre_px"]) < 4
                    seen += 1
    assert seen > 5 * N_IMAGES


@pytest.mark.slow
def test_mesh_and_control_indices(capture: Capture, few: Path, tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    mesh: dict[str, object] = {
        "spheres": None,
        "mesh": capture.mesh,
        "radius_mm": 15,
        "mesh_unit": "mm",
        "images": few,
    }
    record = registered(register(capture, out, **mesh), out)
    assert record["mean_radial_error_mm"] is None
    centres = np.array(record["spheres_mm"]["registration"])
    assert len(centres) == 13
    assert true_error_mm(record, capture) < 0.15
    # The user reads the indices from this list and runs again.
    gaps = np.linalg.norm(centres[:, None] - 1e3 * capture.control_scan_m, axis=2)
    control = gaps.argmin(axis=0)
    assert gaps.min(axis=0).max() < 0.1
    record = registered(register(capture, out, **mesh, control=",".join(map(str, control))), out)
    assert len(record["spheres_mm"]["registration"]) == 10
    assert np.allclose(record["spheres_mm"]["control"], centres[sorted(control)])
    assert true_error_mm(record, capture) < 0.15
    assert record["mean_radial_error_mm"] < 0.2


@pytest.mark.slow
def test_transforms_json_and_colmap_say_the_same(capture: Capture, few: Path, tmp_path: Path) -> None:
    write_transforms_json(tmp_path / "transforms.json", capture.camera, capture.T_world_camera)
    write_colmap_text(tmp_path / "colmap", capture.camera, capture.T_world_camera)
    found: list[Any] = []
    for poses in ("transforms.json", "colmap"):
        out = tmp_path / f"{poses}-result.json"
        record = registered(register(capture, out, images=few, poses=tmp_path / poses), out)
        assert true_error_mm(record, capture) < 0.15
        found.append(record["T_world_scan"])
    assert np.allclose(*found, atol=1e-6)


@pytest.mark.slow
def test_scale_of_poses_that_are_not_metric(capture: Capture, few: Path, tmp_path: Path) -> None:
    factor = 7.3
    scaled = {name: pose.copy() for name, pose in capture.T_world_camera.items()}
    for pose in scaled.values():
        pose[:3, 3] *= factor
    write_poses_csv(tmp_path / "scaled.csv", scaled)
    out = tmp_path / "result.json"
    options: dict[str, object] = {"images": few, "poses": tmp_path / "scaled.csv"}
    record = registered(register(capture, out, **options, estimate_scale=True), out)
    assert record["scale"] == pytest.approx(1 / factor, rel=5e-4)  # metres per unit of the poses
    assert true_error_mm(record, capture) < 0.2
    assert record["mean_radial_error_mm"] < 0.2
    assert np.array(record["covariance"]).shape == (7, 7)
    # If assumed metric they contradict the images, and nothing is written.
    answer = register(capture, tmp_path / "none.json", **options)
    refused(answer, tmp_path / "none.json", "different units or scales", "--estimate-scale")


@pytest.mark.slow
def test_a_displaced_control_sphere_is_measured_told_and_not_passed(
    capture: Capture, few: Path, tmp_path: Path
) -> None:
    """One displaced by 2 mm had 0.04 mm in 1 of 18 images, since an outline off the common pose was not believed."""
    listed = capture.spheres_json()
    listed["control_mm"][0] = np.add(listed["control_mm"][0], [2.0, 3.0, 3.5]).tolist()
    (tmp_path / "spheres.json").write_text(json.dumps(listed))
    stated = json.loads((capture.folder / "camera.json").read_text())
    stated["covariance"] = {"parameters": ["fx", "fy"], "matrix": [[0.04, 0.0], [0.0, 0.04]]}
    (tmp_path / "camera.json").write_text(json.dumps(stated))
    out = tmp_path / "result.json"
    changes = {"images": few, "spheres": tmp_path / "spheres.json", "camera": tmp_path / "camera.json"}
    result = register(capture, out, **changes)
    assert result.exit_code == 1
    record = json.loads(out.read_text())
    assert record["verdict"] == "not passed"
    assert [g["measure"] for g in record["gates"] if not g["passed"]][-1] == "worst_control_sphere_mm"
    first, *others = record["control_spheres"]
    assert first["n_images"] == first["n_expected"] > 0
    assert first["displacement_mm"] == pytest.approx(5.0, abs=0.4)
    assert all(one["finding"] == "" for one in others)
    said = " ".join(result.output.split())
    assert "Control sphere 0 is" in said
    assert "outside its limit: Radial error of the worst control sphere" in said
    assert "not passed written:" in said
    # The covariance that the calibration states is counted.
    assert record["components_mm"]["intrinsics"] > 0


# --- what it refuses --------------------------------------------------------------------------------------


def refused(result: Result, out: Path, *words: str) -> None:
    assert result.exit_code == 1, result.output
    for word in words:
        assert word in result.output
    assert not out.exists()


@pytest.mark.slow
def test_an_image_without_a_pose(capture: Capture, tmp_path: Path) -> None:
    lines = (capture.folder / "poses.csv").read_text().splitlines(keepends=True)
    (tmp_path / "poses.csv").write_text("".join(line for line in lines if not line.startswith("DSC00003.JPG")))
    out = tmp_path / "result.json"
    refused(register(capture, out, poses=tmp_path / "poses.csv", strict=True), out, "DSC00003.JPG", "no pose")
    left = register(capture, out, poses=tmp_path / "poses.csv", workers=1)
    assert left.exit_code == 0, left.output
    assert "left out DSC00003.JPG: no pose in poses.csv" in left.output
    assert json.loads(out.read_text())["left_out"] == {"DSC00003.JPG": "no pose in poses.csv"}


def test_a_truncated_photograph(capture: Capture, few: Path, tmp_path: Path) -> None:
    file = few / "DSC00001.JPG"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    out = tmp_path / "result.json"
    refused(register(capture, out, images=few), out, "ends before", "DSC00001.JPG")


def test_photographs_of_another_size_than_the_calibrated(capture: Capture, few: Path, tmp_path: Path) -> None:
    for file in few.iterdir():
        picture = cv2.imread(str(file))
        assert picture is not None
        cv2.imwrite(str(file), picture[:-40])
    out = tmp_path / "result.json"
    refused(register(capture, out, images=few), out, f"{WIDTH} × 344 px", "camera model is for")


@pytest.mark.slow
def test_photographs_that_show_too_few_spheres(capture: Capture, few: Path, tmp_path: Path) -> None:
    for file in few.iterdir():
        picture = cv2.imread(str(file))
        assert picture is not None
        picture[:, WIDTH // 24 :] = 90
        cv2.imwrite(str(file), picture)
    out = tmp_path / "result.json"
    refused(register(capture, out, images=few), out, "too few spheres", "DSC00001.JPG", "what to do")


def test_a_cloud_of_three_points(capture: Capture, tmp_path: Path) -> None:
    (_, data), *_ = encode("ply", "points.ply", np.eye(3) * 100, np.empty((0, 3), np.int64), None)
    (tmp_path / "points.ply").write_bytes(data)
    out = tmp_path / "result.json"
    result = register(capture, out, spheres=None, mesh=tmp_path / "points.ply", radius_mm=15, mesh_unit="mm")
    refused(result, out, "found 0 spheres", "unit")


@pytest.mark.slow
def test_a_control_index_that_the_mesh_has_not(capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    result = register(capture, out, spheres=None, mesh=capture.mesh, radius_mm=15, mesh_unit="mm", control="2,13")
    refused(result, out, "sphere 13", "0 … 12")


def test_errors_as_json(capture: Capture, tmp_path: Path) -> None:
    result = register(capture, tmp_path / "result.json", images=tmp_path / "nowhere", json=True)
    assert result.exit_code == 1
    assert json.loads(result.stdout)["error"]["what"] == "the image folder does not exist"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mesh": "scan.ply"}, "either --mesh or --spheres"),
        ({"spheres": None}, "either --mesh or --spheres"),
        ({"spheres": None, "mesh": "scan.ply"}, "--radius-mm"),
        ({"poses": None}, "--poses"),
        ({"mesh_unit": "inch"}, "inch"),
    ],
)
def test_wrong_usage_has_status_2(capture: Capture, tmp_path: Path, changes: dict[str, object], words: str) -> None:
    changes = {key: capture.mesh if key == "mesh" else value for key, value in changes.items()}
    result = register(capture, tmp_path / "result.json", **changes)
    assert result.exit_code == 2
    assert words in result.output


def test_the_papers_detector_takes_the_boxes_of_another(capture: Capture, few: Path, tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.json"
    boxes.write_text(json.dumps({"DSC00001.JPG": [[10, 10, 5, 20]]}))
    result = register(capture, tmp_path / "out.json", images=few, detector="paper", boxes=boxes)
    assert result.exit_code != 0
    assert "no area" in result.output
    boxes.write_text(json.dumps({"other.jpg": []}))
    assert "other.jpg" in register(capture, tmp_path / "out.json", images=few, detector="paper", boxes=boxes).output
    assert "paper" in register(capture, tmp_path / "out.json", images=few, boxes=boxes).output
    assert "mauve" in register(capture, tmp_path / "out.json", images=few, sphere_colour="mauve").output


@pytest.mark.packages("torch")
@pytest.mark.slow
@pytest.mark.sweep
def test_grounded_and_vote_record_the_hashes_of_their_weights(
    capture: Capture, few: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ORTHOCAPTURE_GROUNDED", raising=False)
    without = register(capture, tmp_path / "out.json", images=few, detector="grounded")
    assert without.exit_code != 0
    assert "grounding-dino" in without.output
    importlib.import_module("torch").set_num_threads(1)
    weights = tiny_weights(tmp_path / "weights")
    # Random networks find no sphere for certain, so that the classical detector's clear outlines are what is left.
    out = tmp_path / "out.json"
    found = registered(register(capture, out, images=few, detector="vote", weights=weights), out)
    assert found["detector"]["name"] == "vote"
    model = weights / "sam2" / "model.safetensors"
    assert found["detector"]["weights_sha256"]["sam2/model.safetensors"] == sha256(model.read_bytes()).hexdigest()
    assert found["search"]["images_searched"] == 3
