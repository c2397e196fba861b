"""The simulated controller with clients for which it was not written: ur_rtde, and one after UR's guide."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulators.ur_controller import rtde_codec as codec
from simulators.ur_controller.kinematics import MODELS, forward, from_pose, inverse, to_pose
from simulators.ur_controller.motion import MoveJ, MoveL, Stop
from tests.support.arms.ur_driver import dashboard
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.forked import run
from tests.support.processes.waiting import until
from tests.support.vendor.ur_rtde_protocol import RtdeClient

DATA = Path(__file__).parents[1] / "data"
VERSIONS = {"3.15": "UR10", "5.12": "UR10e", "5.25": "UR5e"}


# --- bytes ------------------------------------------------------------------------------------------------


def test_golden_frames() -> None:
    assert codec.frame(codec.REQUEST_PROTOCOL_VERSION, b"\x01") == bytes.fromhex("0004 56 01")
    assert codec.setup_reply(codec.SETUP_INPUTS, 1, ["INT32", "DOUBLE"]) == b"\x00\x10I\x01INT32,DOUBLE"
    outputs = struct.pack(">d", 125.0) + b"timestamp,actual_q"
    assert codec.parse_setup_outputs(outputs) == (125.0, ["timestamp", "actual_q"])
    recipe = codec.Recipe(2, ["runtime_state", "actual_tool_accelerometer"], ["UINT32", "VECTOR3D"])
    expected = bytes.fromhex("0020 55 02 00000002 3ff0000000000000 4000000000000000 c000000000000000")
    assert recipe.pack([2, 1.0, 2.0, -2.0]) == expected
    assert recipe.unpack(expected[3:]) == {"runtime_state": (2,), "actual_tool_accelerometer": (1.0, 2.0, -2.0)}


def test_frames_are_cut_from_any_pieces() -> None:
    wire = codec.frame(1, b"abc") + codec.frame(2) + codec.frame(3, b"x" * 300)
    reader = codec.FrameReader()
    frames = [f for i in range(0, len(wire), 7) for f in reader.feed(wire[i : i + 7])]
    assert frames == [(1, b"abc"), (2, b""), (3, b"x" * 300)]
    with pytest.raises(codec.FrameError):
        list(codec.FrameReader().feed(b"\x00\x01U"))
    with pytest.raises(codec.FrameError, match="takes 5 bytes, not 3"):
        codec.Recipe(1, ["a"], ["INT32"]).unpack(b"\x01ab")


# --- kinematics and motion ---------------------------------------------------------------------------------


# Forward kinematics of six postures of each model by an independent package, ur-analytic-ik 0.1.0.
POSTURES = [json.loads(line) for line in (DATA / "ur_forward_kinematics.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("model", MODELS)
def test_kinematics_agree_with_an_independent_package(model: str) -> None:
    rng = np.random.default_rng(3)
    postures = [posture for posture in POSTURES if posture["model"] == model]
    assert len(postures) == 6
    for posture in postures:
        q, T = np.array(posture["q_rad"]), np.vstack([posture["T_base_flange"], [0.0, 0.0, 0.0, 1.0]])
        np.testing.assert_allclose(forward(MODELS[model], q), T, atol=1e-12)
        found = inverse(MODELS[model], T, q + rng.normal(0, 0.01, 6))
        assert found is not None
        np.testing.assert_allclose(forward(MODELS[model], found), T, atol=1e-9)
        assert np.max(np.abs(found - q)) < 0.2


def test_wrist_pointing_down_has_solutions_and_far_away_has_none() -> None:
    down = np.array([0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
    found = inverse(MODELS["UR10e"], forward(MODELS["UR10e"], down), down)
    assert found is not None
    np.testing.assert_allclose(found, down, atol=1e-7)
    assert inverse(MODELS["UR10e"], from_pose(np.array([5.0, 0, 0, 0, 0, 0])), down) is None


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1.0, np.pi - 1e-7, np.pi])
def test_pose_round_trip(angle: float) -> None:
    axis = np.array([1.0, -2.0, 2.0]) / 3
    T = from_pose(np.concatenate([[1, 2, 3], angle * axis]))
    np.testing.assert_allclose(from_pose(to_pose(T)), T, atol=1e-9)


def test_motions_keep_their_limits_and_arrive() -> None:
    q0 = np.array([0.0, -1.5, 1.6, -1.6, -1.5, 0.1])
    motion = MoveJ(q0, q0 + np.array([0.4, -0.2, 0, 0, 0, 0.1]), 1.05, 1.4)
    elapsed = 0.0
    while not motion.done:
        motion.advance(0.002)
        elapsed += 0.002
        assert np.max(np.abs(motion.qd)) <= 1.05 + 1e-9
    assert elapsed == pytest.approx(2 * np.sqrt(0.4 / 1.4), abs=0.004)  # a triangle: 1.069 s
    np.testing.assert_allclose(motion.q, q0 + np.array([0.4, -0.2, 0, 0, 0, 0.1]))

    tool = from_pose(np.array([0, 0, 0.1, 0, 0, 0.0]))
    goal = forward(MODELS["UR10e"], q0) @ tool @ from_pose(np.array([0.05, 0.02, -0.03, 0, 0, 0.2]))
    start = (forward(MODELS["UR10e"], q0) @ tool)[:3, 3]
    line = MoveL(MODELS["UR10e"], q0, goal, tool, speed=0.25, acceleration=1.2)
    direction = (goal[:3, 3] - start) / np.linalg.norm(goal[:3, 3] - start)
    while not line.done:
        line.advance(0.008)
        offset = (forward(MODELS["UR10e"], line.q) @ tool)[:3, 3] - start
        assert np.linalg.norm(offset - (offset @ direction) * direction) < 1e-9
    np.testing.assert_allclose(forward(MODELS["UR10e"], line.q) @ tool, goal, atol=1e-9)

    stop = Stop(q0, np.array([1.0, 0, 0, 0, 0, -0.5]), 2.0)
    for _ in range(300):
        stop.advance(0.002)
    assert stop.done
    np.testing.assert_allclose(stop.q - q0, [0.25, 0, 0, 0, 0, -0.125], atol=1e-9)


# --- RTDE as UR's guide has it -------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=list(VERSIONS))
def controller(request: pytest.FixtureRequest) -> Generator[tuple[str, str]]:
    version = str(request.param)
    host = address(20 + int(version.split(".")[1]))
    with simulated_ur(host, "--version", version, "--model", VERSIONS[version], "--speed-up", "5"):
        yield host, version


@pytest.fixture
def client(controller: tuple[str, str]) -> Generator[RtdeClient]:
    connection = RtdeClient(controller[0])
    yield connection
    connection.close()


def test_handshake_and_stream(controller: tuple[str, str], client: RtdeClient) -> None:
    version = controller[1]
    assert client.negotiate(2)
    assert client.controller_version()[:2] == tuple(int(p) for p in version.split("."))
    names = ["timestamp", "actual_q", "robot_mode", "safety_status_bits", "joint_mode", "actual_digital_output_bits"]
    recipe, types = client.output_setup(names, 125.0)
    assert recipe == 1
    assert types == ["DOUBLE", "VECTOR6D", "INT32", "UINT32", "VECTOR6INT32", "UINT64"]
    assert client.start()
    packages = [client.data() for _ in range(50)]
    times = np.array([p["timestamp"][0] for p in packages])
    assert np.all(np.diff(times) > 0)
    assert np.mean(np.diff(times)) > 0.007, "never more than 125 Hz"
    assert np.quantile(np.diff(times), 0.25) < 0.011, "nor less, but where the simulator was not scheduled"
    assert packages[-1]["robot_mode"] == (7,)
    assert packages[-1]["safety_status_bits"][0] == 1
    assert len(packages[-1]["actual_q"]) == 6
    assert client.pause()
    kinds = [client.answered_by("v") for _ in range(20)]
    assert kinds == ["v"] * 20, "no data package comes any more"


def test_fields_depend_on_the_version(controller: tuple[str, str], client: RtdeClient) -> None:
    _, version = controller
    names = [
        "timestamp",
        "ft_raw_wrench",
        "actual_current_as_torque",
        "payload",
        "output_double_register_47",
        "nonsense",
    ]
    recipe, types = client.output_setup(names, 10.0)
    assert recipe == 0
    assert dict(zip(names, types, strict=True)) == {
        "timestamp": "DOUBLE",
        "ft_raw_wrench": "NOT_FOUND" if version == "3.15" else "VECTOR6D",
        "actual_current_as_torque": "VECTOR6D" if version == "5.25" else "NOT_FOUND",
        "payload": "DOUBLE",
        "output_double_register_47": "DOUBLE",
        "nonsense": "NOT_FOUND",
    }
    assert not client.start(), "without a recipe there is nothing to stream"


def test_inputs_are_owned_and_written(controller: tuple[str, str], client: RtdeClient) -> None:
    names = [
        "input_int_register_5",
        "input_double_register_6",
        "standard_digital_output_mask",
        "standard_digital_output",
    ]
    recipe, types = client.input_setup(names)
    assert (recipe, types) == (1, ["INT32", "DOUBLE", "UINT8", "UINT8"])
    assert client.input_setup(["input_int_register_6"])[0] == 2
    other = RtdeClient(controller[0])
    assert other.input_setup(["input_int_register_5"]) == (0, ["IN_USE"])
    other.output_setup(["input_int_register_5", "input_double_register_6", "actual_digital_output_bits"], 500.0)
    other.start()
    client.send("U", struct.pack(">BidBB", 1, -7, 2.5, 0b0110, 0b0100))
    while (data := other.data())["input_int_register_5"] != (-7,):
        pass
    other.close()
    assert data["input_int_register_5"] == (-7,)
    assert data["input_double_register_6"] == (2.5,)
    assert int(data["actual_digital_output_bits"][0]) & 0b0110 == 0b0100


def test_wrong_frames_end_only_their_own_connection(controller: tuple[str, str], client: RtdeClient) -> None:
    bad = socket.create_connection((controller[0], 30004), timeout=90)
    bad.sendall(b"\x00\x00\x00")
    assert bad.recv(10) == b""
    bad.close()
    assert client.negotiate(2)
    assert not client.negotiate(7)


def test_dashboard_lines(controller: tuple[str, str]) -> None:
    host, version = controller
    with socket.create_connection((host, 29999), timeout=90) as connection, connection.makefile("rw") as lines:

        def ask(line: str) -> str:
            lines.write(line + "\n")
            lines.flush()
            return lines.readline().strip()

        assert lines.readline().startswith("Connected: Universal Robots Dashboard Server")
        assert ask("PolyscopeVersion").startswith(f"URSoftware {version}.")
        assert ask("get serial number").isdigit()
        assert ask("robotmode") == "Robotmode: RUNNING"
        assert ask("power off") == "Powering off"
        assert ask("robotmode") == "Robotmode: POWER_OFF"
        assert ask("power on") == "Powering on"
        assert ask("robotmode") == "Robotmode: POWER_ON"
        until(lambda: ask("robotmode") == "Robotmode: IDLE", "the power does not come")
        assert ask("brake release") == "Brake releasing"
        until(lambda: ask("robotmode") == "Robotmode: RUNNING", "the brakes stay")
        assert ask("running") == "Program running: false"
        assert ask("stop") == "Stopped"
        assert ask("make coffee").startswith("could not understand")
        assert ask("quit") == "Disconnected"
        assert lines.readline() == ""


def test_a_client_that_met_local_control_is_refused_until_it_connects_again() -> None:
    """As Universal_Robots_ROS_Driver#125 and #262 tell it, in the words of PolyScope 5."""
    host = address(48)
    with simulated_ur(host, "--local") as ready:
        with socket.create_connection((host, 29999), timeout=90) as connection, connection.makefile("rw") as lines:

            def ask(line: str) -> str:
                lines.write(line + "\n")
                lines.flush()
                return lines.readline().strip()

            lines.readline()
            refused = (
                "Command is not allowed due to safety reasons, please switch robot to Remote Control mode and "
                "reconnect to port 29999"
            )
            commands = ("power on", "brake release", "stop", "play", "unlock protective stop", "load a.urp")
            assert {ask(command) for command in commands} == {refused}
            assert ask("robotmode") == "Robotmode: RUNNING"
            assert ask("is in remote control") == "false"
            os.kill(int(ready["pid"]), signal.SIGUSR1)
            until(lambda: dashboard(host, "is in remote control") == ["true"], "the key is not turned")
            assert ask("is in remote control") == "true"
            assert ask("stop") == refused
        assert dashboard(host, "stop") == ["Stopped"]


