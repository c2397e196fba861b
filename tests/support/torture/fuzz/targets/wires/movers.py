"""Fuzz targets on the wires of a KUKA arm and of axes under GRBL: both ends of each."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.grbl import GrblAxis, GrblConfig
from drivers.grbl.table import GrblTable
from drivers.interfaces import RobotArm, SettleCriteria
from drivers.kuka import KukaConfig
from drivers.kuka.robot import KukaRobot
from service.store.events import canonical
from simulators.faults import FaultPlan
from simulators.grbl.controller import Controller as GrblController
from simulators.grbl.machine import Machine
from simulators.kuka_controller import HOME_RAD
from simulators.kuka_controller.controller import Controller as KukaController
from simulators.kuka_controller.kinematics import MODELS
from simulators.kuka_controller.server import Server as KukaServer
from simulators.serve import SimulatorError, Termination
from tests.support.torture.fuzz.mutations import BYTES, JSON, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target
from tests.support.torture.fuzz.targets.wires.peers import Peer, threads_watched

_HOST = f"127.{100 + os.getpid() % 100}.{os.getpid() // 100 % 250}.10"
_CRITERIA = SettleCriteria(0.05, 0.01, 0.01, 1e-3, 1e-3)
_AXIS = GrblAxis(letter="X", carries="specimen", direction=(0, 0, 1), from_deg=-700, to_deg=-5)
_MOUNT = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.6), (0.0, 0.0, 0.0, 1.0))


def _use(arm: RobotArm, joints: Sequence[float]) -> None:
    """Return what a capture does with an arm; its records are those of the evidence."""
    try:
        canonical(dataclasses.asdict(arm.open()))
        report = arm.report()
        canonical({"details": report.details, "problems": report.problems})
        arm.let_move("Ada", float("inf"))
        arm.move_joints(np.array(joints), speed_rad_s=0.5, acceleration_rad_s2=1.5)
        arm.is_moving()
        arm.settle(_CRITERIA)
        sample = arm.state().sample
        if not (np.isfinite(sample.T_base_flange).all() and np.isfinite(sample.joints_rad).all()):
            raise MisbehavedError("a pose that is not finite is accepted")
        arm.stop()
    finally:
        arm.close()


# --- KUKA ---------------------------------------------------------------------------------------------------------


def _kuka_controller() -> KukaController:
    return KukaController(
        MODELS["LBR Med 14"], joints=np.array(HOME_RAD), serial="1", faults=FaultPlan(), device="robot", speed_up=1.0,
        true_load_kg=None,
    )  # fmt: skip


def _kuka_lines(_: Path) -> list[bytes]:
    """Return what a controller says in a session, with numbers of requests as the driver counts them."""
    state = {**_kuka_controller().state(1), "locked": False}
    hello = {"is": "hello", "protocol": 1, "model": "LBR Med 14", "serial": "1", "software": "x", "time_s": 1.0}
    permitted, stopped = ({"is": "ack", "seq": sequence} for sequence in (1, 3))
    begun = {"is": "ack", "seq": 2, "motion": 1}
    done: dict[str, object] = {"is": "done", "motion": 1}
    refused: dict[str, object] = {"is": "err", "seq": 2, "motion": None, "code": "limits", "what": "axis 2"}
    ended: dict[str, object] = {"is": "err", "seq": None, "motion": 1, "code": "safety", "what": "a stop"}
    return [
        _lines([hello, state, permitted, state, *rest])
        for rest in ([begun, done, stopped, state], [refused, state], [begun, ended, stopped, state])
    ]


def _lines(lines: Sequence[Mapping[str, object]]) -> bytes:
    return b"".join(json.dumps(line).encode() + b"\n" for line in lines)


def _kuka_driver(data: bytes, _: Path) -> None:
    """Connect to a controller that greets with the first line, streams the second, and answers with the others."""
    greeting, stream, *rest = [*data.splitlines(keepends=True), b"", b""][: 1 << 10]
    answers = iter([b"".join(rest[at : at + 2]) for at in range(0, len(rest), 2)])
    with (
        threads_watched(),
        Peer(greeting + stream, lambda heard: next(answers, stream) if b'"seq"' in heard else b"", stream) as peer,
    ):
        config = KukaConfig(
            host="127.0.0.1", port=peer.port, connect_timeout_s=0.3, answer_timeout_s=0.1, stale_after_s=0.1
        )
        _use(KukaRobot(config), HOME_RAD)


def _kuka_requests(_: Path) -> list[bytes]:
    return [
        _lines([
            {"seq": 1, "do": "permit", "by": "Ada"},
            {"seq": 2, "do": "tool", "mass_kg": 1.6, "centre_m": [0, 0, 0.08], "tcp_xyz_m": [0, 0, 0.1],
             "tcp_abc_rad": [0, 0, 0]},
            {"do": "beat"},
            {"seq": 3, "do": "move", "q": list(HOME_RAD), "speed_rad_s": 0.5, "acceleration_rad_s2": 1.0},
            {"seq": 4, "do": "stop"},
        ])
    ]  # fmt: skip


class _Turns(Termination):
    """Set after some turns of the simulator's loop."""

    def __init__(self, turns: int) -> None:
        self._left = turns

    def is_set(self) -> bool:
        """Return whether the turns are used up."""
        self._left -= 1
        return self._left < 0


