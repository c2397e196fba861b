"""A controller's limits towards its clients: registers that somebody else uses, and clients that do not read."""

from __future__ import annotations

import os
import signal

import pytest

from drivers.errors import DeviceRefusedError, DeviceUnavailableError, LeaveNeededError
from drivers.host.hosted_device import HostedDevice
from drivers.interfaces import RobotArm
from tests.support.arms.arm_watch import watched_arm
from tests.support.arms.confirming import confirm_and
from tests.support.arms.ur_driver import SPEED_UP, move, opened, travel, turned
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.vendor.ur_rtde_protocol import RtdeClient


def test_registers_that_a_fieldbus_reserves_are_named_with_what_to_do() -> None:
    host = address(91)
    with simulated_ur(host, "--fieldbus"), pytest.raises(DeviceRefusedError) as refused, opened(host):
        pass
    assert "in use are input_int_register 0 to 23, input_double_register 0 to 23" in str(refused.value)
    assert "EtherNet/IP, PROFINET" in str(refused.value)
    assert "`upper_registers: true`" in str(refused.value)


def test_the_upper_registers_do_without_those_of_a_fieldbus() -> None:
    host = address(92)
    with simulated_ur(host, "--fieldbus", "--speed-up", SPEED_UP), opened(host, upper_registers=True) as arm:
        sample = arm.state().sample
        arm.solve_ik(sample.T_base_flange, sample.joints_rad)
        travel(arm, turned(arm, 0.1))


def test_a_register_that_another_program_writes_is_named() -> None:
    host = address(93)
    with simulated_ur(host):
        client = RtdeClient(host)
        client.negotiate()
        client.input_setup(["input_double_register_3"])
        with pytest.raises(DeviceRefusedError, match="in use are input_double_register 3"), opened(host):
            pass
        client.close()


# Fields of six numbers each, so that a client that does not read has soon filled the system's buffers.
MANY = [f"{of}_{what}" for of in ("actual", "target") for what in ("q", "qd", "current")]


def test_a_client_that_does_not_read_is_cut_off_and_others_are_not() -> None:
    host = address(94)
    with simulated_ur(host, "--cut-off", "0.5"):
        deaf, good = RtdeClient(host), RtdeClient(host)
        for client in (deaf, good):
            client.negotiate()
            client.output_setup(MANY * 4, 500.0)
            client.start()
        served = 0
        while served < 1200:
            good.receive()
            served += 1
        got: list[bool] = []

        def all_that_came() -> None:
            while len(got) < served:
                deaf.receive()
                got.append(True)

        with pytest.raises(ConnectionError):
            all_that_came()
        good.receive()
        good.close()
        deaf.close()


def pid_of(arm: RobotArm) -> int:
    device: HostedDevice = vars(arm)["hosted_device"]
    assert device.pid is not None
    return device.pid


IMPATIENT = {"watchdog_s": 1.0, "stale_after_s": 3.0, "unattended_s": 5.0, "rest_within_s": 1.5}


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("moving", [False, True])
def test_a_driver_that_was_cut_off_says_so_and_moves_again_only_for_a_person(moving: bool) -> None:
    """As on a machine that stood still for ten seconds: the arm comes to rest, and nothing goes on by itself."""
    host = address(95 + moving)
    rig = simulated_ur(host, "--cut-off", "0.5", patience_s=1.0)
    with rig, opened(host, **IMPATIENT) as arm, watched_arm(host) as watch:
        confirm_and(arm, lambda: travel(arm, turned(arm, 0.05)))
        if moving:
            confirm_and(arm, lambda: move(arm, turned(arm, 2.5)))
            watch.wait_moving(0.3)
        os.kill(pid_of(arm), signal.SIGSTOP)
        watch.wait_resting()
        since = watch.mark()
        watch.pass_s(8.0)  # in which the system's buffers are filled, and half a second more
        os.kill(pid_of(arm), signal.SIGCONT)
        for _ in range(3):
            with pytest.raises((LeaveNeededError, DeviceUnavailableError)):
                move(arm, turned(arm, 0.1))
        arm.open()
        with pytest.raises(LeaveNeededError):
            move(arm, turned(arm, 0.1))
        watch.pass_s(1.0)
        assert watch.moved_for_s(since) == 0.0
        confirm_and(arm, lambda: travel(arm, turned(arm, 0.1)))
