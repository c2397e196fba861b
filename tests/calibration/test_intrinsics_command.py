"""`orthocapture calibrate intrinsics` on photographs of a board, and its message about a lens that was touched."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.calibration.board import Board
from service.compute.camera_model import CameraModel
from service.compute.photography import Optics, compare_optics
from service.compute.poses.pose_files import read_camera_json
from service.core.errors import DataError
from service.core.geometry import transform
from service.core.protocol import load_protocol
from service.core.records.base import Moment
from service.core.records.run_events import ViewpointCaptured
from service.steps import params_models
from service.steps.context import StepContext
from service.steps.retakes import departing_images, optics_departures
from tests.support.boards.board_images import checkerboard, photograph

CAMERA = CameraModel(900, 600, 1260, 1261, 452.0, 301.0, -0.045, 0.03, 4e-4, -5e-4)
BOARD = Board(9, 6, 0.02)
FOCAL_LENGTH_TAG, APERTURE_TAG, EXIF_IFD = 0x920A, 0x829D, 0x8769


def _save(path: Path, grey: np.ndarray[Any, Any], *, focal_length_mm: float = 50.0) -> None:
    exif = Image.Exif()
    exif.get_ifd(EXIF_IFD).update({FOCAL_LENGTH_TAG: focal_length_mm, APERTURE_TAG: 22.0})
    Image.fromarray(grey).save(path, quality=95, exif=exif)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of a board, one of another size, and an image without a board."""
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(4)
    shade = checkerboard(BOARD.columns, BOARD.rows, BOARD.square_m)
    for k in range(8):
        R = Rotation.from_euler("zxz", [k * 50, 8 + 4 * k, -k * 50 + (k % 3) * 8], degrees=True).as_matrix()
        place = np.array([0.04 * (k % 3 - 1), 0.02 * (k % 2), 0.52])
        T = transform(R, place - R @ BOARD.points().mean(axis=0))
        _save(folder / f"b{k}.jpg", photograph(shade, CAMERA, T, rng, samples=2))
    _save(folder / "empty.jpg", np.full((600, 900), 120, dtype=np.uint8))
    Image.open(folder / "b0.jpg").resize((1200, 800)).save(folder / "larger.png")
    return folder


def _run(folder: Path, out: Path, *more: str) -> Result:
    words = ["calibrate", "intrinsics", "--images", str(folder), "--board", "9x6", "--square-mm", "20"]
    return CliRunner().invoke(app, [*words, "--out", str(out), *more])


@pytest.mark.slow
def test_a_folder_of_photographs_becomes_a_camera_that_every_command_reads(folder: Path, tmp_path: Path) -> None:
    out, report = tmp_path / "camera.json", tmp_path / "report"
    done = _run(folder, out, "--report", str(report), "--distance-m", "0.6", "--json")
    assert done.exit_code == 0, done.output
    record = json.loads(out.read_text())
    assert json.loads(done.stdout) == record
    for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
        assert abs(record[name] - getattr(CAMERA, name)) < 5 * record["sigma"][name], name
    assert (record["width"], record["height"]) == (900, 600)
    assert record["n_views"] == len(record["per_view_rms_px"]) == len(record["images"]) == 8
    assert record["rms_px"] < 0.05
    assert record["cross_validation"]["five_fold_rms_px"] < 0.06
    assert np.array(record["covariance"]["matrix"]).shape == (8, 8)
    assert record["uncertainty"]["distance_m"] == 0.6
    assert record["uncertainty"]["centre_mm"] < record["uncertainty"]["worst_mm"] < 1
    reasons = {view["image"]: view["reason"] for view in record["excluded"]}
    assert set(reasons) == {"empty.jpg", "larger.png"}
    assert "no board" in reasons["empty.jpg"]
    assert "1200 × 800" in reasons["larger.png"]
    camera = read_camera_json(out)
    assert (camera.width, camera.height, camera.fx) == (900, 600, record["fx"])
    for name in ("coverage.png", "residuals.png", "uncertainty.png"):
        with Image.open(report / name) as plot:
            assert plot.width > 800
    assert any("8 views" in warning for warning in record["warnings"])


@pytest.mark.slow
def test_a_focus_motor_that_moved_is_named_and_a_body_that_does_not_tell_is_said(
    folder: Path, tmp_path: Path
) -> None:
    at = [
        Optics(f"{k}.jpg", focus_mode="Manual", focus_position=position) for k, position in enumerate((117, 117, 60))
    ]
    (departure,) = compare_optics(at, at).departures
    assert str(departure) == "2.jpg: focus_position 60, calibrated at 117"
    near = [Optics("a.jpg", focus_position=117), Optics("b.jpg", focus_position=118)]
    assert not compare_optics(near, near).departures
    done = _run(folder, tmp_path / "camera.json")
    assert "do not state the focus distance: a change of focus would go unnoticed" in done.output


