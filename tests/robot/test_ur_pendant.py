"""What a person does at the pendant of a simulated controller, on its wires and through the driver."""

from __future__ import annotations

import socket
from collections.abc import Generator

import numpy as np
import pytest

from drivers.errors import DeviceRefusedError, LeaveNeededError, ToolChangedError
from drivers.interfaces import RobotArm, SettleCriteria
from service.core.geometry import inverse
from tests.support.arms.ur_driver import (
    PAYLOAD,
    SPEED_UP,
    T_FLANGE_TCP,
    let_move,
    move,
    opened,
    travel,
    turned,
    wait_for,
)
from tests.support.arms.ur_simulator import address, pendant, simulated_ur
from tests.support.vendor.ur_rtde_protocol import RtdeClient

FIELDS = [
    "actual_q", "target_qd", "actual_TCP_pose", "tcp_offset", "payload", "payload_cog", "target_speed_fraction",
    "runtime_state", "robot_mode", "safety_mode",
]  # fmt: skip
HOST = address(87)
TCP = "tcp 0.01 0.02 0.2 0 0 0.1"


@pytest.fixture(scope="module")
def robot() -> Generator[RobotArm]:
    with simulated_ur(HOST, "--speed-up", SPEED_UP), opened(HOST) as arm:
        arm.configure(PAYLOAD, T_FLANGE_TCP)
        yield arm


def test_the_acts_are_seen_on_rtde_as_a_controller_sends_them(robot: RobotArm) -> None:
    client = RtdeClient(HOST)
    client.output_setup(FIELDS, 125.0)
    client.start()
    before = client.data()
    assert before["tcp_offset"][:3] == pytest.approx(T_FLANGE_TCP[:3, 3])

    pendant(HOST, TCP, "payload 3 0 0 0.1", "slider 40")
    # Packages from before may still be on the way: on a busy machine, dozens.
    wait_for(lambda: client.data()["target_speed_fraction"] == (0.4,))
    now = client.data()
    assert now["tcp_offset"] == pytest.approx((0.01, 0.02, 0.2, 0.0, 0.0, 0.1))
    assert now["actual_TCP_pose"] != before["actual_TCP_pose"]
    assert (now["payload"], now["payload_cog"], now["target_speed_fraction"]) == ((3.0,), (0.0, 0.0, 0.1), (0.4,))
    assert now["runtime_state"] == (2,)
    assert now["actual_q"] == pytest.approx(before["actual_q"], abs=1e-6)

    pendant(HOST, "push 0 0 0.05 0 0 0 0.02")
    wait_for(lambda: client.data()["actual_q"][2] > before["actual_q"][2] + 0.0499)
    assert client.data()["target_qd"] == (0.0,) * 6, "nothing is commanded"
    assert client.data()["runtime_state"] == (2,), "the program runs on"

    pendant(HOST, "freedrive 0 0 -0.05 0 0 0 0.02")
    wait_for(lambda: client.data()["actual_q"][2] < before["actual_q"][2] + 0.0001)
    free = client.data()
    assert (free["runtime_state"], free["robot_mode"], free["safety_mode"]) == ((1,), (7,), (1,))
    pendant(HOST, "program other.urp")
    wait_for(lambda: client.data()["runtime_state"] == (2,))
    pendant(HOST, "slider 100", "stop")
    client.close()


def test_nonsense_is_refused(robot: RobotArm) -> None:
    with socket.create_connection((HOST, 30090)) as connection, connection.makefile("rw") as lines:
        for order in ("", "tcp 1 2", "tcp a b c d e f", "push 1 2 3 4 5 6 nan", "payload 99 0 0 0", "dance"):
            lines.write(order + "\n")
            lines.flush()
            assert lines.readline().startswith("no: push"), order


def restored(arm: RobotArm) -> None:
    """Bring the arm back to where a test may begin, as a run does for a person who has confirmed."""
    arm.open()
    let_move(arm)
    arm.configure(PAYLOAD, T_FLANGE_TCP)


