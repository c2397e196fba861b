"""Step kind `manual_capture` on the in-memory rig: a person follows the words, and each image is judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.interfaces import CameraSettings
from service.core.geometry import inverse
from service.core.records.run_events import CaptureAsked, StepFailed, StepMeasured, ViewHeld
from simulators.hand.technician import Grip
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import Bench, begin_run, bench_store
from tests.support.runs.held_run import MIDDLE_M, STEP, held_run


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as opened:
        yield lambda text: begin_run(opened, text, tmp_path)


def result(bench: Bench) -> StepMeasured:
    return next(p for p in bench.payloads(StepMeasured) if p.step == "capture")


@pytest.mark.slow
def test_who_follows_the_words_covers_the_hemisphere(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = held_run(begin, monkeypatch, tmp_path, {}, STEP)
    assert bench.run().status == "completed"
    views = bench.payloads(ViewHeld)
    assert 6 <= len(views) <= 10
    assert {view.released_by for view in views} == {"camera"}
    measured = result(bench)
    assert measured.result["used"] == [view.viewpoint for view in views]
    assert measured.measures["hemisphere_coverage"] >= 0.9
    assert 0 < measured.measures["predicted_target_error_mm"] < 0.5
    assert 0 < measured.measures["specimen_coverage"] <= 1
    eyes = np.array([T[:3, 3] - MIDDLE_M for T, _ in person.views])
    assert set(np.sign(eyes[2:, 0]).astype(int)) >= {-1, 1}, "the person walked round"
    bench.must_verify()


@pytest.mark.slow
def test_what_cannot_be_used_stays_in_the_evidence_with_the_reason(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mishaps = {2: "blurred", 3: "stays", 4: "dial", 5: "nothing"}
    bench, _ = held_run(begin, monkeypatch, tmp_path, mishaps, STEP)
    assert bench.run().status == "completed"
    measured = result(bench)
    not_used = measured.result["not_used"]
    assert "blurred" in not_used["h_002"]
    assert "ISO 400" in not_used["h_004"]
    assert "do not tell" in not_used["h_005"]
    assert measured.measures["images_taken"] == len(bench.payloads(ViewHeld))
    assert measured.measures["images_not_used"] == len(not_used)
    assert bench.rig.shutter.applied == CameraSettings(22.0, 0.02, 100, "Manual", "JPEG"), "the dial is set back"
    assert any("next: take this one again" in line for line in bench.operator.told)
    assert any("h_002: not used: blurred" in line for line in bench.operator.told)


@pytest.mark.slow
def test_a_first_image_that_cannot_be_used_does_no_harm(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, _ = held_run(begin, monkeypatch, tmp_path, {1: "blurred", 2: "nothing", 3: "nothing"}, STEP)
    assert bench.run().status == "completed"
    assert set(result(bench).result["not_used"]) == {"h_001", "h_002", "h_003"}
    assert len([line for line in bench.operator.told if "cm above the middle of the specimen" in line]) == 2


@pytest.mark.slow
def test_a_repeated_image_is_told_apart(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, _ = held_run(begin, monkeypatch, tmp_path, {3: "stays"}, STEP)
    bench.run()
    assert result(bench).result["not_used"] == {"h_003": "it repeats h_002"}


@pytest.mark.slow
def test_the_screen_releases_and_ends_the_capture(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = held_run(begin, monkeypatch, tmp_path, {}, STEP)
    person.idle = True
    person.views = [(Grip(MIDDLE_M + np.array([0.0, 0.0, 0.66])).T_world_camera(), "")] * 2
    serve, shown = bench.operator.on_show, [0]

    def press(what: str) -> None:
        if what == "waiting for the next image":
            shown[0] += 1
            asked = {2: "release", 6: "release", 12: "finish"}.get(shown[0])
            if asked is not None:
                event = CaptureAsked.model_validate({"step": "capture", "attempt": 1, "what": asked})
                bench.store.record(bench.run_id, [event], actor="Grace")
        serve(what)

    bench.operator.on_show = press
    bench.script("capture", "recovery", lambda question, _s: answer(question, "abort", reason="as planned"))
    bench.run()
    assert [view.released_by for view in bench.payloads(ViewHeld)] == ["screen", "screen"]
    assert result(bench).result["used"] == ["h_001"]
    assert not next(g for g in bench.state().steps["capture"].verdicts if g.measure == "images_used").passed


def test_the_pedal_releases_and_a_step_without_images_asks(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = held_run(begin, monkeypatch, tmp_path, {}, STEP)
    person.idle = True
    person.views = [(Grip(MIDDLE_M + np.array([0.0, 0.0, 0.66])).T_world_camera(), "")]
    serve, shown = bench.operator.on_show, [0]

    def press(what: str) -> None:
        if what == "waiting for the next image":
            shown[0] += 1
            if shown[0] == 2 and bench.rig.box is not None:
                bench.rig.box.presses += 1
            if bench.payloads(ViewHeld):  # whenever that comes, no other does
                bench.clock.passed_s += 601.0
        serve(what)

    bench.operator.on_show = press
    bench.script("capture", "recovery", lambda question, _s: answer(question, "abort", reason="as planned"))
    bench.run()
    assert [view.released_by for view in bench.payloads(ViewHeld)] == ["pedal"]
    (failed,) = bench.payloads(StepFailed)
    assert "no image came within 600 s" in failed.message
    assert failed.error == "DeviceTimeoutError"


@pytest.mark.slow
def test_the_level_frame_of_all_images_is_that_of_the_first(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = held_run(begin, monkeypatch, tmp_path, {}, STEP)
    bench.run()
    jobs = [job for job in bench.state().steps["capture"].jobs.values() if job.kind == "hand_view"]
    frames = [
        np.array(job.result["T_scene_camera"]) @ inverse(np.array(job.result["T_level_camera"])) for job in jobs
    ]
    for frame in frames:
        np.testing.assert_allclose(frame, frames[0], atol=1e-9)
    assert len(frames) == len(person.views)


@pytest.mark.slow
def test_an_image_that_could_not_be_looked_at_says_why_and_what_to_do(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, _ = held_run(begin, monkeypatch, tmp_path, {1: "fails", 3: "fails"}, STEP)
    assert bench.run().status == "completed"
    told = bench.operator.told
    first, third = (i for i, line in enumerate(told) if "could not be analysed" in line)
    assert told[first].startswith("h_001 could not be analysed: the image cannot be decoded")
    assert "take it again from the same place" in told[third]
    assert "cm above the middle of the specimen" in told[first + 1], "where to begin, once more"
    assert told[third + 1].startswith("next: ")
    assert "cannot be decoded" in result(bench).result["not_used"]["h_003"]
