"""The dry run of docs/howto/real_rig.md: planned from the documented rig file, and made on a simulated rig."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.run_events import ViewpointCaptured
from service.rig import load_rig
from service.store.store import Store
from tests.support.rig.rig import REPOSITORY, orthocapture, simulated_rig

DRY_RUN = REPOSITORY / "protocols" / "dry_run.yaml"
TURNED = [[1, 0, 0, 0.0], [0, -1, 0, 0.0], [0, 0, -1, -0.1], [0, 0, 0, 1]]  # the camera looks back along the arm


def documented(page: str) -> str:
    """The complete rig file that a page of docs/howto shows."""
    text = (REPOSITORY / "docs" / "howto" / page).read_text(encoding="utf-8")
    (block,) = re.findall(r"^```yaml\n(name: .*?)^```", text, re.MULTILINE | re.DOTALL)
    return block


def outcomes(folder: Path, rig: str) -> list[str]:
    (folder / "rig.yaml").write_text(rig, encoding="utf-8")
    words = ["plan", "show", str(DRY_RUN), "--rig", str(folder / "rig.yaml"), "--json"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    (plan,) = json.loads(done.stdout)["dry_run"]
    return [view["outcome"] for view in plan["views"]]


@pytest.mark.parametrize("page", ["real_rig.md", "your_hardware.md"])
def test_the_rig_files_of_the_documents_are_valid(tmp_path: Path, page: str) -> None:
    (tmp_path / "rig.yaml").write_text(documented(page), encoding="utf-8")
    assert not load_rig(tmp_path / "rig.yaml").section.simulated


def test_every_viewpoint_is_planned_from_the_documented_rig_file(tmp_path: Path) -> None:
    assert outcomes(tmp_path, documented("real_rig.md")) == ["feasible"] * 5


def test_a_camera_described_the_wrong_way_round_costs_viewpoints_in_the_plan(tmp_path: Path) -> None:
    rig: dict[str, Any] = yaml.safe_load(documented("real_rig.md"))
    rig["T_flange_camera_nominal"] = TURNED
    assert "refused" in outcomes(tmp_path, yaml.safe_dump(rig))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_dry_run_takes_its_five_photographs(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with simulated_rig(
        tmp_path, "--scene", "3", "--image-width", "320", "--speed-up", "8", host="127.0.0.37"
    ) as ready:
        words = ("run", str(DRY_RUN), "--rig", ready["rig"], "--data", str(data), "--auto-confirm")
        done = orthocapture(*words, timeout_s=240)
    assert done.returncode == 0, done.stdout + done.stderr
    with Store.open(data) as store:
        (run,) = store.runs()
        taken = [e.payload for e in store.events(run.run_id) if isinstance(e.payload, ViewpointCaptured)]
    assert sorted(view.viewpoint for view in taken) == [f"d{i:03d}" for i in range(1, 6)]
