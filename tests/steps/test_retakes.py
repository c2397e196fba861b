"""A capture that falls short offers the images that would mend it: only those are retaken."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import pytest

from drivers.interfaces import CameraSettings
from service.core.records.run_events import StepNote
from service.steps import motion
from service.steps.kinds import viewpoint_capture
from service.steps.viewpoints import Viewpoint
from tests.support.rig.bench_rig import answer, other_settings
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store


@pytest.fixture
def begin(tmp_path: Path) -> Generator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as store:
        yield lambda text: begin_run(store, text, tmp_path)


def test_images_with_other_settings_are_offered_to_be_taken_again_and_only_those(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = begin(PROTOCOL)
    turned = {2}
    planned: list[list[str]] = []

    def plan_step(context: Any, viewpoints: Sequence[Viewpoint], *more: Any, **named: Any) -> motion.StepPlan:
        planned.append([viewpoint.name for viewpoint in viewpoints])
        return motion.plan_step(context, viewpoints, *more, **named)

    monkeypatch.setattr(viewpoint_capture, "plan_step", plan_step)

    def exif(applied: CameraSettings) -> CameraSettings:
        return other_settings(applied) if bench.rig.shutter.exposures in turned else applied

    bench.rig.shutter.exif = exif
    asked: list[str] = []

    def confirm(question: Any, _state: Any) -> Any:
        asked.append(question.text)
        return answer(question, "confirm")

    bench.script("capture", "recovery", confirm)
    state = bench.run()
    assert state.status == "completed"
    assert len(asked) == 1
    assert "set the camera as the protocol has it" in asked[0]
    assert "Confirm to take 1 image again; all others are kept" in asked[0]
    assert [note.note for note in bench.payloads(StepNote) if note.note == "retakes"] == ["retakes"]
    assert bench.captured() == ["v001", "v002", "v003", "v004", "v002"]
    assert planned == [["v001", "v002", "v003", "v004"], ["v002"]], (
        "no motion without a plan from where the arm stands"
    )
    bench.must_verify()
