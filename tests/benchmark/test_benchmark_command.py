"""`orthocapture benchmark` as it is typed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from service.cli.main import app
from service.dataset.exporter import exporter, write_data_set
from tests.support.scenes.posed import posed_data_set, scene

CENTRE_M = np.array([0.0, 0.03, 0.025])  # of the box of the solid


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a data set and the mesh that NeuS2 would make of it: centred, not scaled."""
    (tmp_path / "photographs").mkdir()
    write_data_set(posed_data_set(tmp_path / "photographs", 2), exporter("hdf5"), tmp_path / "dataset")
    scene().mesh.copy().apply_translation(-CENTRE_M).export(tmp_path / "15000.obj")
    return tmp_path


def answer(*arguments: object) -> Any:
    """What the command prints with --json."""
    done = CliRunner().invoke(app, ["benchmark", *map(str, arguments), "--json"], catch_exceptions=False)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_methods_are_run_scored_and_put_into_the_table(folder: Path) -> None:
    common = ("--scenario", "dense", "--out", folder / "benchmark", "--spacing-mm", "1")
    mesh = ("--mesh", folder / "15000.obj")
    given = answer("run", folder / "dataset", "--method", "neus2", *mesh, *common)
    assert abs(given["score"]["chamfer_mm"] - given["score"]["floor_mm"]) < 0.01
    assert given["elsewhere"]
    refused = answer("run", folder / "dataset", "--method", "neus2", *common)
    assert refused["error"]["what"].startswith("NeuS2 cannot run here")
    # The two photographs are too far apart to be matched: the method runs, and says why it has no mesh.
    run = answer("run", folder / "dataset", "--method", "stereo", *common)
    assert run["score"] is None
    assert "no two images look at the object" in run["failure"]
    table = answer(
        "table", "--out", folder / "benchmark", "--markdown", folder / "table.md", "--figure", folder / "figure.png"
    )
    assert [result["method"] for result in table["results"]] == ["neus2", "stereo"]
    assert {entry["method"] for entry in table["not_run"]} >= {"colmap", "openmvs", "instant-ngp", "sugar", "gsplat"}
    text = (folder / "table.md").read_text(encoding="utf-8")
    assert f"| NeuS2 | **{given['score']['chamfer_mm']:.2f}** | – |" in text
    assert "| Stereo (CPU) | – | – |" in text
    with Image.open(folder / "figure.png") as picture:
        assert picture.size[0] > 500


def test_an_unknown_method_and_another_folder_are_refused(folder: Path) -> None:
    common = ("--scenario", "dense", "--out", folder / "out")
    unknown = answer("run", folder / "dataset", "--method", "magic", *common)
    assert "Choose one of colmap, gsplat, instant-ngp" in unknown["error"]["remedy"]
    other = answer("run", folder / "photographs", "--method", "stereo", *common)
    assert other["error"]["what"] == "this is not a data set in the format hdf5"
    assert answer("table", "--out", folder / "out")["results"] == []
