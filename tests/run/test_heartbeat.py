"""What screens show of the robot during a long call of the runner's main loop: the activity, and since when."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Mapping
from math import inf
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import RobotArm, RobotSample, SafetyState
from service.core.run.state import RunState
from service.monitor.reporter import OpenDevices, Reporter
from service.monitor.snapshot import STALE_S, Snapshot, read_snapshot, write_snapshot
from service.web.robot_banner import Banner, robot_banner
from tests.support.pages.web import web_site
from tests.support.processes.waiting import until
from tests.support.record.stepped_clock import SteppedClock
from tests.support.rig.bench_lightbox import BenchLightbox
from tests.support.rig.bench_rig import BenchArm, BenchRig
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

RUN = "run"


class Bench:
    """A reporter on a folder, and its output. Its threads wait for the time that the test lets pass."""

    def __init__(self, folder: Path, robots: Mapping[str, RobotArm], clock: SteppedClock) -> None:
        self.folder, self.clock = folder, clock
        self.reporter = Reporter(
            folder, RUN, lambda: OpenDevices(robots=robots), BenchRig().camera_named, clock=clock
        )

    @property
    def told(self) -> Snapshot:
        return read_snapshot(self.folder, RUN, self.clock.utc_s())

    def becomes(self, condition: Callable[[Snapshot], bool]) -> Snapshot:
        """Let time pass until what is told is so and not stale; return that."""
        told = self.told

        def so() -> bool:
            nonlocal told
            self.clock.sleep(0.25)
            told = self.told
            return not told.stale(self.clock.utc_s()) and condition(told)

        until(so, lambda: str(told), every_s=0.01)
        return told


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def arm(clock: SteppedClock) -> BenchArm:
    arm = BenchArm(clock=clock)
    arm.open()
    return arm


@pytest.fixture
def bench(tmp_path: Path, arm: BenchArm, clock: SteppedClock) -> Generator[Bench]:
    bench = Bench(tmp_path, {"robot": arm}, clock)
    bench.reporter.begin()
    yield bench
    bench.reporter.end()


@pytest.fixture
def active(tmp_path: Path) -> Generator[RunState]:
    with bench_store(tmp_path / "data") as store:
        yield begin_run(store, PROTOCOL, tmp_path).state()


NOW_S = 1.8e9


def banner(state: RunState, **fields: object) -> Banner:
    """The banner for a snapshot of this moment."""
    return robot_banner(state, Snapshot.model_validate({"at_utc_s": NOW_S, **fields}), NOW_S, driven=True)


def test_a_long_call_is_told_while_it_lasts(bench: Bench) -> None:
    bench.reporter.attend("working", "capture", 1)
    bench.reporter.show("viewpoints", 12, 54)
    bench.reporter.busy("taking v1_013 and fetching it from the camera, 61 MP")
    # This thread is the runner's and does not return to the reporter from here on.
    first = bench.becomes(lambda told: told.lasting == "taking v1_013 and fetching it from the camera, 61 MP")
    assert (first.doing, first.robot, first.done, first.total) == ("working", "standing", 12, 54)
    bench.becomes(lambda told: told.activity_s > first.activity_s + 1)
    bench.reporter.attend("working", "capture", 1)
    bench.becomes(lambda told: told.activity == "")


def test_a_call_of_which_nothing_was_said_is_seen_to_last(bench: Bench) -> None:
    bench.reporter.attend("working", "capture", 1)
    bench.becomes(lambda told: told.quiet_s > 2 and told.age_s(bench.clock.utc_s()) < 2)


def test_the_arm_is_watched_from_beside_the_call(bench: Bench, arm: BenchArm) -> None:
    bench.reporter.attend("working", "capture", 1)
    assert bench.told.robot == "standing"
    target = np.array([0.9, 0.4, 0.5, 0.0, 3.0, 0.0])
    arm.move_joints(target, speed_rad_s=1.0, acceleration_rad_s2=1.0)
    arm.dawdle()
    bench.becomes(lambda told: told.robot == "moving")
    arm.stop()
    bench.becomes(lambda told: told.robot == "standing")
    arm.safety = SafetyState.EMERGENCY_STOP
    bench.becomes(lambda told: told.robot == "emergency_stop")


class HeldUp(BenchArm):
    """Its process is in a long call of the main loop: other callers wait."""

    def __init__(self, clock: SteppedClock) -> None:
        super().__init__(clock=clock)
        self.free = threading.Event()

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        self.free.wait()
        return super().samples(start_monotonic_s, end_monotonic_s)


def test_an_arm_that_does_not_answer_holds_nothing_up_and_gets_old(
    tmp_path: Path, active: RunState, clock: SteppedClock
) -> None:
    arm = HeldUp(clock)
    arm.open()
    bench = Bench(tmp_path, {"robot": arm}, clock)
    bench.reporter.begin()
    try:
        bench.reporter.attend("working", "capture", 1)
        bench.reporter.busy("connecting the robot")
        told = bench.becomes(lambda told: told.robot_silent_s > STALE_S)
        shown = robot_banner(active, told, clock.utc_s(), driven=True)
        assert shown.key == "unknown"
        assert "not been heard of for" in shown.text
        assert "connecting the robot, for" in shown.text
        arm.free.set()
        bench.becomes(lambda told: told.robot_silent_s < STALE_S and told.robot == "standing")
    finally:
        arm.free.set()
        bench.reporter.end()
    assert bench.told.doing == "ended"


@pytest.mark.parametrize("by_s", [-3600.0, 3600.0])
def test_a_clock_that_is_set_changes_no_time_for_which_something_lasts(
    bench: Bench, clock: SteppedClock, by_s: float
) -> None:
    bench.reporter.attend("working", "capture", 1)
    bench.reporter.busy("fetching the photograph")
    clock.sleep(20.0)
    clock.set_utc(by_s)
    clock.sleep(20.0)
    bench.reporter.beat()
    told = bench.told
    assert told.quiet_s == pytest.approx(40.0)
    assert told.activity_s == pytest.approx(40.0)
    assert told.unattended_s(clock.utc_s()) == pytest.approx(40.0)


def test_a_runner_that_fell_silent_before_the_clock_was_set_back_is_silent(tmp_path: Path, active: RunState) -> None:
    write_snapshot(tmp_path, RUN, Snapshot(at_utc_s=NOW_S, doing="working", robot="moving"))
    told = read_snapshot(tmp_path, RUN, NOW_S - 3600.0)
    assert told.unattended_s(NOW_S - 3600.0) == inf
    shown = robot_banner(active, told, NOW_S - 3600.0, driven=True)
    assert shown.key == "unknown"
    assert "not told anything since the clock was set back" in shown.text


def test_an_arm_whose_link_is_dead_is_unknown(bench: Bench, arm: BenchArm, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.reporter.attend("working", "capture", 1)

    def dead(_start_s: float, _end_s: float) -> tuple[RobotSample, ...]:
        raise DeviceUnavailableError("no link", where="arm")

    monkeypatch.setattr(arm, "samples", dead)
    bench.becomes(lambda told: told.robot == "unknown")


def test_the_banner_says_what_goes_on_and_for_how_long(active: RunState) -> None:
    now_s = NOW_S
    taking = {"activity": "taking v1_013 and fetching it from the camera, 61 MP", "activity_utc_s": now_s - 12}
    busy = {"doing": "working", "attended_utc_s": now_s - 12, "robot_utc_s": now_s - 1, "robot": "standing", **taking}
    shown = banner(active, **busy)
    assert (shown.key, shown.title) == ("standing", "The robot stands still.")
    assert "taking v1_013 and fetching it from the camera, 61 MP, for 12 s" in shown.text
    assert "hears no button before that is done" in shown.text
    hung = banner(active, **{**busy, "activity": "", "what": "looking for the board", "attended_utc_s": now_s - 95})
    assert "looking for the board, for 95 s" in hung.text
    assert banner(active, **{**busy, "robot": "emergency_stop"}).key == "emergency_stop"
    assert banner(active, **{**busy, "robot_utc_s": now_s - 12}).key == "unknown"
    assert banner(active, **{**busy, "robot": "moving"}).key == "moving"
    quick = banner(active, **{**busy, "attended_utc_s": now_s, "activity": ""})
    assert quick.text == "A step is under way. It may move at any moment."


def test_a_run_that_has_just_been_started_says_so(tmp_path: Path, active: RunState) -> None:
    shown = banner(active, doing="starting")
    assert shown.key == "starting"
    assert "asks before it does" in shown.text
    write_snapshot(tmp_path, RUN, Snapshot(at_utc_s=NOW_S, doing="starting"))
    assert read_snapshot(tmp_path, RUN, NOW_S + 30).doing == "starting"
    silent = read_snapshot(tmp_path, RUN, NOW_S + 300)
    assert "not told anything for 300 s" in robot_banner(active, silent, NOW_S + 300, driven=True).text


def test_a_runner_that_is_started_is_told_of_at_once(tmp_path: Path) -> None:
    from service.web.site import Launcher  # noqa: PLC0415 - web_site puts a launcher in its place that starts nothing

    with web_site(tmp_path) as web:
        run_id = web.begin_run().run_id
        launcher = Launcher(web.site.data, web.store)
        launcher.start(run_id)
        try:
            assert launcher.driven(run_id)
            assert read_snapshot(web.site.data, run_id, web.now_utc_s).doing != "unknown"
        finally:
            children = vars(launcher)["_children"]
            children[run_id].terminate()
            children[run_id].wait(60)


def test_the_runner_says_what_it_is_about_to_do(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        run = begin_run(store, PROTOCOL, tmp_path)
        run.run()
        said = run.operator.busy_with
    assert said.count("setting the camera") >= 1
    taken = [what for what in said if what.startswith("taking ")]
    assert taken[0] == "taking v001 and fetching it from the camera"
    assert taken[1].startswith("taking v002 and fetching it from the camera, ")
    assert taken[1].endswith(" MP")
    assert "signing the record" in said


def test_the_signal_tower_shows_how_the_run_stands(tmp_path: Path, arm: BenchArm, clock: SteppedClock) -> None:
    box = BenchLightbox()
    devices = OpenDevices(robots={"robot": arm}, lightboxes={"box": box})
    reporter = Reporter(tmp_path, RUN, lambda: devices, BenchRig().camera_named, clock=clock)
    reporter.attend("working", "capture", 1)
    reporter.attend("asking", "capture", 1, asks="recovery", words="Capture: no link")
    assert read_snapshot(tmp_path, RUN, clock.utc_s()).standing == "stopped"
    reporter.attend("asking", "spraying", 1, asks="sign", words="Spray: a signature is due")
    reporter.attend("working", "spraying", 1)
    arm.safety = SafetyState.PROTECTIVE_STOP
    reporter.attend("working", "spraying", 2)
    reporter.end()
    assert [light.value for light in box.shown] == ["GREEN", "RED", "YELLOW", "GREEN", "RED", "OFF"]


def test_of_two_arms_the_one_that_moves_is_told(tmp_path: Path, clock: SteppedClock) -> None:
    """The first one stands, and the banner said that the robot stands still."""
    first, second = BenchArm(clock=clock), BenchArm(clock=clock)
    for arm in (first, second):
        arm.open()
    bench = Bench(tmp_path, {"first": first, "second": second}, clock)
    second.move_joints(np.array([0.9, 0.4, 0.5, 0.0, 3.0, 0.0]), speed_rad_s=1.0, acceleration_rad_s2=1.0)
    second.dawdle()
    bench.reporter.attend("working", "capture", 1)
    assert (bench.told.robot, bench.told.robot_name) == ("moving", "second")
    first.safety = SafetyState.PROTECTIVE_STOP
    bench.reporter.attend("asking", "capture", 1)
    assert (bench.told.robot, bench.told.robot_name) == ("protective_stop", "first")


def test_what_a_device_told_before_it_was_closed_is_not_its_present_state(
    tmp_path: Path, clock: SteppedClock
) -> None:
    boxes = {"box": BenchLightbox(clock=clock)}
    devices = OpenDevices(lightboxes=boxes)
    reporter = Reporter(tmp_path, RUN, lambda: devices, BenchRig().camera_named, clock=clock)
    reporter.attend("working", "capture", 1)
    assert read_snapshot(tmp_path, RUN, clock.utc_s()).light_lux == 812.0
    devices = OpenDevices()
    reporter.attend("asking", "capture", 1)
    told = read_snapshot(tmp_path, RUN, clock.utc_s())
    assert (told.light_lux, told.temperature_c) == (None, None)


def test_a_computer_that_is_too_busy_is_said_to_be(active: RunState) -> None:
    told = {"doing": "working", "robot": "standing", "attended_utc_s": NOW_S - 40, "what": "planning the motion"}
    waits = banner(active, **told, robot_utc_s=NOW_S, starved_s=30)
    assert "planning the motion, for 40 s, of which it waited 30 s for a processor" in waits.text
    assert "for a processor" not in banner(active, **told, robot_utc_s=NOW_S, starved_s=1).text


def test_a_step_that_computes_is_not_said_to_move_the_robot(active: RunState) -> None:
    fields = {"at_utc_s": NOW_S, "doing": "working", "robot": "standing", "attended_utc_s": NOW_S}
    shown = robot_banner(active, Snapshot.model_validate(fields), NOW_S, driven=True, moves=False)
    assert shown.text.startswith("A step is under way. This step does not move it.")
    assert "may move" not in shown.text
