"""Fuzz targets on wires: what simulators read from clients, and drivers from a robot, a camera and a light box."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import socket
import struct
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drivers.lightbox import LightboxConfig, SerialLightbox
from drivers.ur.dashboard import Dashboard
from service.cli.operators import SimulatedHands
from service.core.run.state import HandWork
from service.store.events import canonical
from simulators.faults import FaultPlan
from simulators.lightbox import FIRMWARES, MODEL, SERIAL, Lightbox, Make
from simulators.ptpip import codec
from simulators.rig.world_server import World, WorldServer
from simulators.scene.world import Scene
from simulators.serve import SimulatorError
from simulators.sony_camera.body import SonyBody
from simulators.sony_camera.properties import Code
from simulators.sony_camera.server import SonyServer
from simulators.still_camera.body import BodyOptions
from simulators.still_camera.scene import StillLife
from simulators.ur_controller import rtde_codec
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.kinematics import MODELS
from simulators.ur_controller.links import LineLink, RtdeLink, ScriptLink
from simulators.ur_controller.server import Server
from tests.support.torture.fuzz.mutations import BYTES, JSON, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target
from tests.support.torture.fuzz.targets.wires.peers import Listener, threads_watched

_HOST = f"127.{100 + os.getpid() % 100}.{os.getpid() // 100 % 250}.7"  # the ports of a robot are fixed
_CYCLES = 4  # of the controller after the bytes


# --- the simulated robot ------------------------------------------------------------------------------------------


def _robot(link: Callable[[socket.socket, Server], Any]) -> Callable[[bytes, Path], None]:
    def parse(data: bytes, _: Path) -> None:
        controller = Controller(
            MODELS["UR10e"], (5, 12), joints=np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0]), serial="20235000",
            faults=FaultPlan(), device="robot", speed_up=1.0,
        )  # fmt: skip
        server = Server(controller, _HOST, None, 30090)
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        try:
            # As the network delivers it, in two parts.
            one = link(ours, server)
            for part in (data[: len(data) // 2], data[len(data) // 2 :]):
                if part and not one.dead:
                    one.receive(part)
            for _cycle in range(_CYCLES):
                server.interpreter.step()
                controller.advance(controller.step_s)
                if isinstance(one, RtdeLink) and one.streaming:
                    one.stream(controller.time_s)
        finally:
            ours.close()
            theirs.close()
            server.close()

    return parse


def _rtde_streams(_: Path) -> list[bytes]:
    frame = rtde_codec.frame
    outputs = (
        struct.pack(">d", 125.0) + b"timestamp,actual_q,actual_TCP_pose,safety_status_bits,output_int_register_12"
    )
    inputs = b"input_int_register_0,input_double_register_0,speed_slider_mask,speed_slider_fraction"
    values = struct.pack(">BidId", 1, 1, 0.5, 1, 0.5)
    return [
        b"".join((
            frame(rtde_codec.REQUEST_PROTOCOL_VERSION, struct.pack(">H", 2)),
            frame(rtde_codec.GET_CONTROL_VERSION),
            frame(rtde_codec.SETUP_OUTPUTS, outputs),
            frame(rtde_codec.SETUP_INPUTS, inputs),
            frame(rtde_codec.START),
            frame(rtde_codec.DATA_PACKAGE, values),
            frame(rtde_codec.PAUSE),
        ))
    ]  # fmt: skip


def _dashboard_lines(_: Path) -> list[bytes]:
    words = (
        "polyscopeversion",
        "robotmode",
        "safetystatus",
        "load a.urp",
        "play",
        "pause",
        "stop",
        "power on",
        "quit",
    )
    return ["\n".join((*words, "")).encode()]


def _scripts(_: Path) -> list[bytes]:
    """Seeds in the form of the vendor's control script, and a small script."""
    control = """\
def rtde_control():
  # registers
  reg_offset_float = 0
  reg_offset_int = 0
  def exec_move_path():
    movej([0.1, -1.5, 1.5, -1.5, -1.5, 0.0], a=1.4, v=1.05, r=0.0)
    movel(p[0.4, 0.1, 0.5, 0.0, 3.1, 0.0], a=1.2, v=0.25, r=0.02)
  end
end
"""
    return [
        control.encode(),
        b"def other():\n  write_output_integer_register(3 + 2, -7)\nend\nset_digital_out(1, True)\n",
    ]


