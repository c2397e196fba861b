"""FRI as a monitor that only listens: its wire against messages by Google's protobuf, its process, the poses."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import struct
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceRefusedError, DeviceUnavailableError
from drivers.host.hosted_device import hosted
from drivers.interfaces import RobotArm, RobotSample, SettleCriteria
from drivers.kuka import KukaConfig
from drivers.kuka.fri.listener import Listener
from drivers.kuka.fri.protobuf import fields, message_field, number_field
from drivers.kuka.fri.sample import unpack
from drivers.kuka.fri.wire import FriError, Monitoring, decode, reply
from service.core.arms import arm_model
from service.core.arms import flange_pose as forward
from tests.support.arms.kuka_simulator import pendant, simulated_kuka, transcript
from tests.support.arms.ur_simulator import address
from tests.support.processes.below import processes_below
from tests.support.processes.hosts import driver_pid
from tests.support.processes.waiting import until
from tests.support.rig.patience import PATIENT_KUKA
from tests.support.rig.rig import orthocapture

GOLDEN = transcript("fri.jsonl")
MONITOR = [row for row in GOLDEN if "q" in row]
REPLIES = [row for row in GOLDEN if "reply" in row]
CONTROLLER = ("192.170.10.2", 30200)


@pytest.mark.parametrize("row", MONITOR, ids=lambda row: row["what"])
def test_a_message_is_decoded(row: dict[str, Any]) -> None:
    message = decode(bytes.fromhex(row["hex"]))
    assert (message.framed, message.sequence, message.reflected) == (row["framed"], row["sequence"], row["reflected"])
    assert (message.session.name, message.quality.name) == (row["state"], row["quality"])
    assert (message.period_ms, message.answer_every, message.is_normal) == (
        row["period_ms"],
        row["every"],
        row["safe"],
    )
    assert message.joints_rad == tuple(row["q"])
    assert message.commanded_rad == pytest.approx(row["commanded"])
    assert message.time_s == pytest.approx(row["time_s"], abs=1e-6)


@pytest.mark.parametrize("row", REPLIES, ids=lambda row: "framed" if row["framed"] else "bare")
def test_the_reply_is_a_header_and_nothing_else(row: dict[str, Any]) -> None:
    message = decode(bytes.fromhex(next(m["hex"] for m in MONITOR if m["sequence"] == row["to"])))
    assert reply(message, row["reply"]).hex() == row["hex"]


@given(datagram=st.binary(max_size=80))
def test_any_other_datagram_is_refused(datagram: bytes) -> None:
    with pytest.raises(FriError):
        decode(datagram)


@given(at=st.integers(0, 10_000), flip=st.integers(1, 255), row=st.sampled_from(MONITOR))
def test_a_spoilt_message_is_refused_or_read_but_never_breaks_the_process(
    at: int, flip: int, row: dict[str, Any]
) -> None:
    raw = bytearray.fromhex(row["hex"])
    raw[at % len(raw)] ^= flip
    if row["framed"]:
        with pytest.raises(FriError):
            decode(bytes(raw))
        return
    with contextlib.suppress(FriError):
        assert isinstance(decode(bytes(raw)), Monitoring)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        (4, number_field(3, 1 << 16)),  # the period
        (1, number_field(2, 1 << 32)),  # the counter
        (3, message_field(1, b"\x09" + struct.pack("<d", math.nan) + 6 * (b"\x09" + bytes(8)))),  # the joints
        (3, message_field(1, 7 * (b"\x09" + struct.pack("<d", 7.0)))),
    ],
    ids=["period", "counter", "no number", "beyond a turn"],
)
def test_a_message_without_checksum_with_numbers_that_no_arm_has_is_refused(part: int, change: bytes) -> None:
    """The listening process died of the first two, and the poses of the last two were taken."""
    row = next(one for one in MONITOR if not one["framed"] and one["state"] == "MONITORING_READY")
    whole = [(number, value) for number, value in fields(bytes.fromhex(row["hex"]))]
    spoilt = b"".join(
        message_field(number, value + change if number == part else value)
        for number, value in whole
        if isinstance(value, bytes)
    )
    listener = Listener()
    assert listener.take(spoilt, CONTROLLER, 1.0) == (None, None)
    _, sample = listener.take(bytes.fromhex(row["hex"]), CONTROLLER, 1.01)
    assert sample is not None
    assert (sample.received, sample.refused, unpack(sample.pack())) == (1, 1, sample)


def monitor(sequence: int, row: dict[str, Any] = MONITOR[0]) -> bytes:
    """The golden message with another counter below 128, which is one byte of its header."""
    raw = bytearray.fromhex(row["hex"])
    assert raw[8] == row["sequence"]
    raw[8] = sequence
    return bytes(raw)


def test_lost_repeated_and_foreign_messages_are_told_apart() -> None:
    listener = Listener()
    now_s = 100.0
    taken: list[int] = []
    for sequence in (1, 2, 5, 5, 4, 6):
        now_s += 0.01
        answer, sample = listener.take(monitor(sequence), CONTROLLER, now_s)
        assert (answer is None) == (sample is None)
        taken += [sequence] if sample is not None else []
    assert taken == [1, 2, 5, 6]
    assert listener.take(monitor(7), ("10.0.0.9", 30200), now_s) == (None, None)
    assert listener.take(b"noise", CONTROLLER, now_s) == (None, None)
    _, sample = listener.take(monitor(8), CONTROLLER, now_s + 0.01)
    assert sample is not None
    assert (sample.received, sample.lost, sample.refused) == (5, 3, 2)
    assert unpack(sample.pack()) == sample
    _, sample = listener.take(monitor(1), ("10.0.0.9", 30200), now_s + 3.0)
    assert sample is not None, "after a silence the controller may have begun anew"
    assert sample.lost == 3


def test_a_session_that_could_command_gets_no_reply() -> None:
    rows = {row["state"]: bytes.fromhex(row["hex"]) for row in MONITOR}
    for state, wanted in (("IDLE", False), ("MONITORING_READY", True), ("COMMANDING_ACTIVE", False)):
        answer, sample = Listener().take(rows[state], CONTROLLER, 1.0)
        assert sample is not None
        assert (answer is not None) == wanted, state
    listener = Listener()
    slow = bytearray(rows["MONITORING_WAIT"])
    answers = [listener.take(bytes(slow[:8] + bytes([0xAC + i]) + slow[9:]), CONTROLLER, 1.0)[0] for i in range(6)]
    assert [answer is not None for answer in answers] == [False, False, True] * 2, "every third is answered"


@contextlib.contextmanager
def opened(host: str, port: int = 30200) -> Generator[RobotArm]:
    config = KukaConfig.model_validate({"host": host, "fri_port": port, "fri_host": host, **PATIENT_KUKA})
    arm = hosted(RobotArm, "drivers.kuka:DRIVER", config, call_timeout_s=60, name="robot")
    try:
        arm.open()
        yield arm
    finally:
        arm.close()


def listened(samples: tuple[RobotSample, ...]) -> bool:
    """Whether samples are those of FRI, whose clock counts from 1970."""
    return bool(samples) and all(sample.controller_time_s > 1e9 for sample in samples)


def last_second(arm: RobotArm) -> tuple[RobotSample, ...]:
    now_s = time.monotonic()
    return arm.samples(now_s - 1.0, now_s)


@pytest.mark.slow
@pytest.mark.parametrize(
    "version", ["1", pytest.param("2.5", marks=pytest.mark.sweep), pytest.param("2.7", marks=pytest.mark.sweep)]
)
def test_its_samples_are_the_pose_stream(version: str) -> None:
    host = address(91)
    with simulated_kuka(host, "--fri-version", version), opened(host) as arm:
        until(lambda: "MONITORING_READY" in arm.report().details["FRI"], "FRI is not ready")
        assert arm.report().problems == ()
        arm.let_move("Ada", time.monotonic())
        goal = arm.state().sample.joints_rad.copy()
        goal[0] += 0.4
        arm.move_joints(goal, speed_rad_s=1.0, acceleration_rad_s2=1.4)
        until(lambda: not arm.is_moving(), "it does not arrive", every_s=0.02)
        until(lambda: arm.settle(SettleCriteria()).settled, "it does not settle", every_s=0.02)
        samples: list[RobotSample] = []

        def listens() -> bool:
            samples[:] = last_second(arm)
            return listened(tuple(samples))

        until(listens, "FRI has gaps")
        sample = samples[-1]
        np.testing.assert_allclose(sample.joints_rad, goal, atol=1e-4)
        np.testing.assert_allclose(
            sample.T_base_flange, forward(arm_model("LBR Med 14"), sample.joints_rad), atol=1e-12
        )
        assert sample.controller_time_s == pytest.approx(time.time(), abs=60.0)
        report = arm.report()
        assert report.problems == ()
        assert "MONITORING_READY" in report.details["FRI"], "it has commanded nothing"


@pytest.mark.slow
def test_idle_ends_the_session_and_its_poses() -> None:
    """As in a log of a real arm: lbr_fri_ros2_stack#251."""
    faults = [{"device": "robot", "on": "fri", "kind": "end", "nth": 150}]
    host = address(94)
    with simulated_kuka(host, "--fri-version", "2.7", "--faults", json.dumps(faults)), opened(host) as arm:
        until(lambda: any("ended the session of FRI" in p for p in arm.report().problems), "the end is not told")
        assert arm.report().details["FRI"].startswith("IDLE")
        until(lambda: bool(last_second(arm)) and not listened(last_second(arm)), "no poses of the application")