def _kuka_simulator(data: bytes, _: Path) -> None:
    server = KukaServer(_kuka_controller(), (_HOST, 30010), 30011, None, fri_version="none")
    try:
        with (
            socket.create_connection((_HOST, 30010), timeout=2.0) as link,
            socket.create_connection((_HOST, 30011), timeout=2.0) as pendant,
        ):
            server.run(_Turns(2))
            for each in (link, pendant):
                each.sendall(data[: 1 << 16])
            server.run(_Turns(4))
    finally:
        server.close()


# --- GRBL ---------------------------------------------------------------------------------------------------------


def _grbl_session() -> dict[bytes, bytes]:
    """Return what the simulated controller answers to each line of the driver, in a fixed order."""
    said: list[bytes] = []
    controller = GrblController(Machine({24: 1e6, 25: 1e6}, 1e3), said.append, FaultPlan())
    controller.power_up()
    found: dict[bytes, bytes] = {}
    now_s = 1.0
    for line in (b"\x18", b"?", b"$$\n", b"$I\n", b"$H\n", b"?", b"$J=G53G90G21X-10F100\n"):
        said.clear()
        controller.hear(line)
        for _ in range(50):
            controller.advance(now_s := now_s + 0.1)
        found[line] = b"".join(said)
    return found


_SESSION = _grbl_session()
_PARTS = tuple(_SESSION)


def _grbl_seeds(_: Path) -> list[bytes]:
    states = ("Door:1", "Door:0", "Hold:1")
    doors = b"".join(f"<{state}|MPos:-3.000,0.000,0.000|FS:0,0>\r\n".encode() for state in states)
    return [b"\x1e".join(_SESSION.values()), b"\x1e".join([*_SESSION.values(), doors, b"ALARM:1\r\nerror:9\r\n"])]


def _grbl_driver(data: bytes, _: Path) -> None:
    """Connect to a controller that answers each line of the driver with its part of the input."""
    parts = data.split(b"\x1e")
    answers = dict(zip(_PARTS, parts, strict=False))
    more = itertools.cycle(parts[len(_PARTS) :] or [b""])

    def answer(heard: bytes) -> bytes:
        known = [text for line, text in answers.items() if line in heard]
        return b"".join(known) + (next(more) if heard.count(b"?") else b"")

    with threads_watched(), Peer(b"", answer) as peer:
        config = GrblConfig(
            port=f"socket://127.0.0.1:{peer.port}", axes=(_AXIS,), T_base_flange_zero=_MOUNT, connect_timeout_s=0.2,
            answer_timeout_s=0.1, homing_timeout_s=0.2, stale_after_s=0.2,
        )  # fmt: skip
        _use(GrblTable(config), [-1.0])


def _grbl_lines(_: Path) -> list[bytes]:
    return [b"".join(_PARTS) + b"$20=1\n$X\n$J=G91X5F2000\n!~\x85?$N0=\n$#\n$G\nG0X1\n"]


def _grbl_simulator(data: bytes, _: Path) -> None:
    said: list[bytes] = []
    controller = GrblController(Machine({}, 1.0), said.append, FaultPlan())
    controller.power_up()
    for turn, at in enumerate(range(0, min(len(data), 1 << 14), 256)):
        controller.hear(data[at : at + 256])
        controller.advance(1.0 + 0.01 * turn)
    with contextlib.suppress(IndexError):
        said[-1].decode("ascii")


_SIMULATOR: dict[str, Any] = {"errors": (SimulatorError,), "says_place": False}
_DRIVER: dict[str, Any] = {"pace": 0.2, "seconds": 6.0}
_ALL: tuple[Callable[..., bytes], ...] = (*BYTES, *TEXT)
TARGETS: tuple[Target, ...] = (
    Target("kuka_answers", "drivers.kuka.robot:KukaRobot", _kuka_driver, _kuka_lines, (*JSON, *BYTES), **_DRIVER),
    Target("grbl_answers", "drivers.grbl.table:GrblTable", _grbl_driver, _grbl_seeds, _ALL, **_DRIVER),
    Target(
        "kuka_requests", "simulators.kuka_controller.server:Server", _kuka_simulator, _kuka_requests, (*JSON, *BYTES),
        pace=0.5, **_SIMULATOR,
    ),
    Target(
        "grbl_requests", "simulators.grbl.controller:Controller.hear", _grbl_simulator, _grbl_lines, _ALL,
        **_SIMULATOR,
    ),
)  # fmt: skip
