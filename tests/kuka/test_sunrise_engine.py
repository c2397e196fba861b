"""The application of the KUKA controller: it compiles for each Sunrise.OS, and its engine runs on the JVM."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import subprocess
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.arms.kuka_simulator import pendant
from tests.support.arms.sunrise import (
    APPLICATION,
    TEST_SIDE,
    compile_java,
    java_program,
    sunrise_engine,
)
from tests.support.arms.ur_simulator import address
from tests.support.processes.lateness import Lateness
from tests.support.processes.waiting import until

pytestmark = pytest.mark.packages("default-jdk-headless")

HOME = [0.0, 0.5236, 0.0, -1.2217, 0.0, 1.3963, 0.0]
FAR = [2.5, *HOME[1:]]
MOVE = {"do": "move", "q": FAR, "speed_rad_s": 0.5, "acceleration_rad_s2": 2.0}
LATE_TIMES = 5  # client, reader, watching thread and arm wake one after the other
Line = dict[str, Any]


class Client:
    """A client that says exactly what the test wants, and when."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, 30010), timeout=90)
        self._lines = self._socket.makefile("rb")
        self._sequence = 0

    def close(self) -> None:
        self._lines.close()
        self._socket.close()

    def send(self, line: Line | str) -> None:
        raw = line if isinstance(line, str) else json.dumps(line)
        self._socket.sendall(raw.encode() + b"\n")

    def ask(self, **request: object) -> Line:
        """Send a request and return its answer; lines of the stream in between are dropped."""
        self._sequence += 1
        self.send({"seq": self._sequence, **request})
        return self.next(lambda line: line.get("seq") == self._sequence)

    def next(self, wanted: Any) -> Line:
        while not wanted(line := self.line()):
            pass
        return line

    def end(self) -> Line:
        """How the motion ended."""
        return self.next(lambda line: line["is"] in ("done", "err") and line.get("motion"))

    def line(self) -> Line:
        raw = self._lines.readline()
        assert raw, "the application closed the connection"
        return json.loads(raw)

    def state(self) -> Line:
        return self.next(lambda line: line["is"] == "state")


@contextlib.contextmanager
def connected(host: str) -> Generator[Client]:
    client = Client(host)
    try:
        assert client.line()["is"] == "hello"
        yield client
    finally:
        client.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stubs", "folders"),
    [
        pytest.param("stubs1", ["sunrise1"], marks=pytest.mark.sweep),
        pytest.param("stubs1", ["sunrise1", "sunrise1_fri"], marks=pytest.mark.sweep),
        pytest.param("stubs2", ["sunrise2"], marks=pytest.mark.sweep),
        pytest.param("stubs2", ["sunrise2", "sunrise25_fri"], marks=pytest.mark.sweep),
        pytest.param("stubs2", ["sunrise2", "sunrise27_fri"], marks=pytest.mark.sweep(always=True)),
    ],
)
def test_the_application_compiles_for_each_version(tmp_path: Path, stubs: str, folders: list[str]) -> None:
    compile_java(tmp_path, TEST_SIDE / stubs, *(APPLICATION / name for name in ("engine", *folders)))
    version = folders[0].replace("sunrise", "v")
    name = "OrthocaptureFriServer" if len(folders) == 2 else "OrthocaptureServer"
    assert (tmp_path / "orthocapture" / "sunrise" / version / f"{name}.class").is_file()


def test_only_the_layer_of_a_version_names_the_maker_s_classes() -> None:
    for path in (APPLICATION / "engine").rglob("*.java"):
        assert "com.kuka" not in path.read_text(encoding="utf-8"), path