def test_lost_messages_are_told_and_an_interruption_falls_back_to_the_application() -> None:
    host = address(92)
    faults = [
        {"device": "robot", "on": "fri", "kind": "drop", "nth": 20, "times": 3},
        {"device": "robot", "on": "fri", "kind": "corrupt", "nth": 30, "times": 2},
        {"device": "robot", "on": "fri", "kind": "drop", "nth": 150, "times": 1_000_000},
    ]
    with simulated_kuka(host, "--fri-version", "2.7", "--faults", json.dumps(faults)), opened(host) as arm:
        until(lambda: "2 refused" in arm.report().details["FRI messages"], "nothing was corrupted")
        assert "5 lost" in arm.report().details["FRI messages"]
        until(lambda: any("brings no messages" in p for p in arm.report().problems), "FRI is not missed")
        until(
            lambda: bool(last_second(arm)) and not listened(last_second(arm)), "the application's samples do not come"
        )
        arm.let_move("Ada", time.monotonic())
        until(lambda: arm.settle(SettleCriteria()).samples > 10, "no samples of the application")


def test_a_stop_shows_in_its_samples() -> None:
    host = address(93)
    with simulated_kuka(host), opened(host) as arm:
        until(lambda: listened(last_second(arm)), "FRI has gaps")
        pendant(host, "stop emergency_stop")
        until(lambda: not last_second(arm)[-1].safety.may_move, "the stop does not show")


