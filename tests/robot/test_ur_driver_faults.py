"""The Universal Robots driver on bad days: stops, refusals, lost connections and restarts of the controller."""

from __future__ import annotations

import contextlib
import os
import signal
import time

import pytest

from drivers.errors import (
    DeviceError,
    DeviceRefusedError,
    DeviceUnavailableError,
    LeaveNeededError,
    SafetyStopError,
)
from drivers.interfaces import RobotArm, SafetyState, SettleCriteria
from tests.support.arms.arm_watch import watched_arm
from tests.support.arms.ur_driver import (
    PAYLOAD,
    SPEED_UP,
    T_FLANGE_TCP,
    dashboard,
    faulty,
    let_move,
    move,
    opened,
    travel,
    turned,
    wait_for,
)
from tests.support.arms.ur_simulator import address, pendant, simulated_ur
from tests.support.vendor.ur_rtde_protocol import RtdeClient

STALE_S = 4.0  # of a stream that a test lets end, and far more than a busy machine holds one up


def test_protective_stop_is_surfaced_and_cleared_by_a_person_only() -> None:
    host = address(51)
    with faulty(51, {"on": "move", "nth": 2, "kind": "protective_stop", "value": 0.1}), opened(host) as arm:
        move(arm, turned(arm, 0.1))
        wait_for(lambda: not arm.is_moving())
        move(arm, turned(arm, 1.0))
        with pytest.raises(SafetyStopError, match="protective stop"):
            wait_for(lambda: not arm.is_moving())
        assert arm.state().sample.safety is SafetyState.PROTECTIVE_STOP
        with pytest.raises(SafetyStopError):
            move(arm, turned(arm, 0.1))
        assert any("protective stop" in p for p in arm.report().problems)

        arm.open()  # reconnecting does not help
        assert arm.state().sample.safety is SafetyState.PROTECTIVE_STOP
        with pytest.raises(SafetyStopError):
            arm.configure(PAYLOAD, T_FLANGE_TCP)

        def unlocked() -> bool:
            return dashboard(host, "close safety popup", "unlock protective stop")[1].startswith(
                "Protective stop rel"
            )

        with pytest.raises(SafetyStopError):
            let_move(arm)
        wait_for(unlocked)
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        with pytest.raises(SafetyStopError, match="nobody has confirmed since"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))


@pytest.mark.slow
def test_a_stop_that_came_and_was_released_between_two_motions_is_not_forgotten() -> None:
    host = address(62)
    # The plan causes the stop at a message that only this test sends: nobody queries the arm meanwhile.
    with faulty(62, {"on": "rtde_P", "kind": "protective_stop"}), opened(host) as arm, watched_arm(host) as watch:
        travel(arm, turned(arm, 0.1))
        client = RtdeClient(host)
        client.pause()
        client.close()
        begin = time.monotonic()

        def unlocked() -> bool:
            return dashboard(host, "unlock protective stop")[0].startswith("Protective stop rel")

        wait_for(unlocked)
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        over = time.monotonic()
        assert not arm.is_moving(), "nothing was cut short"
        since = watch.mark()
        for _ in range(3):
            with pytest.raises(SafetyStopError, match=r"was in protective stop .* nobody has confirmed since"):
                move(arm, turned(arm, 0.1))
        assert any("nobody has confirmed since" in problem for problem in arm.report().problems)
        with pytest.raises(SafetyStopError, match="nobody has confirmed since"):
            arm.let_move("Ada", begin)  # she confirmed before the stop was over
        watch.pass_s(0.5)
        assert watch.moved_for_s(since) == 0.0
        assert not watch.now.program_runs, "nothing is sent anew either"
        arm.let_move("Ada", over)
        travel(arm, turned(arm, 0.1))
        assert watch.moved_for_s(since) > 0.0


