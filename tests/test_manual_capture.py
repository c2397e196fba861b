"""Step kind `manual_capture` on the rig in memory: a person follows the words; what becomes of each image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.interfaces import CameraSettings
from service.compute.hand_view import HandView
from service.compute.planning.information import ViewInformation
from service.core.geometry import Array, inverse
from service.core.model import CaptureAsked, StepFailed, StepMeasured, ViewHeld
from service.store.store import Store
from service.worker.loop import work
from simulators.hand import Grip, follow
from tests.support.bench_rig import BenchRig, ScriptedOperator, answer
from tests.support.bench_run import PROTOCOL, Bench, begin_run
from tests.test_live import MEASURED, SPHERES_M, BenchCt, MeasuringRig, camera

STEP = """\
  - id: capture
    kind: manual_capture
    title: Capture
    params:
      purpose: dataset
      min_images: 6
      calibration: camera
      spheres_of: [ct]
      hemisphere:
        - {tilt_deg: 10, count: 2, distance_m: 0.66}
        - {tilt_deg: 30, count: 5, distance_m: 0.66}
      wait_s: 600
    gates:
      - {measure: images_used, min: 6}
      - {measure: hemisphere_coverage, min: 0.9}
      - {measure: predicted_target_error_mm, max: 0.5, unit: mm}
    recovery: {retries: 0, wait_s: 0}
"""
MIDDLE_M = SPHERES_M.mean(axis=0)


@dataclass
class Person:
    """Goes where the words lead and presses the camera's button; `mishaps` by number of the press."""

    rig: BenchRig
    mishaps: dict[int, str] = field(default_factory=dict[int, str])
    grip: Grip = field(default_factory=lambda: Grip(MIDDLE_M + np.array([0.1, 0.0, 0.8])))
    views: list[tuple[Array, str]] = field(default_factory=list[tuple[Array, str]])
    presses: int = 0
    idle: bool = False

    def read(self, message: str) -> None:
        """What the screen says."""
        if not message.startswith("next: ") or self.idle:
            return
        self.presses += 1
        mishap = self.mishaps.get(self.presses, "")
        if mishap != "stays":
            self.grip = follow(message, self.grip, MIDDLE_M)
        self.views.append((self.grip.T_world_camera(), mishap))
        self.rig.shutter.pressed.append(CameraSettings(22.0, 1 / 50, 400) if mishap == "dial" else None)


@dataclass
class ReadingOperator(ScriptedOperator):
    """Hands what is told to a person."""

    person: Person | None = None

    def tell(self, message: str) -> None:
        super().tell(message)
        if self.person is not None:
            self.person.read(message)


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with Store.open(tmp_path / "data") as opened:
        yield lambda text: begin_run(opened, text, tmp_path)


def held_run(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, folder: Path, mishaps: dict[int, str], step: str
) -> tuple[Bench, Person]:
    """A run of which a person takes the images; what they show follows from where the person held the camera."""
    head = PROTOCOL.split("  - id: capture\n")[0]
    bench = begin(head + MEASURED + step)
    rig = MeasuringRig()
    rig.suite = BenchCt(folder)
    bench.rig = rig
    person = Person(rig, mishaps)
    bench.operator = ReadingOperator(person=person)
    known: dict[str, Any] = {
        "calibrate": {"camera": asdict(camera(1200)), "T_flange_camera": np.eye(4).tolist(), "details": {}},
        "locate_spheres": {"spheres_m": SPHERES_M.tolist(), "details": {}},
    }

    def look(*_args: Any) -> HandView:
        T, mishap = person.views[len(bench.payloads(ViewHeld)) - 1]
        if mishap == "nothing":
            return HandView(None, None, 1, 0, 0, 2.0, 0.2, 0.0, "1 spheres found, which do not tell where it was")
        why = "blurred: outlines are 9.0 px wide; hold the camera still" if mishap == "blurred" else ""
        information = np.diag([4e8] * 3 + [4e6] * 3)
        return HandView(T, ViewInformation(information, np.zeros(6), 10), 10, 10, 10, 1.5, 0.1, 0.0, why)

    def serve(_what: str) -> None:
        job = bench.store.claim_job("test", 30, kinds=list(known))
        if job is not None:
            bench.store.finish_job(job, measures={}, duration_s=0.1, result=known[job.kind])
        work(bench.store, until_idle=True, stop=lambda: False, progress=lambda _what, _done, _total: None)

    monkeypatch.setattr("service.worker.hand.look_at_image", look)
    bench.operator.on_show = serve
    return bench, person


def result(bench: Bench) -> StepMeasured:
    return next(p for p in bench.payloads(StepMeasured) if p.step == "capture")


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


def test_a_first_image_that_cannot_be_used_does_no_harm(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, _ = held_run(begin, monkeypatch, tmp_path, {1: "blurred", 2: "nothing", 3: "nothing"}, STEP)
    assert bench.run().status == "completed"
    assert set(result(bench).result["not_used"]) == {"h_001", "h_002", "h_003"}
    assert len([line for line in bench.operator.told if "cm above the middle of the specimen" in line]) == 2


def test_a_repeated_image_is_told_apart(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, _ = held_run(begin, monkeypatch, tmp_path, {3: "stays"}, STEP)
    bench.run()
    assert result(bench).result["not_used"] == {"h_003": "it repeats h_002"}


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
            if shown[0] == 8:
                bench.ahead_s += 601.0
        serve(what)

    bench.operator.on_show = press
    bench.script("capture", "recovery", lambda question, _s: answer(question, "abort", reason="as planned"))
    bench.run()
    assert [view.released_by for view in bench.payloads(ViewHeld)] == ["pedal"]
    (failed,) = bench.payloads(StepFailed)
    assert "no image came within 600 s" in failed.message
    assert failed.error == "DeviceTimeoutError"


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