def test_an_application_without_fri_and_a_port_in_use_are_refused() -> None:
    host = address(94)
    with (
        simulated_kuka(host, "--fri-version", "none"),
        pytest.raises(DeviceRefusedError, match="no FRI"),
        opened(host),
    ):
        pass
    with (
        simulated_kuka(host),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        other.bind((host, 30200))
        with pytest.raises(DeviceUnavailableError, match="in use"), opened(host):
            pass


@pytest.mark.slow
def test_doctor_says_how_fri_fares(tmp_path: Path) -> None:
    host = address(96)
    rig = tmp_path / "rig.yaml"
    keys = f"driver: kuka_sunrise, host: {host}, fri_port: 30200, fri_host: {host}"
    keys += "".join(f", {key}: {value}" for key, value in PATIENT_KUKA.items())
    rig.write_text(f"name: FRI\ndevices:\n  robot: {{{keys}}}\n")
    with simulated_kuka(host, "--fri-version", "2.7"):
        done = orthocapture("doctor", "--rig", str(rig), "--data", str(tmp_path), "--json", timeout_s=120)
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(done.stdout)["devices"]["robot"]
    assert told["problems"] == []
    assert "every 10 ms" in told["details"]["FRI"]


def test_its_process_ends_with_the_driver() -> None:
    host = address(95)
    with simulated_kuka(host), opened(host) as arm:
        (listener,) = processes_below(lambda line: "drivers.kuka.fri" in " ".join(line))
        os.kill(driver_pid(arm), signal.SIGKILL)
        assert not psutil.wait_procs([listener], timeout=90)[1]