def test_a_motion_ended_at_the_controller_did_not_arrive_and_waits_for_a_person() -> None:
    host = address(63)
    with simulated_ur(host), opened(host) as arm, watched_arm(host) as watch:
        move(arm, turned(arm, 2.0))
        watch.wait_moving(0.5)
        dashboard(host, "stop")
        with pytest.raises(LeaveNeededError, match="ended at the controller"):
            wait_for(lambda: not arm.is_moving())
        since = watch.mark()
        with pytest.raises(LeaveNeededError, match="ended at the controller"):
            move(arm, turned(arm, 0.1))
        assert watch.moved_for_s(since) == 0.0
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_what_was_connected_anew_is_let_move_anew() -> None:
    with simulated_ur(address(64), "--speed-up", SPEED_UP), opened(address(64)) as arm:
        travel(arm, turned(arm, 0.1))
        arm.open()
        arm.configure(PAYLOAD, T_FLANGE_TCP)
        sample = arm.state().sample
        arm.solve_ik(sample.T_base_flange, sample.joints_rad)
        with pytest.raises(LeaveNeededError, match="nobody has let the arm move since it was connected"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_emergency_stop() -> None:
    host = address(52)
    with faulty(52, {"on": "move", "kind": "emergency_stop", "value": 0.5}), opened(host) as arm:
        move(arm, turned(arm, 2.5))
        with pytest.raises(SafetyStopError, match="emergency stop"):
            wait_for(lambda: not arm.is_moving())
        wait_for(lambda: switched_on(arm, host))  # as soon as the button is released
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        with pytest.raises(DeviceRefusedError, match="mode IDLE"):
            move(arm, turned(arm, 0.1))
        dashboard(host, "brake release")
        wait_for(lambda: arm.state().robot_mode == "RUNNING")
        with pytest.raises(SafetyStopError, match=r"emergency stop .* nobody has confirmed since"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def switched_on(arm: RobotArm, host: str) -> bool:
    dashboard(host, "power on")
    return arm.state().robot_mode == "IDLE"


def test_refused_motion_is_an_error_and_the_next_one_works() -> None:
    with faulty(53, {"on": "move", "kind": "reject"}), opened(address(53)) as arm:
        with pytest.raises(DeviceRefusedError, match="did not start the joint motion"):
            move(arm, turned(arm, 0.1))
        move(arm, turned(arm, 0.1))
        wait_for(lambda: not arm.is_moving())


def test_reconnect_after_the_controller_restarted() -> None:
    host = address(54)
    with contextlib.ExitStack() as stack:
        with simulated_ur(host, "--speed-up", SPEED_UP):
            arm = stack.enter_context(opened(host, stale_after_s=STALE_S))
            arm.state()
        with pytest.raises(DeviceUnavailableError):
            wait_for(lambda: not arm.state())
        with pytest.raises(DeviceUnavailableError):
            arm.open()
        with simulated_ur(host, "--speed-up", SPEED_UP):
            arm.open()
            let_move(arm)
            travel(arm, turned(arm, 0.1))
            arm.close()


def test_dropped_link_ends_in_an_error_and_a_reconnect() -> None:
    host = address(60)
    with faulty(60, {"on": "move", "kind": "drop"}), opened(host, stale_after_s=STALE_S) as arm:
        with pytest.raises(DeviceUnavailableError):
            travel(arm, turned(arm, 0.5))
        arm.open()
        let_move(arm)
        travel(arm, turned(arm, 0.1))


@pytest.mark.slow
def test_motion_that_ended_on_a_dead_stream_is_not_taken_for_an_arm_at_rest() -> None:
    drop: dict[str, object] = {"on": "move", "kind": "drop", "value": "receivers"}  # no samples; commands still pass
    with faulty(61, drop), opened(address(61), stale_after_s=STALE_S) as arm:
        with pytest.raises(DeviceUnavailableError, match="no new sample"):
            travel(arm, turned(arm, 0.1))
        arm.open()
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_stalled_stream_is_not_taken_for_a_still_arm() -> None:
    with faulty(55, {"on": "move", "kind": "stall"}), opened(address(55), stale_after_s=STALE_S) as arm:
        with pytest.raises(DeviceUnavailableError, match="no new sample"):
            travel(arm, turned(arm, 0.5))
        with pytest.raises(DeviceUnavailableError):
            arm.settle(SettleCriteria())


@pytest.mark.parametrize(("on", "server"), [("rtde_V", "RTDE"), ("dashboard_connect", "dashboard")])
def test_mute_server_does_not_hang_the_driver(on: str, server: str) -> None:
    with (
        faulty(56, {"on": on, "kind": "stall"}),
        pytest.raises(DeviceUnavailableError, match=rf"the {server} server did not answer within 3 s"),
        opened(address(56), connect_timeout_s=3.0),
    ):
        pass


def test_nobody_there() -> None:
    with pytest.raises(DeviceUnavailableError, match="RTDE server cannot be reached"), opened(address(57)):
        pass


def test_an_arm_in_local_control_is_watched_and_its_program_left_alone() -> None:
    """Nothing is commanded until the pendant is switched to Remote; then the arm moves without being opened again."""
    host = address(74)
    with simulated_ur(host, "--speed-up", SPEED_UP, "--local") as ready:
        pendant(host, "program technician.urp")
        wait_for(lambda: dashboard(host, "running") == ["Program running: true"])
        with opened(host) as arm:
            assert dashboard(host, "running") == ["Program running: true"]
            assert arm.state().program_running
            (problem,) = arm.report().problems
            assert "the controller is in local control" in problem
            with pytest.raises(DeviceRefusedError, match="local control") as refused:
                move(arm, turned(arm, 0.1))
            assert "from Local to Remote" in refused.value.remedy
            with pytest.raises(DeviceRefusedError, match="does not end its program: 'Command is not allowed"):
                arm.stop()
            assert dashboard(host, "running") == ["Program running: true"]
            os.kill(int(ready["pid"]), signal.SIGUSR1)
            wait_for(lambda: dashboard(host, "is in remote control") == ["true"])
            travel(arm, turned(arm, 0.1))
            assert arm.report().problems == ()
            # Back to Local while the script rests: it is not sent again, and the message says why.
            os.kill(int(ready["pid"]), signal.SIGUSR1)
            wait_for(lambda: dashboard(host, "is in remote control") == ["false"])
            pendant(host, "stop")
            wait_for(lambda: not arm.state().program_running)
            with pytest.raises(DeviceError, match=r"local control|was ended at the controller"):
                move(arm, turned(arm, 0.1))
            assert any("local control" in problem for problem in arm.report().problems)


@pytest.mark.parametrize("field", ["timestamp", "actual_q", "payload"])
def test_a_field_that_is_no_number_is_named_and_ends_the_stream(field: str) -> None:
    """bench/motion/arm_answers.py tries every field and every answer of the dashboard in every way."""
    spoilt, told = {"on": f"field {field}", "kind": "nan"}, f"sends no number for {field}"
    with faulty(78, spoilt), pytest.raises(DeviceUnavailableError, match=told), opened(address(78)):
        pass


def test_an_idle_controller_that_refuses_to_stop_is_opened() -> None:
    refusal = {"on": "dashboard stop", "kind": "say", "value": "Failed to execute: stop", "times": 9}
    with faulty(79, refusal), opened(address(79)) as arm:
        travel(arm, turned(arm, 0.1))