# --- the simulated camera, light box and world ----------------------------------------------------------------------


def _sessions(_: Path) -> list[bytes]:
    hello = bytes(16) + "client\0".encode("utf-16-le") + struct.pack("<I", 0x10000)
    parts = [codec.packet(codec.PacketType.INIT_COMMAND_REQUEST, hello)]
    kind = codec.PacketType.OPERATION_REQUEST
    for number, (operation, parameters, data) in enumerate(
        (
            (0x1002, (1,), b""), (0x1001, (), b""), (0x1005, (0x10001,), b""), (0x9201, (1, 0, 0), b""),
            (0x9202, (300,), b""), (0x9205, (Code.ISO,), struct.pack("<I", 200)), (0x9209, (), b""),
            (0x9207, (Code.HALF_PRESS,), struct.pack("<H", 2)), (0x1008, (0xFFFFC001,), b""), (0x1003, (), b""),
        )
    ):  # fmt: skip
        body = struct.pack("<IHI", 2 if data else 1, operation, number) + struct.pack(
            f"<{len(parameters)}I", *parameters
        )
        parts.append(codec.packet(kind, body))
        parts += codec.data_packets(number, data) if data else ()
    return [b"".join(parts)]


def _say(address: tuple[str, int], data: bytes) -> None:
    """Send everything, and read until the peer closes."""
    with socket.create_connection(address, timeout=4.0) as link, contextlib.suppress(ConnectionError):
        link.sendall(data)
        with contextlib.suppress(OSError):  # already closed
            link.shutdown(socket.SHUT_WR)
        while link.recv(1 << 16):
            pass


def _camera(data: bytes, _: Path) -> None:
    body = SonyBody(StillLife(48), FaultPlan(), BodyOptions(fast=True))
    with threads_watched(), SonyServer("127.0.0.1", 0, body, FaultPlan()) as server:
        _say(server.address, data)


def _box_requests(_: Path) -> list[bytes]:
    return [b"*IDN?\nLIGHT?\nTEMP?\nSHUTTER?\nSHUTTER 1\nPEDAL?\nnonsense\n"]