def test_a_tool_changed_at_rest_is_refused_by_name_and_set_again(robot: RobotArm) -> None:
    restored(robot)
    before = robot.state().sample
    assert before.T_flange_tcp is not None
    np.testing.assert_allclose(before.T_flange_tcp, T_FLANGE_TCP, atol=1e-6)
    assert before.payload == PAYLOAD
    pendant(HOST, TCP)
    wait_for(lambda: any("the tool centre point was changed" in said for said in robot.report().problems))
    for refused in (
        lambda: move(robot, turned(robot, 0.1)),
        lambda: robot.solve_ik(before.T_base_flange, before.joints_rad),
        lambda: robot.settle(SettleCriteria()),
        lambda: robot.samples(before.monotonic_s - 1.0, before.monotonic_s),
        lambda: robot.let_move("Ada", before.monotonic_s),
    ):
        with pytest.raises(ToolChangedError, match="the tool centre point was changed"):
            refused()
    sample = robot.state().sample
    np.testing.assert_allclose(sample.T_base_flange, before.T_base_flange, atol=1e-6)
    assert sample.T_flange_tcp is not None
    assert np.linalg.norm((inverse(sample.T_flange_tcp) @ T_FLANGE_TCP)[:3, 3]) > 0.09
    let_move(robot)
    again = robot.state().sample
    assert again.T_flange_tcp is not None
    np.testing.assert_allclose(again.T_flange_tcp, T_FLANGE_TCP, atol=1e-6)
    travel(robot, turned(robot, 0.05))


def test_a_tool_changed_in_motion_is_told_while_it_moves(robot: RobotArm) -> None:
    restored(robot)
    start = robot.state().sample.joints_rad[0]
    move(robot, turned(robot, 2.0))
    wait_for(lambda: robot.state().sample.joints_rad[0] - start > 0.05)
    pendant(HOST, TCP)
    with pytest.raises(ToolChangedError):
        wait_for(lambda: not robot.is_moving())
    robot.stop()
    assert robot.state().sample.joints_rad[0] - start < 1.9, "it was told on the way"
    let_move(robot)
    travel(robot, turned(robot, start - robot.state().sample.joints_rad[0]))


def test_a_changed_payload_is_refused_by_name(robot: RobotArm) -> None:
    restored(robot)
    pendant(HOST, "payload 4 0 0 0.08")
    with pytest.raises(ToolChangedError, match=r"the payload was changed from 1\.6 kg to 4 kg"):
        wait_for(lambda: robot.settle(SettleCriteria(window_s=0.0)).samples < 0)
    let_move(robot)
    assert robot.state().sample.payload == PAYLOAD


@pytest.mark.parametrize("act", ["freedrive 0 0 0.01 0 0 0 0.02", "program other.urp", "stop"])
def test_a_program_ended_at_the_pendant_holds_the_arm(robot: RobotArm, act: str) -> None:
    restored(robot)
    pendant(HOST, act)
    wait_for(lambda: any("ended at the controller" in said for said in robot.report().problems))
    for _ in range(2):
        with pytest.raises(LeaveNeededError, match="ended at the controller"):
            move(robot, turned(robot, 0.01))


def test_a_foreign_program_is_neither_commanded_nor_ended(robot: RobotArm) -> None:
    """The driver waited for its answer until its process was killed."""
    restored(robot)
    pendant(HOST, "program other.urp")
    wait_for(lambda: not robot.state().program_running)
    wait_for(lambda: robot.state().program_running)
    let_move(robot)
    for _ in range(2):
        with pytest.raises(DeviceRefusedError, match="another program runs at the controller"):
            move(robot, turned(robot, 0.01))
    assert robot.state().program_running
    pendant(HOST, "stop")
    wait_for(lambda: not robot.state().program_running)
    let_move(robot)
    travel(robot, turned(robot, 0.01))
