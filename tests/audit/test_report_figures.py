"""The figures of a report as files (valid SVG, CSV with the same values), and the size of a whole report."""

from __future__ import annotations

import csv
import io
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import render_html
from service.cli.main import app
from service.store.verification.verify import verify
from tests.support.recorded.reported_run import record_reported_run

_SVG = "{http://www.w3.org/2000/svg}"
_LARGEST_BYTES = 3_000_000  # limit for a report sent by mail


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the figures of a registered run."""
    folder = tmp_path_factory.mktemp("figures")
    record_reported_run(folder, registered=True)
    out = folder / "figures"
    answer = CliRunner().invoke(
        app, ["audit", "figures", "--data", str(folder / "data"), "--out", str(out), "--json"]
    )
    assert answer.exit_code == 0, answer.output
    listed = json.loads(answer.stdout)["files"]
    assert sorted(file["name"] for file in listed) == sorted(path.name for path in out.iterdir())
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


def test_every_drawing_has_its_numbers_beside_it(written: Path) -> None:
    drawings = {path.stem for path in written.glob("*.svg")}
    assert {name.split("_", 1)[1] for name in drawings} == {
        "coverage", "residuals", "projection_uncertainty", "hand_eye_held_out", "scene",
    }  # fmt: skip
    assert drawings <= {path.stem for path in written.glob("*.csv")}
    for path in written.glob("*.svg"):
        root = ET.fromstring(path.read_text(encoding="utf-8"))
        assert root.tag == f"{_SVG}svg"
        assert len(list(root)) >= 3
        assert root.get("aria-label")


def test_the_numbers_are_those_of_the_record(written: Path) -> None:
    (held_out,) = written.glob("*_hand_eye_held_out.csv")
    assert [(row["view"], float(row["error_mm"])) for row in rows_of(held_out)] == [
        ("b001", 0.03), ("b002", 0.05), ("b003", 0.04),
    ]  # fmt: skip
    (coverage,) = written.glob("*_coverage.csv")
    cells = rows_of(coverage)
    assert len(cells) == 8 * 12
    assert (cells[13]["row"], cells[13]["column"], cells[13]["corners"]) == ("1", "1", "6")
    assert (float(cells[0]["centre_x_px"]), float(cells[0]["centre_y_px"])) == (59.5, 59.5)
    (scene,) = written.glob("*_scene.csv")
    (camera,) = [row for row in rows_of(scene) if row["name"] == "v002"]
    assert [float(camera[f"{axis}_mm"]) for axis in "xyz"] == [250.0, -125.0, 500.0]
    (error,) = rows_of(written / "registration_error.csv")
    assert (error["poses"], error["mean_radial_error_mm"]) == ("colmap", "0.213")
    assert [row["sigma_mm"] for row in rows_of(written / "error_budget.csv")] == ["0.030000", "0.020000"]


def test_a_record_that_does_not_verify_gives_no_figure(tmp_path: Path) -> None:
    record_reported_run(tmp_path)
    data = tmp_path / "data"
    run = read_run(data, "latest")
    path = run.files.artefact_path(run.artefacts[-1].ref.sha256)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes() + b" ")
    answer = CliRunner().invoke(app, ["audit", "figures", "--data", str(data), "--out", str(tmp_path / "g")])
    assert answer.exit_code == 1
    assert not (tmp_path / "g").exists()


@pytest.mark.slow
def test_a_report_of_36_photographs_can_be_sent_by_post(tmp_path: Path) -> None:
    record_reported_run(tmp_path, registered=True, photographs=36)
    run = read_run(tmp_path / "data", "latest")
    html = render_html(report_content(run, verify(tmp_path / "data", run.run_id)))
    assert html.count("data:image/jpeg;base64,") == 36 + 6
    assert 'id="scene-data"' in html
    assert len(html.encode()) < _LARGEST_BYTES
    originals = {
        capture.ref.sha256 for capture in run.artefacts if capture.ref.kind == "image" and capture.attempt == 2
    }
    assert len(originals) == 36
    assert all(html.count(sha256) >= 2 for sha256 in originals), "beside its small copy, and in the table"
    assert max(len(url) for url in re.findall(r'src="data:image/jpeg;base64,([^"]+)"', html)) < 200_000