@pytest.mark.slow
@pytest.mark.realtime
def test_a_silent_client_has_its_arm_stopped_after_0_3_s_and_must_permit_again() -> None:
    host = address(81)
    with sunrise_engine(host, patience_s=0), Lateness() as lateness, connected(host) as client:
        client.ask(do="permit", by="Ada")
        assert client.ask(**MOVE)["is"] == "ack"
        moving = client.state()
        for _ in range(60):
            client.send({"do": "beat"})
            moving = client.state()
        assert moving["motion"] == 1, "beats keep it moving"
        assert not moving["locked"]
        ended = client.end()
        assert ended["code"] == "heartbeat"
        stood = client.state()
        assert stood["locked"]
        # 0.3 s of silence and the braking at 6 rad/s², and how late this machine's threads wake.
        assert stood["q"][0] - moving["q"][0] < 0.5 * (0.3 + 0.3 + LATE_TIMES * lateness.worst_s)
        assert client.ask(**MOVE)["code"] == "locked"
        client.ask(do="permit", by="Ada")
        assert client.ask(**MOVE)["is"] == "ack"


@pytest.mark.slow
def test_a_stop_of_the_safety_controller_latches_and_cancels_the_motion() -> None:
    host = address(82)
    with sunrise_engine(host), connected(host) as client:
        client.ask(do="permit", by="Ada")
        client.ask(**MOVE)
        pendant(host, "stop enabling_switch")
        ended = client.end()
        assert (ended["code"], ended["what"]) == ("safety", "the arm is in enabling switch")
        assert client.ask(do="permit", by="Ada")["code"] == "safety"
        pendant(host, "release")
        until(lambda: client.state()["safety"] == "normal", "the stop is not over", every_s=0)
        stood = client.state()
        assert stood["locked"]
        assert stood["motion"] == 0, "the motion does not go on by itself"
        assert client.ask(**MOVE)["code"] == "locked"


@pytest.mark.slow
@pytest.mark.realtime
def test_a_call_to_the_controller_that_hangs_does_not_keep_the_arm_moving() -> None:
    host = address(83)
    with sunrise_engine(host, patience_s=0), Lateness() as lateness, connected(host) as client:
        client.ask(do="permit", by="Ada")
        client.ask(**MOVE)
        moving = client.state()
        pendant(host, "hang on")
        time.sleep(2.0)  # in which the arm would go 1 rad
        pendant(host, "hang off")
        ended = client.end()
        assert ended["code"] == "heartbeat"
        assert client.state()["q"][0] - moving["q"][0] < 0.5 * (0.3 + 0.6 + LATE_TIMES * lateness.worst_s)


def test_the_end_of_the_connection_stops_and_locks_and_the_next_client_may_come_at_once() -> None:
    host = address(84)
    with sunrise_engine(host):
        with connected(host) as client:
            client.ask(do="permit", by="Ada")
            client.ask(**MOVE)
            with contextlib.closing(Client(host)) as second:
                assert second.line()["code"] == "taken"
        with connected(host) as client:
            assert client.state()["locked"]
            until(lambda: client.state()["motion"] == 0, "the arm goes on", every_s=0)
            assert client.state()["q"][0] < 2.4, "it stopped on its way"


def test_lines_that_are_no_requests_are_refused_and_the_connection_stays() -> None:
    host = address(85)
    with sunrise_engine(host), connected(host) as client:
        for raw in ("", "[1]", '{"do":"stop"}', '{"seq":true,"do":"stop"}', '{"seq":1.5}', "x" * 70_000, '{"seq":1'):
            client.send(raw)
            refused = client.next(lambda line: line["is"] == "err")
            assert (refused["code"], refused["seq"]) == ("bad_line", None), raw[:20]
        tool = {"do": "tool", "mass_kg": 1.6, "centre_m": [0, 0, 0], "tcp_xyz_m": [0, 0, 0], "tcp_abc_rad": [0, 0, 0]}
        for request in (
            {**tool, "centre_m": [0, 0]},
            {**tool, "mass_kg": "1"},
            {**MOVE, "speed_rad_s": 0},
            {"do": "permit"},
            {"do": "fri", "host": "10.0.0.1", "port": 0, "period_ms": 10},
        ):
            assert client.ask(**request)["code"] == "bad_value", request
        assert client.ask(do="fri", host="10.0.0.1", port=30200, period_ms=10)["code"] == "not_ready"
        assert client.ask(do="stop")["is"] == "ack"


