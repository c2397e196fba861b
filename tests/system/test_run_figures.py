"""What the whole-protocol bench reads from a record, and how it shortens the protocol."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from service.core.protocol import load_protocol
from service.dataset.summary import summarise
from service.run_start import recorded_run
from service.steps import params_models
from service.store.store import Store
from tests.support.protocols.shortened import shortened
from tests.support.recorded.run_figures import run_figures
from tests.support.rig.rig import REPOSITORY
from tests.support.runs.bench_run import record_runs


def test_seconds_of_a_run_come_from_its_record(tmp_path: Path) -> None:
    run_id, _ = record_runs(tmp_path)
    with Store.open(tmp_path / "data", create=False) as store:
        figures = run_figures(summarise(store, run_id, recorded_run(store, run_id)[0]))
    assert figures["views"] == 4
    assert figures["overhead_s"]["pairs"] == 3
    assert set(figures["steps_s"]) >= {"fixation", "capture"}
    assert all(seconds >= 0 for seconds in figures["steps_s"].values())


@pytest.mark.parametrize("divisor", [6, 20])
def test_the_shortened_protocol_is_sound_and_keeps_every_kind_of_step(tmp_path: Path, divisor: int) -> None:
    whole = REPOSITORY / "protocols" / "exvivo_spine.yaml"
    short = load_protocol(shortened(whole, divisor, tmp_path / "short.yaml"), params_models()).protocol
    long = load_protocol(whole, params_models()).protocol
    assert [step.kind for step in short.steps] == [step.kind for step in long.steps]
    for step in yaml.safe_load((tmp_path / "short.yaml").read_text())["steps"]:
        params = step.get("params", {})
        views = sum(arc["count"] for s in params.get("viewpoints", []) for arc in s["arcs"])
        views += params.get("board_poses", {}).get("count", 0)
        counted = [
            gate["min"] for gate in step.get("gates", []) if gate["measure"] in ("views", "viewpoints_captured")
        ]
        assert all(0 < least <= views for least in counted)


def test_a_sixth_of_the_views_is_taken_but_board_images_stay_enough(tmp_path: Path) -> None:
    shortened(REPOSITORY / "protocols" / "exvivo_spine.yaml", 6, tmp_path / "short.yaml")
    steps = {step["id"]: step for step in yaml.safe_load((tmp_path / "short.yaml").read_text())["steps"]}
    assert steps["intrinsics"]["params"]["board_poses"]["count"] == 15
    assert next(g["min"] for g in steps["intrinsics"]["gates"] if g["measure"] == "views") == 10
    assert steps["hand_eye"]["params"]["board_poses"]["count"] == 12
