"""`orthocapture benchmark matching` on a small simulated data set: real figures, files, and refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from typer.testing import CliRunner

from service.benchmark.matching import read_result, record
from service.cli.main import app
from service.compute.camera_model import CameraModel
from service.compute.matching.loader import MatchingData
from service.compute.matching.methods import GROUP
from service.core.geometry import Array
from service.dataset.exporter import exporter, write_data_set
from tests.support.scenes.posed import posed_data_set

CAMERA = CameraModel(480, 360, 700.0, 702.0, 238.0, 181.0, -0.05, 0.01, 3e-4, -2e-4)
_GRID_M, _FROM_M = (0.0025, 0.006), -0.15

#: Knows nothing but the pictures, as every method: it says so if it can find more.
PLUGIN = """
import numpy as np
from service.compute.matching.methods import Matcher, Matches

def run(first, second):
    assert first.dtype == second.dtype == np.uint8 and first.ndim == 3
    first[:], second[:] = 0, 0  # spoils nobody's picture
    return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))

KIND = Matcher("blind", "finds nothing", lambda weights: run)
"""


def spotted(world: Array) -> Array:
    """Brightness of points (..., 3): spots of two sizes, which look the same from everywhere."""
    tone = np.full(world.shape[:-1], 20.0)
    for k, size_m in enumerate(_GRID_M):
        count = round(0.3 / size_m)
        values = np.random.default_rng(k).random((count, count, count))
        tone += 110 * map_coordinates(values, np.moveaxis((world - _FROM_M) / size_m, -1, 0), order=1, mode="nearest")
    return tone


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    dataset = posed_data_set(tmp_path_factory.mktemp("photographs"), 14, camera=CAMERA, tone=spotted)
    target = tmp_path_factory.mktemp("exported") / "pairs"
    write_data_set(dataset, exporter("matching"), target)
    return target


def run(folder: Path, out: Path, *arguments: str, method: str = "sift") -> tuple[int, str]:
    command = ["benchmark", "matching", str(folder), "--method", method, "--out", str(out), *arguments]
    result = CliRunner().invoke(app, command)
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def scored(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    out = tmp_path_factory.mktemp("results")
    status, printed = run(folder, out, "--pairs-per-class", "4", "--json")
    assert status == 0, printed
    return out, json.loads(printed)


@pytest.mark.slow
def test_sift_finds_poses_and_fewer_matches_of_difficult_pairs(scored: tuple[Path, Any]) -> None:
    classes = scored[1]["classes"]
    assert len(classes) >= 3
    near = classes["medium"]
    assert near["matches"] > 50
    assert near["precision"]["3"] > 0.8
    assert near["auc"]["20"] > 0.7
    assert near["epipolar_px"] < 1.0
    assert classes["extreme"]["matches"] < 0.9 * near["matches"]
    assert near["scored"] > 0.9  # the solid alone has spots
    for one in classes.values():
        assert one["auc"]["5"] <= one["auc"]["10"] <= one["auc"]["20"]
        assert list(one["precision"].values()) == sorted(one["precision"].values())


@pytest.mark.slow
def test_the_folder_has_table_curves_and_pictures(scored: tuple[Path, Any]) -> None:
    out, printed = scored
    table = (out / "table.md").read_text(encoding="utf-8")
    assert "| sift | medium | " in table
    assert "The data set is simulated." in table
    assert record(read_result(out / "sift.json")) == printed
    for name in ("curves", *(f"sift_{one}" for one in printed["classes"] if one != "all")):
        picture = cv2.imread(str(out / f"{name}.png"))
        assert picture is not None
        assert picture.std() > 5


@pytest.mark.slow
def test_methods_share_a_table_if_they_share_their_pairs(
    folder: Path, scored: tuple[Path, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, _ = scored
    (tmp_path / "blind_matcher.py").write_text(PLUGIN, encoding="utf-8")
    about = tmp_path / "blind_matcher-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: blind-matcher\nVersion: 1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\nblind = blind_matcher:KIND\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    status, printed = run(folder, out, "--pairs-per-class", "3", method="blind")
    assert status == 1
    assert "results of other pairs are in this folder" in printed
    status, printed = run(folder, out, "--pairs-per-class", "4", method="blind")
    assert status == 0, printed
    lines = (out / "table.md").read_text(encoding="utf-8").splitlines()
    blind = next(line for line in lines if line.startswith("| blind | all |"))
    assert " | 0.0 | 0.0 | 0.0 | 0.0 | 0.0 | 0.0 | – | 0 |" in blind
    assert any(line.startswith("| sift | all |") for line in lines)


@pytest.mark.slow
def test_pairs_are_chosen_evenly_and_alike(folder: Path, scored: tuple[Path, Any]) -> None:
    pairs = scored[1]["pairs"]
    listed = [(pair["first"], pair["second"]) for pair in MatchingData(folder).pairs]
    assert len(pairs) == sum(one["pairs"] for name, one in scored[1]["classes"].items() if name != "all")
    assert {(pair["first"], pair["second"]) for pair in pairs} <= set(listed)
    assert all(one["pairs"] <= 4 for name, one in scored[1]["classes"].items() if name != "all")


def test_what_is_no_data_set_is_refused(tmp_path: Path) -> None:
    status, printed = run(tmp_path, tmp_path / "out")
    assert status == 1
    assert "this is not a data set for feature matching" in printed
    assert "export RUN --format matching" in printed.replace("\n", " ")


@pytest.mark.slow
def test_an_unknown_method_and_a_learned_one_without_its_packages_are_refused(folder: Path, tmp_path: Path) -> None:
    status, printed = run(folder, tmp_path / "out", method="magic")
    assert status == 1
    assert "there is no matching method 'magic'" in printed
    status, printed = run(folder, tmp_path / "out", "--weights", str(tmp_path / "x.ckpt"), method="loftr")
    assert status == 1
    assert "pip install" in printed


def test_a_damaged_depth_is_told(folder: Path, tmp_path: Path) -> None:
    spoilt = tmp_path / "pairs"
    shutil.copytree(folder, spoilt)
    for path in (spoilt / "depth").iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    status, printed = run(spoilt, tmp_path / "out")
    assert status == 1
    assert "the depth of a view cannot be read" in printed
    assert not list((tmp_path / "out").glob("*.json"))