# --- ur_rtde ---------------------------------------------------------------------------------------------------


def test_unmodified_ur_rtde(controller: tuple[str, str]) -> None:
    host, version = controller
    command = [sys.executable, "-m", "tests.support.vendor.ur_vendor_session", host, version]
    done = run(command, timeout_s=60)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["polyscopeVersion"].startswith(version)
    assert said["robotmode"] == "Robotmode: RUNNING"
    if version != "3.15":
        assert said["isInRemoteControl"] is True
        assert said["getSerialNumber"].isdigit()
        assert said["payload"] == pytest.approx(1.6)
    assert said["io"] == [True] * 5
    assert said["outputs"] & 0x1020A == 0x10208 & 0x1020A
    assert said["analog"] == pytest.approx(0.25)
    assert said["moveJ"] is True
    assert said["moveJ_s"] >= 2 * np.sqrt(0.2 / 1.4) / 5 - 0.02
    assert said["moveJ_error"] < 1e-6
    assert said["tcp"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert said["setPayload"] is True
    np.testing.assert_allclose(from_pose(np.array(said["fk"])), from_pose(np.array(said["pose"])), atol=1e-6)
    assert (said["has_solution"], said["has_no_solution"]) == (True, False)
    np.testing.assert_allclose(from_pose(np.array(said["ik_fk"])), from_pose(np.array(said["below"])), atol=1e-8)
    assert said["moveL"] is True
    assert (said["async"], said["running"], said["running_after_stop"]) == (True, True, False)
    assert 0.001 < said["stopped_at"] < 0.0299, "stopped on the way"
    assert said["speedJ"] is True
    assert said["speed"] == pytest.approx(0.5, abs=0.05), "0.1 rad/s, five times as fast"
    assert said["path"] is True
    assert said["path_error"] < 1e-4
    assert said["protective"] == [True, False, 3]
    assert "until 5s after occurrence" in said["early_unlock"]
    assert said["again"] == [False, True]
    assert said["slider"] == pytest.approx(0.5)


@pytest.fixture(scope="module")
def rare_calls() -> dict[str, Any]:
    """The client's answers to rare calls, in one session."""
    host = address(48)
    with simulated_ur(host, "--version", "5.12", "--model", "UR10e", "--speed-up", "5", patience_s=0):
        command = [sys.executable, "-m", "tests.support.vendor.ur_vendor_calls", host]
        done = run(command, timeout_s=90)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_package_longer_than_its_recipe_leaves_the_link_alive(rare_calls: dict[str, Any]) -> None:
    said = rare_calls["forward_kinematics"]
    assert said["long"] == [6, 6]
    assert said["connected"] is True
    difference = np.subtract(said["with_tool"][:3], said["plain"][:3])
    assert np.linalg.norm(difference) == pytest.approx(0.1, abs=1e-6)
    assert said["moveJ"] is True


def test_a_watchdog_that_is_not_kicked_ends_the_program(rare_calls: dict[str, Any]) -> None:
    assert rare_calls["watchdog"] == {"set": True, "kicked": True, "alone": False, "moveJ": False}


def test_the_upper_registers_work_as_the_lower_ones(rare_calls: dict[str, Any]) -> None:
    said = rare_calls["upper_registers"]
    assert said["moveJ"] is True
    assert len(said["fk"]) == 6
    assert said["tcp"][0] is True
    assert said["tcp"][1] == pytest.approx([0, 0, 0.1, 0, 0, 0])


def test_a_function_of_ones_own_is_reported_done(rare_calls: dict[str, Any]) -> None:
    assert rare_calls["own_function"] == {"done": True, "again": True}


def test_a_program_file_is_loaded_played_held_and_stopped(rare_calls: dict[str, Any]) -> None:
    said = rare_calls["pendant"]
    assert "Failed to execute: play" in said["nothing_loaded"]
    assert "File not found: x" in said["no_file"]
    assert said["loaded"] == "Loaded program: capture.urp"
    assert said["states"] == [
        ["PLAYING capture.urp", True],
        ["PAUSED capture.urp", False],
        ["PLAYING capture.urp", True],
        ["STOPPED capture.urp", False],
    ]
    assert "Failed to execute: pause" in said["pause_idle"]
    assert "Unlock protective stop failure" in said["unlock_idle"]


# --- world --------------------------------------------------------------------------------------------------------


def test_world_is_told_the_joints() -> None:
    host = address(49)
    with socket.create_server(("127.0.0.1", 0)) as world:
        world.settimeout(90)
        port = world.getsockname()[1]
        joints = "0.1,-1.2,1.3,-1.4,-1.5,0.6"
        with simulated_ur(host, "--world", f"127.0.0.1:{port}", "--arm", "robot", "--initial-joints", joints):
            connection, _ = world.accept()
            connection.settimeout(90)
            with connection, connection.makefile("r") as lines:
                still = [json.loads(lines.readline()) for _ in range(8)]
                assert {(m["op"], m["arm"]) for m in still} == {("robot", "robot")}
                assert still[0]["q"] == [0.1, -1.2, 1.3, -1.4, -1.5, 0.6]
                gaps_s = np.diff([told["t"] for told in still])
                assert 0.05 < np.min(gaps_s) < 0.2, "ten times a second at rest"