def _box(data: bytes, _: Path) -> None:
    box = Lightbox(FaultPlan(), None, None, Make(MODEL, SERIAL, FIRMWARES[-1]))
    line = os.open(box.plug_in(), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        for at in range(0, min(len(data), 1 << 14), 1024):
            os.write(line, data[at : at + 1024])
            box.serve_once(0.0)
            with contextlib.suppress(BlockingIOError):
                os.read(line, 1 << 16)
    finally:
        os.close(line)
        box.unplug()


def _world_requests(_: Path) -> list[bytes]:
    asked = (
        {"op": "robot", "arm": "robot", "q": [0.0, -1.5, 1.5, -1.5, -1.5, 0.0], "t": 1.5},
        {"op": "view"},
        {"op": "act", "action": "hold_camera", "side": "left"},
        {"op": "act", "action": "move_sphere", "from": [0.5, 0.5], "to": [0.55, 0.5], "higher_m": 0.0},
        {"op": "act", "action": "move_robot", "station": "station_1"},
        {"op": "view"},
    )
    return ["".join(json.dumps(one) + "\n" for one in asked).encode()]


class _WatchedWorld(WorldServer):
    """Keeps the exceptions of its threads."""

    died: BaseException | None = None

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep the current exception."""
        del request, client_address
        self.died = self.died or sys.exception()


def _world(data: bytes, _: Path) -> None:
    world = World(_scene(), 480, ("robot",), np.zeros(6))
    with _WatchedWorld(world, world.act) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.005})
        thread.start()
        try:
            host, port = server.address.split(":")
            _say((host, int(port)), data)
        finally:
            server.shutdown()
            thread.join()
    if server.died is not None:
        raise server.died


_SCENES: list[Scene] = []


def _scene() -> Scene:
    if not _SCENES:
        _SCENES.append(Scene.generate(7))
    return _SCENES[0]


def _fault_plans(_: Path) -> list[bytes]:
    plan = [{"device": "camera", "on": "shutter", "kind": "drop", "nth": 2, "times": 1, "value": 0.5}]
    return [json.dumps(plan).encode(), json.dumps(plan[0]).encode()]


def _fault_plan(data: bytes, _: Path) -> None:
    FaultPlan.parse(data.decode(errors="surrogateescape"))


# --- what drivers read --------------------------------------------------------------------------------------------


class _Answering(Listener):
    """A server that answers every line, or each connection, with the next part of the input."""

    def __init__(self, host: str, port: int, parts: list[bytes]) -> None:
        super().__init__(host, port)
        self._parts = itertools.cycle(parts or [b""])

    def converse(self, link: socket.socket) -> None:
        link.settimeout(1.0)
        link.sendall(next(self._parts) + b"\n")
        while link.recv(4096):
            link.sendall(next(self._parts) + b"\n")


def _dashboard_answers(_: Path) -> list[bytes]:
    return [b"Connected: Universal Robots Dashboard Server\nURSoftware 5.12.0.1101319 (Mar 22 2022)\n20235000\nUR10"]


def _facts(data: bytes, _: Path) -> None:
    with _Answering(_HOST, 29999, data.split(b"\n")):
        facts = Dashboard(_HOST, 0.5).facts()
    if not facts.serial.isascii() or len(facts.serial) > 40:
        raise MisbehavedError(f"{facts.serial!r} is accepted as a serial number")


def _box_answers(_: Path) -> list[bytes]:
    return [
        b"# banner\r\n*IDN orthocapture,simulated,1,1.0\r\nLIGHT 45000.0\r\nTEMP 21.50\r\nSHUTTER 0\r\nPEDAL 3\r\n",
        b"ERR 3 sensor fault\r\n*IDN a,b,c,d\nLIGHT 1e3\nTEMP -4\nSHUTTER 1\nPEDAL 0\n",
        b"*IDN a,b,c,1.4*=0:;\nLIGHT 1.0*:<;?\nTEMP 2.0*=>12\nSHUTTER 0*629:\nPEDAL 1 20 30*56=:\nERR 4 x*0000\n",
    ]


def _box_driver(data: bytes, _: Path) -> None:
    """Query a box that answers everything with the input."""
    with _Answering("127.0.0.1", 0, [data[: 1 << 16]]) as peer:
        box = SerialLightbox(LightboxConfig(port=f"socket://127.0.0.1:{peer.port}", timeout_s=0.05))
        try:
            identity = box.open()
            canonical(dataclasses.asdict(identity))  # as a run records it
            canonical(dataclasses.asdict(box.read()))
            canonical(dataclasses.asdict(box.pedal()))
            box.report()
        finally:
            box.close()


def _hands_answers(_: Path) -> list[bytes]:
    return [b'{"ok": true}\n', b'{"ok": false, "error": "no station"}\n']


def _hands(data: bytes, _: Path) -> None:
    with _Answering("127.0.0.1", 0, [data]) as peer:
        SimulatedHands(f"127.0.0.1:{peer.port}").act("fixation", 1, [HandWork(action="spray")])


_SIMULATOR: dict[str, Any] = {"errors": (SimulatorError,), "says_place": False}
_ROBOT = "simulators.ur_controller.links:"
_BOTH = (*BYTES, *TEXT)
TARGETS: tuple[Target, ...] = (
    Target("ur_rtde", f"{_ROBOT}RtdeLink.receive", _robot(RtdeLink), _rtde_streams, **_SIMULATOR),
    Target("ur_dashboard", f"{_ROBOT}LineLink.receive", _robot(LineLink), _dashboard_lines, TEXT, **_SIMULATOR),
    Target("ur_script", f"{_ROBOT}ScriptLink.receive", _robot(ScriptLink), _scripts, TEXT, **_SIMULATOR),
    Target("ptpip", "simulators.sony_camera.server:SonyServer", _camera, _sessions, **_SIMULATOR),
    Target("lightbox_requests", "simulators.lightbox:Lightbox.serve_once", _box, _box_requests, TEXT, **_SIMULATOR),
    Target("world_requests", "simulators.rig.world_server:WorldServer", _world, _world_requests, JSON, **_SIMULATOR),
    Target("fault_plan", "simulators.faults:FaultPlan.parse", _fault_plan, _fault_plans, JSON, **_SIMULATOR),
    Target("ur_facts", "drivers.ur.dashboard:Dashboard", _facts, _dashboard_answers, TEXT, pace=0.5),
    Target("lightbox_answers", "drivers.lightbox:SerialLightbox", _box_driver, _box_answers, _BOTH, pace=0.2),
    Target("hands_answers", "service.cli.operators:SimulatedHands", _hands, _hands_answers, JSON, pace=0.5),
)
