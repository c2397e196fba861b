"""What an operator does while a run goes on: pause, abort, redo, skip, and the foot pedal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.interfaces import SafetyState
from service.core.records.run_events import ActionRefused, OperatorAction, StepNote, ViewpointCaptured
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.monitor.snapshot import Doing
from service.rig import CollisionSection, OpticsSection
from tests.support.rig.bench_rig import BenchRig, ScriptedOperator
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, say

# --- pause, abort, redo, skip ----------------------------------------------------------------------------


def test_pause_in_mid_motion_stops_the_arm_and_resume_goes_on_with_the_next_viewpoint(bench: Bench) -> None:
    seen: list[tuple[bool, int]] = []

    def pause(move: int) -> None:
        if move == 3:
            bench.rig.arm.dawdle()
            bench.act("pause")

    def paused(what: str) -> None:
        if what == "paused":
            seen.append((bench.rig.arm.is_moving(), bench.rig.arm.moves))
            if len(seen) == 5:
                bench.act("resume")

    bench.rig.arm.on_move, bench.operator.on_show = pause, paused
    assert bench.run().status == "completed"
    assert bench.rig.arm.stopped_short == 1
    assert seen == [(False, 3)] * 5
    assert bench.captured() == VIEWS


@dataclass
class Watching(ScriptedOperator):
    """Notes the progress that it is shown."""

    shown: list[tuple[str, int, int]] = field(default_factory=list[tuple[str, int, int]])

    def show(self, what: str, done: int, total: int) -> None:
        self.shown.append((what, done, total))
        super().show(what, done, total)


@dataclass
class PlanningRig(BenchRig):
    """A rig whose arm has kinematics that are known, so that its motion is planned."""

    def surroundings(self) -> tuple[CollisionSection, OpticsSection | None]:
        return CollisionSection(arm="UR10e"), None


@dataclass
class MistakenRig(BenchRig):
    """A rig whose file names another arm than stands there."""

    def surroundings(self) -> tuple[CollisionSection, OpticsSection | None]:
        return CollisionSection(arm="LBR Med 14"), None


def test_an_arm_that_is_not_the_one_of_the_rig_file_is_told_before_it_moves(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    bench.rig = MistakenRig()
    bench.operator.script = {("capture", "recovery"): [say("abort", reason="the rig file is wrong")]}
    assert bench.run().status == "aborted"
    (question,) = [asked for asked in bench.operator.asked if asked.for_ == "recovery"]
    assert "has 6 axes, and the rig file has the planner take it for a LBR Med 14 with 7" in question.text


def test_a_long_planning_shows_its_progress_and_heeds_pause(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("count: 4, distance_m: 0.6", "count: 400, distance_m: 0.6"))
    bench.rig, operator = PlanningRig(), Watching()
    bench.operator = operator

    def planning() -> list[tuple[int, int]]:
        words = "planning the motion: checking the viewpoints"
        return [(done, total) for what, done, total in operator.shown if what == words]

    def attended(_doing: Doing) -> None:
        bench.clock.passed_s += 1.0  # the main loop attends to buttons and devices again once the clock has gone on
        if len(planning()) == 3 and not bench.state().paused:
            bench.act("pause")

    def paused(what: str) -> None:
        if what == "paused":
            bench.act("abort", reason="seen enough")

    operator.on_attend, operator.on_show = attended, paused
    state = bench.run()
    assert (state.status, state.stop_reason) == ("aborted", "seen enough")
    assert planning() == [(0, 400), (16, 400), (32, 400), (48, 400)]
    assert bench.rig.arm.moves == 0


def test_abort_in_mid_motion_stops_the_arm_and_ends_the_run(bench: Bench) -> None:
    def abort(move: int) -> None:
        if move == 2:
            bench.rig.arm.dawdle()
            bench.act("abort", reason="someone stepped in")

    bench.rig.arm.on_move = abort
    state = bench.run()
    assert (state.status, state.stop_reason) == ("aborted", "someone stepped in")
    assert bench.rig.arm.stopped_short == 1
    assert not bench.rig.arm.is_moving()
    assert bench.captured() == VIEWS[:1]
    bench.must_verify()


def test_redo_of_a_viewpoint_while_the_arm_moves_takes_it_again_and_keeps_both(bench: Bench) -> None:
    bench.rig.arm.on_move = lambda move: (
        bench.act("redo", step="capture", viewpoint="v001", reason="fly on the lens") if move == 3 else None
    )
    state = bench.run()
    assert state.status == "completed"
    assert sorted(bench.captured()) == ["v001", *VIEWS]
    assert [(s.viewpoint, s.reason) for s in state.superseded] == [("v001", "fly on the lens")]
    assert set(state.steps["capture"].captured) == set(VIEWS)
    assert state.steps["capture"].measures["viewpoints_captured"] == 4


def test_redo_of_a_step_while_the_arm_moves_stops_it_and_begins_again(bench: Bench) -> None:
    def redo(move: int) -> None:
        if move == 3:
            bench.rig.arm.dawdle()
            bench.act("redo", step="capture", reason="the lamp moved")

    bench.rig.arm.on_move = redo
    state = bench.run()
    assert state.status == "completed"
    assert bench.rig.arm.stopped_short == 1
    assert bench.captured() == [*VIEWS[:2], *VIEWS]
    assert {c.attempt for c in bench.payloads(ViewpointCaptured)[2:]} == {2}
    assert [(s.step, sorted(s.captured)) for s in state.superseded] == [("capture", VIEWS[:2])]


def test_an_image_is_recorded_once_the_arm_is_on_its_way_to_the_next(bench: Bench) -> None:
    recorded: list[int] = []
    bench.rig.arm.on_move = lambda _move: recorded.append(len(bench.captured()))
    assert bench.run().status == "completed"
    assert recorded == [0, 0, 1, 2]
    assert bench.captured() == VIEWS


def test_an_image_that_has_arrived_is_recorded_though_the_next_motion_is_refused(bench: Bench) -> None:
    def stop(move: int) -> None:
        if move == 3:
            bench.rig.arm.safety = SafetyState.PROTECTIVE_STOP

    bench.rig.arm.on_move = stop
    bench.script("capture", "recovery", say("abort", reason="enough"))
    assert bench.run().status == "aborted"
    assert bench.captured() == VIEWS[:2]
    bench.must_verify()


def test_skip_needs_the_protocols_leave_and_a_reason(bench: Bench) -> None:
    bench.script("fixation", "confirm", say("skip"), say("skip", reason="fixed yesterday"))
    bench.script("capture", "confirm", say("skip", reason="no time"))
    state = bench.run()
    assert state.status == "completed"
    assert state.steps["fixation"].skipped
    assert [(d.kind, d.step) for d in state.deviations if d.kind != "automatic"] == [
        ("refused", "fixation"),
        ("skip", "fixation"),
        ("refused", "capture"),
    ]
    refused = bench.payloads(ActionRefused)
    assert "needs a reason" in refused[0].why
    assert "does not allow" in refused[1].why
    assert bench.captured() == VIEWS


def test_a_run_is_not_ended_by_somebody_who_does_not_say_why(bench: Bench) -> None:
    bench.script("fixation", "confirm", say("abort"), say("abort", reason="the specimen fell"))
    state = bench.run()
    assert (state.status, state.stop_reason) == ("aborted", "the specimen fell")
    (refused,) = bench.payloads(ActionRefused)
    assert "abort needs a reason" in refused.why
    assert any("abort needs a reason" in line for line in bench.operator.told)
    bench.must_verify()


def test_a_record_of_a_version_in_which_nobody_had_to_say_why_ends_its_run(bench: Bench) -> None:
    bench.rig.arm.on_move = lambda move: bench.act("abort") if move == 2 else None
    state = bench.run()
    assert (state.status, state.stop_reason) == ("aborted", "aborted by Grace")
    assert bench.captured() == VIEWS[:1]
    bench.must_verify()


def test_a_confirmation_without_all_ticks_is_refused_and_recorded(bench: Bench) -> None:
    bench.script("fixation", "confirm", say("confirm", checklist=("wires hold",)))
    assert bench.run().status == "completed"
    (refused,) = bench.payloads(ActionRefused)
    assert "board lies" in refused.why
    assert any("board lies" in line for line in bench.operator.told)


def test_an_irreversible_step_waits_for_its_captures_and_a_signature(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("recovery: {retries: 2", "skippable: true\n    recovery: {retries: 2"))
    bench.script("capture", "confirm", say("skip", reason="no time"))
    bench.script(
        "spraying",
        "recovery",
        say("confirm"),
        say("sign", meaning="go"),
        say("redo", step="capture", reason="it is needed after all"),
    )
    # After the captures: a confirmation without signature, a signature of the wrong thing, then the right one.
    bench.script("spraying", "sign", say("confirm"), say("sign", signed_sha256="0" * 64))
    state = bench.run()
    assert state.status == "completed"
    whys = [refused.why for refused in bench.payloads(ActionRefused)]
    assert len(whys) == 4
    assert "not passed: capture" in whys[0]
    assert "signature first" in whys[2]
    assert "a record other than" in whys[3]
    (note,) = bench.payloads(StepNote)
    assert note.note.startswith("Blue applied")
    assert state.steps["spraying"].signed_by == "Ada"


# --- the pedal -------------------------------------------------------------------------------------------


def test_the_pedal_confirms_what_is_asked_now_and_nothing_that_is_asked_later(bench: Bench) -> None:
    box = bench.rig.box
    assert box is not None

    def press(_question: AskOperator, _state: RunState) -> None:
        box.presses += 1

    silent = 0

    def nothing(_question: AskOperator, _state: RunState) -> OperatorAction | None:
        nonlocal silent
        silent += 1
        return None

    bench.script("fixation", "confirm", nothing, press)
    # Presses of the pedal while the robot works do not answer the next question.
    bench.rig.arm.on_move = lambda _move: press(bench.operator.asked[-1], bench.state())
    bench.script("spraying", "confirm", nothing, nothing)
    assert bench.run().status == "completed"
    confirmed = [a for a in bench.payloads(OperatorAction) if a.action == "confirm"]
    assert [(a.step, a.via) for a in confirmed] == [("fixation", "pedal"), ("capture", "cli"), ("spraying", "cli")]
    assert confirmed[0].checklist == ("wires hold", "board lies")
    assert silent == 3


def test_where_the_robot_will_move_the_pedal_is_pressed_twice_within_seconds(bench: Bench) -> None:
    box = bench.rig.box
    assert box is not None

    def press(_question: AskOperator, _state: RunState) -> None:
        box.presses += 1

    def look(_question: AskOperator, _state: RunState) -> None:
        bench.clock.passed_s += 0.3
        assert not bench.rig.arm.moves

    # The second press comes too late and arms again, the third bounces, the fourth counts.
    late, in_time = [look] * 16, [look] * 5
    bench.script("capture", "confirm", look, press, *late, press, press, *in_time, press)
    assert bench.run().status == "completed"
    confirmed = [a for a in bench.payloads(OperatorAction) if a.step == "capture"]
    assert [(a.action, a.via) for a in confirmed] == [("confirm", "pedal")]
    assert ("asking", True) in bench.operator.attended
    assert sum("press again" in line for line in bench.operator.told) == 3


def test_a_run_without_a_light_box_works(bench: Bench) -> None:
    bench.rig.box = None
    assert bench.run().status == "completed"
    assert bench.payloads(ViewpointCaptured)[0].environment == {}