@pytest.fixture(scope="module")
def probe() -> Generator[Any]:
    """Calls a pure function of the application."""
    with java_program("Probe", stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        asked, told = process.stdin, process.stdout

        def call(text: str) -> str:
            asked.write(text + "\n")
            asked.flush()
            return told.readline().rstrip("\n")

        yield call
        asked.close()


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
NUMBERS = st.integers(-(10**17), 10**17) | st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=150, deadline=None)
@given(value=VALUES, ascii_only=st.booleans())
def test_its_json_is_that_of_others(probe: Any, value: object, ascii_only: bool) -> None:
    assert json.loads(probe(json.dumps(["json", value], ensure_ascii=ascii_only))) == ["json", value]


@pytest.mark.parametrize(
    "text",
    ["", "[", "[1,]", '["a', "[01]", "[1.]", "[-]", '["\\x"]', "[NaN]", "[1] 2", '[{"a"}]', "[" * 40 + "]" * 40],
)
def test_what_is_not_json_is_refused(probe: Any, text: str) -> None:
    assert probe(text) == "not JSON"


@given(goal=st.lists(st.floats(-2.0, 2.0), min_size=7, max_size=7), speed_rad_s=st.floats(0.01, 1.0))
@settings(max_examples=50, deadline=None)
def test_the_joint_that_turns_most_keeps_to_the_speed(probe: Any, goal: list[float], speed_rad_s: float) -> None:
    full = [math.radians(v) for v in (85, 85, 100, 75, 130, 135, 135)]
    ratio = json.loads(probe(json.dumps(["speed", [0.0] * 7, goal, speed_rad_s])))
    longest = max(map(abs, goal))
    if 0.011 < ratio < 1.0 and longest > 0.0:
        takes_s = max(abs(way) / (ratio * limit) for way, limit in zip(goal, full, strict=True))
        assert longest / takes_s == pytest.approx(speed_rad_s)
    else:
        assert ratio in (0.01, 1.0) or longest > 0.0


@pytest.mark.parametrize(
    ("said", "word"),
    [
        (["NOSTOP", "INACTIVE", "INACTIVE", "OPERATOR_SAFETY_CLOSED", "AUT", "NONE"], "normal"),
        (["STOP1", "ACTIVE", "INACTIVE", "OPERATOR_SAFETY_CLOSED", "AUT", "NONE"], "emergency_stop"),
        (["STOP1", "INACTIVE", "ACTIVE", "OPERATOR_SAFETY_CLOSED", "T1", "NONE"], "emergency_stop"),
        (["STOP1", "INACTIVE", "INACTIVE", "OPERATOR_SAFETY_OPEN", "T1", "NONE"], "enabling_switch"),
        (["STOP1", "INACTIVE", "INACTIVE", "OPERATOR_SAFETY_OPEN", "AUT", "NONE"], "external_stop"),
        (["STOP0", "INACTIVE", "INACTIVE", "OPERATOR_SAFETY_CLOSED", "AUT", "NONE"], "protective_stop"),
        (["something new", "INACTIVE", "INACTIVE", "OPERATOR_SAFETY_CLOSED", "T1", "NORMAL"], "protective_stop"),
    ],
)
def test_the_controller_s_words_of_safety(probe: Any, said: list[str], word: str) -> None:
    assert json.loads(probe(json.dumps(["safety", *said]))) == word


def test_other_arms_keep_their_names(probe: Any) -> None:
    for name, model in (("LBR_Med_14_R820_1", "LBR Med 14"), ("LBR_iiwa_14_R820_1", "LBR iiwa 14"),
                        ("LBR_iiwa_7_R800_1", "LBR_iiwa_7_R800_1")):  # fmt: skip
        assert json.loads(probe(json.dumps(["model", name]))) == model
