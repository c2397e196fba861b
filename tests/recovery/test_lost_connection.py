"""An arm whose connection was lost counts as moving until a person has looked, however the connection ended."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    OperatorAction,
    RobotSeen,
    RunAborted,
    SessionStarted,
)
from service.core.run.decide import AskOperator
from service.core.run.state import RunState, connected_arms, lost_arms
from service.monitor.snapshot import Snapshot
from service.steps.context import ConnectionEnd
from service.web.robot_banner import Banner, LookAt, robot_banner
from tests.recovery.test_leave_to_move import restart, running
from tests.support.record.core import Log
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import PROTOCOL, Bench

NOW_S = 1.8e9
PROCESS = "driver process is not running: died of SIGKILL [robot]. Open the device again"
AS_MOVING = "It counts as moving until a person has looked"


def opened(device: str = "robot", kind: str = "robot") -> DeviceOpened:
    return DeviceOpened(device=device, report={"identity": {"kind": kind, "model": "Bench arm"}})


def trouble(connection: str, message: str = PROCESS, device: str = "robot") -> DeviceTrouble:
    return DeviceTrouble.model_validate(
        {"device": device, "error": "DeviceUnavailableError", "message": message, "connection": connection}
    )


def driving() -> Log:
    """A run whose arm is connected and has taken an image."""
    log = running()
    log.append(opened("camera", "camera"))
    log.append(opened())
    return log


def lost(connection: str = "died") -> Log:
    log = driving()
    log.append(trouble(connection))
    return log


def shown(state: RunState, *, driven: bool = True, **told: Any) -> Banner:
    snapshot = Snapshot.model_validate({"at_utc_s": NOW_S, "doing": "working", **told})
    return robot_banner(state, snapshot, NOW_S, driven=driven)


STALLED = "driver call state did not return within 30 s; its process was ended [robot]. Check the device"
ENDINGS: dict[str, Callable[[Log], object]] = {
    "its driver's process ended (died of SIGKILL)": lambda log: log.append(trouble("died")),
    "its driver no longer answered (driver call state did not return within 30 s; its process was ended)": (
        lambda log: log.append(trouble("stalled", STALLED))
    ),
    "the arm no longer answered its driver (no sample for 2 s)": lambda log: log.append(
        trouble("broken", "no sample for 2 s [10.0.0.1]. Check the cable")
    ),
    "the program that drives the run ended": restart,
}
NOW = ("standing", "not_connected", "unknown", "moving")


@pytest.mark.parametrize("how", ENDINGS)
@pytest.mark.parametrize("robot", NOW)
def test_after_every_end_of_a_connection_it_is_said_since_when_and_that_it_counts_as_moving(
    how: str, robot: str
) -> None:
    log = driving()
    ENDINGS[how](log)
    banner = shown(log.state, robot=robot, robot_name="robot")
    assert f"The connection to robot was lost at 00:00:00 UTC, when {how}; nobody has looked at it since." in (
        banner.text
    )
    assert AS_MOVING in banner.text
    assert "Nothing has needed it so far" not in banner.text
    assert banner.title in ("Robot: take it as moving.", "The robot moves.")
    assert banner.tone != "standing"
    assert banner.look == (LookAt("robot", log.state.arms["robot"].loss.seq if log.state.arms["robot"].loss else -1),)


def test_a_new_connection_that_reports_a_standing_arm_is_said_and_changes_nothing() -> None:
    log = lost()
    log.append(opened())
    banner = shown(log.state, robot="standing")
    assert "It reports now that it stands still." in banner.text
    assert AS_MOVING in banner.text
    assert connected_arms(log.state) == ("robot",)


def test_it_stays_over_restarts_further_losses_and_the_end_of_the_run() -> None:
    log = lost()
    since_utc = lost_arms(log.state)["robot"].since_utc
    restart(log)
    log.append(opened())
    log.append(trouble("stalled"))
    assert lost_arms(log.state)["robot"].since_utc == since_utc, "since the first loss that nobody looked at"
    log.append(RunAborted(reason="enough"))
    banner = shown(log.state, driven=False, doing="ended", robot="unknown")
    assert banner.text.startswith("The run has ended. The connection to robot was lost at")
    assert banner.look


def test_the_act_of_a_person_ends_it_and_is_recorded() -> None:
    log = lost()
    seq = lost_arms(log.state)["robot"].seq
    log.append(RobotSeen(device="robot", lost_seq=seq), "Grace")
    assert not lost_arms(log.state)
    arm = log.state.arms["robot"]
    assert (arm.seen_by, arm.connected) == ("Grace", False)
    banner = shown(log.state, robot="not_connected")
    assert banner.text.startswith("The connection to robot was lost at 00:00:00 UTC; Grace looked at it at 00:00:00")
    assert not banner.look


def test_a_look_answers_the_loss_that_was_shown_and_no_later_one() -> None:
    log = lost()
    seq = lost_arms(log.state)["robot"].seq
    log.append(opened())
    log.append(trouble("broken"))
    log.append(RobotSeen(device="robot", lost_seq=seq), "Grace")
    assert lost_arms(log.state)
    log.append(RobotSeen(device="another", lost_seq=seq), "Grace")
    log.append(RobotSeen(device="robot", lost_seq=0), "Grace")
    assert lost_arms(log.state)


def test_who_lets_the_robot_move_was_asked_to_look_and_has() -> None:
    log = lost()
    restart(log)
    assert "Look at robot first: the connection to it was lost at 00:00:00 UTC" in log.question.text
    assert "which you say with your confirmation" in log.question.text
    log.act("confirm", actor="Grace", step="capture")
    assert not lost_arms(log.state)
    assert log.state.arms["robot"].seen_by == "Grace"


def test_a_confirmation_where_nothing_moves_is_no_look() -> None:
    log = Log()
    log.append(SessionStarted(resumed=False, software={}, host="h", pid=1))
    log.append(opened())
    log.append(trouble("died"))
    assert not log.protocol.step(log.state.current).moves_robot
    log.confirm()
    assert lost_arms(log.state)


def test_a_program_that_ended_is_told_before_it_starts_again_and_can_be_looked_at_then() -> None:
    log = driving()
    gone = shown(log.state, driven=False, doing="unknown", robot="unknown")
    assert "The program that drove robot does not run; it was last heard from at" in gone.text
    assert AS_MOVING in gone.text
    assert gone.look == (LookAt("robot", 0),)
    starting = shown(log.state, doing="starting", robot="unknown")
    assert AS_MOVING in starting.text
    assert "It has moved nothing yet" not in starting.text
    log.append(RobotSeen(device="robot"), "Grace")
    restart(log)
    assert not lost_arms(log.state)
    assert "Grace looked at it" in shown(log.state, robot="not_connected").text


def test_an_end_by_a_person_while_the_program_was_dead_does_not_make_the_arm_safe() -> None:
    log = driving()
    log.append(OperatorAction(action="abort", reason="enough"), "Grace")
    killed = shown(log.state, driven=False, doing="unknown", robot="unknown")
    assert killed.text.startswith("The run has ended. The program that drove robot does not run")
    orderly = shown(log.state, driven=False, doing="ended", robot="unknown")
    assert (orderly.title, orderly.look) == ("The run has ended.", ())


def test_an_arm_that_cannot_be_connected_is_not_one_that_nothing_has_needed() -> None:
    log = running()
    assert "Nothing has needed it so far" in shown(log.state, robot="not_connected").text
    busy = "robot is used by process 4711 [robot 10.0.0.1]. End that program"
    log.append(trouble("refused", busy))
    banner = shown(log.state, robot="not_connected")
    assert banner.text.startswith("robot could not be connected at 00:00:00 UTC: robot is used by process 4711.")
    assert "Nothing has needed it" not in banner.text
    assert not lost_arms(log.state), "this run never had it"
    log.append(opened())
    assert "could not be connected" not in shown(log.state, robot="not_connected").text


def test_while_it_is_connected_again_nobody_is_told_that_nothing_needed_it() -> None:
    banner = shown(driving().state, robot="not_connected")
    assert "Take it as moving" in banner.text
    assert banner.tone == "unknown"


def test_the_command_line_says_it_too(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    bench.store.record(bench.run_id, [opened(), trouble("died")], actor="runner")
    at_utc = bench.store.events(bench.run_id)[-1].at_utc
    said = CliRunner().invoke(app, ["status", bench.run_id, "--data", str(bench.data)]).output
    assert "robot counts as moving until a person has looked" in said
    plain = CliRunner().invoke(app, ["status", bench.run_id, "--data", str(bench.data), "--json"]).output
    moving = json.loads(plain)["counts_as_moving"]
    assert moving == {"robot": {"since_utc": at_utc, "how": "when its driver's process ended (died of SIGKILL)"}}


def test_other_devices_are_no_arms() -> None:
    log = driving()
    log.append(trouble("", device="camera"))
    log.append(opened("table", "lightbox"))
    assert set(log.state.arms) == {"robot"}
    assert not lost_arms(log.state)


def test_of_two_arms_each_is_looked_at_for_itself() -> None:
    log = driving()
    log.append(opened("second"))
    restart(log)
    assert set(lost_arms(log.state)) == {"robot", "second"}
    banner = shown(log.state, robot="not_connected")
    assert len(banner.look) == 2
    log.append(RobotSeen(device="second", lost_seq=banner.look[0].lost_seq), "Grace")
    assert set(lost_arms(log.state)) == {"robot"}


def test_the_runner_records_the_loss_and_asks(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    seen: list[str] = []

    def drop(move: int) -> None:
        if move == 2:
            bench.rig.ended.append(ConnectionEnd("robot", "died", "DeviceUnavailableError", PROCESS))

    def attend(_doing: str) -> None:
        if lost_arms(bench.state()) and not seen:
            seen.append(shown(bench.state(), robot="standing").text)
            bench.act("pause")

    def look(_what: str) -> None:
        state = bench.state()
        if state.paused and lost_arms(state):
            seq = lost_arms(state)["robot"].seq
            bench.store.record(bench.run_id, [RobotSeen(device="robot", lost_seq=seq)], actor="Grace")
            bench.act("resume")

    bench.rig.arm.on_move = drop
    bench.operator.on_attend, bench.operator.on_show = attend, look
    assert bench.run().status == "completed"
    assert [one.connection for one in bench.payloads(DeviceTrouble)] == ["died"]
    assert AS_MOVING in seen[0]
    assert bench.state().arms["robot"].seen_by == "Grace"
    bench.must_verify()


def test_a_person_at_the_terminal_reads_it_in_the_question(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    questions: list[AskOperator] = []

    def confirm(question: AskOperator, _state: RunState) -> OperatorAction:
        questions.append(question)
        return answer(question, "confirm")

    bench.rig.ended.append(ConnectionEnd("robot", "stalled", "DeviceTimeoutError", "no answer within 30 s"))
    bench.operator.script = {("capture", "confirm"): [confirm]}
    assert bench.run().status == "completed"
    assert "Look at robot first" in questions[0].text
