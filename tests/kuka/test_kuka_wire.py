"""Both ends of the KUKA wire against golden transcripts that came from neither (docs/reference)."""

from __future__ import annotations

import json
import socket
import threading
import time
from typing import Any, cast

import numpy as np
import pytest

from drivers.interfaces import Payload, RobotArm
from drivers.kuka import DRIVER, KukaConfig
from drivers.kuka.wire import WireError, from_abc, hello_of, parse, state_of, to_abc
from service.core.geometry import transform
from tests.support.arms.kuka_simulator import Controller, agrees, simulated_kuka, transcript
from tests.support.arms.sunrise import sunrise_engine
from tests.support.arms.ur_simulator import address
from tests.support.processes.waiting import until
from tests.support.rig.patience import PATIENT_KUKA

SILENCE_S = 2.0  # shorter than the motion of the transcript that is stopped because its client is silent


@pytest.mark.parametrize("name", ["session.jsonl", "refusals.jsonl"])
@pytest.mark.parametrize(
    "controller", [simulated_kuka, pytest.param(sunrise_engine, marks=pytest.mark.packages("default-jdk-headless"))]
)
def test_simulator_and_application_answer_as_the_transcript(controller: Controller, name: str) -> None:
    host = address(70)
    with (
        controller(host, patience_s=SILENCE_S),
        socket.create_connection((host, 30010), timeout=90) as connection,
        connection.makefile("rb") as lines,
    ):
        for row in transcript(name):
            if row["from"] == "client":
                raw = row.get("raw") or json.dumps(row["line"])
                connection.sendall(raw.encode() + b"\n")
                continue
            line = json.loads(lines.readline())
            while line["is"] == "state" != row["line"]["is"]:
                line = json.loads(lines.readline())
            assert agrees(line, row["line"]), (line, row["line"])


@pytest.mark.parametrize(
    "controller", [simulated_kuka, pytest.param(sunrise_engine, marks=pytest.mark.packages("default-jdk-headless"))]
)
def test_a_client_that_stays_silent_gives_way_to_a_new_one(controller: Controller) -> None:
    host = address(70)
    said: list[str] = []

    def second_is_greeted() -> bool:
        with socket.create_connection((host, 30010), timeout=90) as second, second.makefile("rb") as lines:
            said.append(json.loads(lines.readline()).get("code", "hello"))
        return said[-1] == "hello"

    with controller(host), socket.create_connection((host, 30010), timeout=90):
        until(second_is_greeted, "the first client stays")
    assert said[0] == "taken"


class _Golden(threading.Thread):
    """The controller's side of a transcript: sends its lines, and collects what the client says."""

    def __init__(self, host: str, rows: list[dict[str, Any]]) -> None:
        super().__init__(daemon=True)
        self._rows = rows
        self._listener = socket.create_server((host, 0))
        self.port: int = self._listener.getsockname()[1]
        self.wrong: list[str] = []
        self.complete = threading.Event()

    def run(self) -> None:
        with self._listener, self._listener.accept()[0] as connection:
            self._play(connection)

    def _play(self, connection: socket.socket) -> None:
        sending = threading.Lock()
        state = next(row["line"] for row in self._rows if row["line"].get("is") == "state")

        def stream() -> None:
            number = 0
            while not self.complete.wait(0.01):
                number += 1
                live = {"n": number, "time_s": time.monotonic(), "flange_xyz_m": [0.5, 0, 0.5], "locked": number < 2}
                send({**state, **live, "flange_abc_rad": [0, 3.0, 0]})

        def send(line: dict[str, Any]) -> None:
            filled = {k: (1.0 if k == "time_s" else "text") if v == "*" else v for k, v in line.items()}
            with sending:
                connection.sendall(json.dumps(filled).encode() + b"\n")

        streaming = threading.Thread(target=stream, daemon=True)
        with connection.makefile("rb") as lines:
            for row in self._rows:
                if row["from"] == "client":
                    line = json.loads(lines.readline())
                    if line != row["line"]:
                        self.wrong.append(f"{line} instead of {row['line']}")
                elif row["line"]["is"] == "state":
                    streaming.start()
                else:
                    send(row["line"])
        self.complete.set()
        streaming.join()


def test_the_driver_speaks_as_the_transcript() -> None:
    golden = _Golden("127.0.0.1", transcript("session.jsonl"))
    golden.start()
    robot = cast(
        RobotArm, DRIVER.build(KukaConfig.model_validate({"host": "127.0.0.1", "port": golden.port, **PATIENT_KUKA}))
    )
    robot.open()
    robot.let_move("Ada", time.monotonic())
    robot.configure(Payload(1.6, (0.0, 0.0, 0.08)), transform(np.eye(3), np.array([0.0, 0.0, 0.1])))
    goal = np.array([0.01, 0.5236, 0.0, -1.2217, 0.0, 1.3963, 0.0])
    robot.move_joints(goal, speed_rad_s=0.5, acceleration_rad_s2=1.0)
    until(lambda: not robot.is_moving(), "the motion did not end", every_s=0.02)
    robot.stop()
    assert golden.complete.wait(90)
    assert golden.wrong == []
    robot.close()


def test_a_line_that_the_protocol_does_not_know_is_refused() -> None:
    state = next(row["line"] for row in transcript("session.jsonl") if row["line"].get("is") == "state")
    whole = {**state, "n": 1, "time_s": 1.0, "flange_xyz_m": [0, 0, 1], "flange_abc_rad": [0, 0, 0]}
    assert state_of(whole).safety.may_move
    assert not state_of({**whole, "safety": "something new"}).safety.may_move
    large, text, flags = [10**400] * 7, ["1"] * 7, [True] * 7
    for name, value in (("q", large), ("q", text), ("q", flags), ("time_s", 10**400), ("override", "0x1")):
        with pytest.raises(WireError, match=name):
            state_of({**whole, name: value})
    for name, value in (("q", [0.0] * 6), ("locked", 0), ("time_s", float("nan")), ("motion", True), ("mode", None)):
        with pytest.raises(WireError, match=name):
            state_of({**whole, name: value})
    for raw in (b"nonsense", b"[]", b"{}"):
        with pytest.raises(WireError):
            parse(raw)
    with pytest.raises(WireError, match="version"):
        hello_of({"is": "hello", "protocol": 2})


def test_abc_turns_about_z_then_y_then_x() -> None:
    quarter = from_abc(np.array([1.0, 2.0, 3.0]), np.array([np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(quarter @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    for abc in ([0.3, -0.4, 2.0], [1.0, np.pi / 2, 0.0]):
        T = from_abc(np.zeros(3), np.array(abc))
        np.testing.assert_allclose(from_abc(*(np.array(v) for v in to_abc(T))), T, atol=1e-12)
