"""`manual_capture` with a camera without a cable: a person follows the words, and photographs arrive as files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from drivers.photo_watch import PhotoWatch, PhotoWatchConfig
from service.core.records.run_events import CaptureAsked, OperatorAction, StepMeasured, ViewHeld, ViewpointFailed
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from simulators.hand.technician import follow
from tests.support.rig.bench_rig import BenchRig, answer
from tests.support.rig.card import photograph, put
from tests.support.runs.bench_run import Bench, begin_run, bench_store
from tests.support.runs.held_run import MIDDLE_M, STEP, Person, held_run


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as opened:
        yield lambda text: begin_run(opened, text, tmp_path)


@dataclass
class CardPerson(Person):
    """Takes photographs as the words say; another process copies them into the folder."""

    folder: Path = Path()
    watch: PhotoWatch | None = None
    began: datetime = field(init=False)  # start of the step by the camera's clock, from its first words on
    ahead: timedelta = timedelta()  # of the camera's clock before the host's

    def read(self, message: str) -> None:
        if not message.startswith("next: "):
            return
        self.rig.card = self.watch  # the robot's calibration images came through the cable
        self.presses += 1
        if self.presses == 1:
            self.began = self.rig.arm.clock.utc_now() + self.ahead
        mishap = self.mishaps.get(self.presses, "")
        if mishap == "copied twice":
            put(self.folder, f"DSC{self.presses - 1:05d} (1).JPG", self.file(self.presses - 1))
        if mishap == "old":
            put(self.folder, "DSC09999.JPG", photograph(99, self.began - timedelta(hours=2)))
        if mishap == "of the step before":
            put(self.folder, "DSC09999.JPG", photograph(99, self.began - timedelta(minutes=40)))
        self.grip = follow(message, self.grip, MIDDLE_M)
        self.views.append((self.grip.T_world_camera(), ""))
        put(self.folder, f"DSC{self.presses:05d}.JPG", self.file(self.presses, 400 if mishap == "dial" else 100))

    def file(self, number: int, iso: int = 100) -> bytes:
        """The file of one press."""
        return photograph(number, self.began + timedelta(seconds=number), iso=iso)


def card_run(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, folder: Path, mishaps: dict[int, str]
) -> tuple[Bench, CardPerson]:
    """The run of tests.support.runs.held_run with a folder as camera."""
    card = folder / "card"
    card.mkdir()

    def person(rig: BenchRig, mishaps: dict[int, str]) -> CardPerson:
        config = PhotoWatchConfig(folder=card, stable_s=0.05, stalled_s=5.0)
        watch = PhotoWatch(config, *by_the_clock_of(rig))
        watch.open()
        return CardPerson(rig, mishaps, folder=card, watch=watch)

    return held_run(begin, monkeypatch, folder, mishaps, STEP, person)


def by_the_clock_of(rig: BenchRig) -> tuple[Callable[[], float], Callable[[float], None]]:
    """Time and waiting by the clock that the rig will have: the store's, once the run goes on."""

    def monotonic_s() -> float:
        return rig.arm.clock.monotonic_s()

    def sleep(seconds: float) -> None:
        rig.arm.clock.sleep(seconds)

    return monotonic_s, sleep


def measured(bench: Bench) -> StepMeasured:
    return next(p for p in bench.payloads(StepMeasured) if p.step == "capture")


@pytest.mark.slow
def test_photographs_of_a_card_become_views_as_those_of_a_cable_do(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = card_run(begin, monkeypatch, tmp_path, {2: "dial", 4: "copied twice", 5: "old"})
    assert bench.run().status == "completed"
    views = bench.payloads(ViewHeld)
    assert [Path(view.found_at).name for view in views] == [f"DSC{n:05d}.JPG" for n in range(1, person.presses + 1)]
    assert {Path(view.found_at).parent for view in views} == {person.folder}
    assert {view.released_by for view in views} == {"elsewhere"}
    result = measured(bench)
    assert result.result["used"] == [view.viewpoint for view in views if view.viewpoint != "h_002"]
    assert "ISO 400" in result.result["not_used"]["h_002"]
    assert result.measures["hemisphere_coverage"] >= 0.9
    (left_out,) = bench.payloads(ViewpointFailed)
    assert "taken before this step began" in left_out.message
    bench.must_verify()


@pytest.mark.slow
def test_a_host_clock_that_was_set_back_lets_no_older_photograph_in(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = card_run(begin, monkeypatch, tmp_path, {3: "of the step before"})

    def set_back(question: AskOperator, _state: RunState) -> OperatorAction:
        person.ahead = timedelta(hours=1)  # the camera's clock is right
        bench.clock.set_utc(-3600.0)
        return answer(question, "confirm")

    bench.script("capture", "confirm", set_back)
    assert bench.run().status == "completed"
    assert "DSC09999.JPG" not in [Path(view.found_at).name for view in bench.payloads(ViewHeld)]
    (left_out,) = bench.payloads(ViewpointFailed)
    assert "taken before this step began" in left_out.message


@pytest.mark.slow
def test_after_a_restart_nothing_is_taken_twice_and_nothing_is_lost(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = card_run(begin, monkeypatch, tmp_path, {})
    serve = bench.operator.on_show

    def until_three(what: str) -> None:
        serve(what)
        if person.presses == 4:
            raise KeyboardInterrupt

    bench.operator.on_show = until_three
    with pytest.raises(KeyboardInterrupt):
        bench.run()
    assert len(bench.payloads(ViewHeld)) == 3
    bench.operator.on_show = serve
    assert isinstance(bench.rig.card, PhotoWatch)
    bench.rig.card.open()  # as the next process does; it finds all four in the folder
    assert bench.run().status == "completed"
    found = [Path(view.found_at).name for view in bench.payloads(ViewHeld)]
    assert found == [f"DSC{n:05d}.JPG" for n in range(1, person.presses + 1)]


def test_a_screen_that_asks_for_a_release_is_told_whose_button_counts(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, _ = card_run(begin, monkeypatch, tmp_path, {})
    serve, asked = bench.operator.on_show, [False]

    def press(what: str) -> None:
        if what == "waiting for the next image" and not asked[0]:
            asked[0] = True
            event = CaptureAsked.model_validate({"step": "capture", "attempt": 1, "what": "release"})
            bench.store.record(bench.run_id, [event], actor="Grace")
        serve(what)

    bench.operator.on_show = press
    assert bench.run().status == "completed"
    assert any("cannot release this camera" in line and "own button" in line for line in bench.operator.told)
    assert {view.released_by for view in bench.payloads(ViewHeld)} == {"elsewhere"}