@pytest.mark.slow
def test_a_zoom_that_moved_after_the_calibration_is_named(folder: Path, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    capture.mkdir()
    for k, focal_length_mm in enumerate((50.0, 50.0, 52.0)):
        _save(capture / f"c{k}.jpg", np.zeros((600, 900), dtype=np.uint8), focal_length_mm=focal_length_mm)
    out = tmp_path / "camera.json"
    done = _run(folder, out, "--capture-images", str(capture))
    assert done.exit_code == 0, done.output
    optics = json.loads(out.read_text())["optics"]
    assert optics["capture_images"] == ["c2.jpg"]
    assert optics["capture_departures"] == ["c2.jpg: focal_length_mm 52, calibrated at 50"]
    assert {"focal_length_mm", "aperture_f"} <= set(optics["compared"])
    assert "lens" in optics["not_stated"]
    assert "c2.jpg" in done.output


@pytest.mark.slow
def test_images_without_the_board_end_with_the_reason(folder: Path, tmp_path: Path) -> None:
    poor = tmp_path / "poor"
    poor.mkdir()
    (poor / "empty.jpg").write_bytes((folder / "empty.jpg").read_bytes())
    done = _run(poor, tmp_path / "c.json", "--json")
    assert done.exit_code == 1
    assert "found in none of 1 images" in json.loads(done.stdout)["error"]["what"]
    for k in (0, 3):
        (poor / f"b{k}.jpg").write_bytes((folder / f"b{k}.jpg").read_bytes())
    done = _run(poor, tmp_path / "c.json", "--json")
    assert done.exit_code == 1
    assert "2 usable board views" in json.loads(done.stdout)["error"]["what"]
    assert "empty.jpg" in json.loads(done.stdout)["error"]["what"]
    assert not (tmp_path / "c.json").exists()


def test_optics_are_compared_where_both_sides_state_them() -> None:
    calibration = [Optics(f"b{k}", 900, 600, 50.0, 22.0, lens="FE 50") for k in range(3)]
    same = compare_optics(calibration, [Optics("c0", 900, 600, 50.1, 22.0, lens="FE 50")])
    assert same.departures == ()
    assert "body_serial" in same.unknown
    other = compare_optics(
        calibration, [Optics("c0", 900, 600, 50.0, 22.0), Optics("c1", 600, 900, 50.0, 16.0, lens="FE 55")]
    )
    assert [d.field for d in other.departures] == ["width", "height", "aperture_f", "lens"]
    assert other.images == ("c1",)
    with pytest.raises(DataError, match="no images"):
        compare_optics(calibration, [])


class _Recorded:
    """The captures of two steps as in the evidence, and the notes made."""

    def __init__(self, focal_lengths_mm: dict[str, list[float]]) -> None:
        self.notes: list[Any] = []
        self._captures = {
            step: tuple(
                ViewpointCaptured.model_construct(
                    viewpoint=f"{step}{k}",
                    camera={"focal_length_mm": f, "aperture_f": 22.0, "lens": "FE 50", "iso": 100},
                )
                for k, f in enumerate(values)
            )
            for step, values in focal_lengths_mm.items()
        }

    def captures(self, step_id: str) -> tuple[ViewpointCaptured, ...]:
        return self._captures.get(step_id, ())

    def record(self, *payloads: Any, **_: Any) -> None:
        self.notes += payloads


PROTOCOL = {
    "id": "optics",
    "version": "1",
    "title": "Two steps",
    "spheres": {"radius_mm": 15, "registration": 10, "control": 3},
    "board": {"columns": 9, "rows": 6, "square_mm": 20},
    "camera": {"aperture_f": 22, "exposure_s": "1/50", "iso": 100},
}


def test_images_of_a_later_step_are_held_against_the_calibration(tmp_path: Path) -> None:
    text = json.dumps(
        {
            **PROTOCOL,
            "steps": [
                {"id": "c", "kind": "calibration", "title": "C", "params": {"solve": ["intrinsics"]}},
                {
                    "id": "v",
                    "kind": "viewpoint_capture",
                    "title": "V",
                    "params": {"purpose": "dataset", "viewpoints": []},
                },
            ],
        }
    )
    file = tmp_path / "protocol.yaml"
    file.write_text(text)
    protocol = load_protocol(file, params_models()).protocol
    told: list[str] = []

    def context(step: int, evidence: _Recorded) -> StepContext:
        return StepContext(
            protocol, protocol.steps[step], 1, cast("Any", None), cast("Any", None), cast("Any", evidence),
            lambda: None, lambda *_: None, lambda: 0.0, lambda _: None, "Ada", told.append,
            lambda: Moment(0.0, "", ""), nullcontext, lambda _: None,
        )  # fmt: skip

    assert optics_departures(context(1, _Recorded({"v": [50.0]}))) is None
    good = _Recorded({"c": [50.0, 50.0, 50.0], "v": [50.0, 50.1]})
    assert optics_departures(context(1, good)) == ()
    assert good.notes == told == []
    moved = _Recorded({"c": [50.0, 50.0, 55.0], "v": [50.0, 52.0, 52.0]})
    departures = optics_departures(context(1, moved))
    assert departures is not None
    assert departing_images(departures) == 2
    assert "focal_length_mm 52, calibrated at 50: v1, v2" in told[0]
    assert len(moved.notes) == 1
    within = optics_departures(context(0, moved))
    assert within is not None
    assert [d.image for d in within] == ["c2"]
