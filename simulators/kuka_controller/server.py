"""The simulated application's port with its one client, the pendant's port, and the link to the world."""

from __future__ import annotations

import json
import logging
import math
import selectors
import socket
import time
from collections.abc import Callable
from typing import cast

import numpy as np

from simulators.connection import Connection, accept
from simulators.kuka_controller.controller import MODES, SAFETY, Controller, MotionEnd, RefusedError
from simulators.kuka_controller.fri import Session
from simulators.serve import SimulatorError, Termination, listening
from simulators.units import seconds
from simulators.world_link import WorldLink

_LOG = logging.getLogger(__name__)

PERIOD_S = 0.01
LONGEST_LINE = 1 << 16
GIVES_WAY_S = 5.0  # a client that is silent for so long gives way to a new one
MAX_BACKLOG_BYTES = 1 << 18


class _Client(Connection):
    """A client of the application's port or the pendant's; `rest` is the line that has not ended."""

    def __init__(self, accepted: socket.socket, *, pendant: bool) -> None:
        super().__init__(accepted)
        self.pendant = pendant
        self.rest = b""

    def tell(self, line: dict[str, object] | str) -> None:
        """Send a line now, or later when the peer reads again."""
        text = line if isinstance(line, str) else json.dumps(line, separators=(",", ":"))
        self.send(text.encode() + b"\n")


class Server:
    """Listens on both ports and advances the controller in real time."""

    def __init__(
        self,
        controller: Controller,
        address: tuple[str, int],
        pendant_port: int,
        world: WorldLink | None,
        fri_version: str,
    ) -> None:
        self.controller, self._world = controller, world
        self._host, self._fri_version = address[0], fri_version
        self._fri: Session | None = None
        self._selector = selectors.SelectSelector()
        self._clients: list[_Client] = []
        self._number = 0
        self._stalled_until_s = 0.0
        self._listen(address[0], address[1], pendant=False)
        self._listen(address[0], pendant_port, pendant=True)

    def _listen(self, host: str, port: int, *, pendant: bool) -> None:
        try:
            listener = listening(host, port)
        except SimulatorError:
            self.close()
            raise
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, pendant)

    # --- loop -----------------------------------------------------------------------------------------------

    def run(self, termination: Termination) -> None:
        """Serve until the termination is set."""
        last_s = next_s = time.monotonic()
        while not termination.is_set():
            self._exchange(max(0.0, next_s - time.monotonic()))
            now_s = time.monotonic()
            if now_s < next_s:
                continue
            next_s = max(next_s + PERIOD_S, now_s - 0.05)
            end = self.controller.advance(now_s - last_s)
            last_s = now_s
            self._stream(now_s, end)
            if self._fri is not None:
                self._fri.send(PERIOD_S)
            if self._world is not None:
                self._world.push([float(v) for v in self.controller.q], self.controller.time_s, now_s)

    def _stream(self, now_s: float, end: MotionEnd | None) -> None:
        fault, self.controller.stream_fault = self.controller.stream_fault, None
        fault = fault or self.controller.faults.check(self.controller.device, "stream")
        client = self._client
        if fault is not None and fault.kind == "stall":
            self._stalled_until_s = now_s + (float(fault.value) if isinstance(fault.value, (int, float)) else 1e9)
        elif fault is not None and client is not None:
            client.dead = True
        if client is None or now_s < self._stalled_until_s:
            return
        self._number += 1
        if len(client.out) < MAX_BACKLOG_BYTES:
            client.tell(self.controller.state(self._number))
        if end is not None:
            line: dict[str, object] = {"is": "done", "motion": end.motion}
            if end.code:
                line = {"is": "err", "seq": None, "motion": end.motion, "code": end.code, "what": end.what}
            client.tell(line)

    @property
    def _client(self) -> _Client | None:
        return next((c for c in self._clients if not c.pendant and not c.dead), None)

    def _exchange(self, timeout_s: float) -> None:
        for key, _ in self._selector.select(timeout_s):
            if isinstance(key.data, _Client):
                self._read(key.data)
            else:
                listener = key.fileobj
                assert isinstance(listener, socket.socket)
                self._accept(listener, pendant=bool(key.data))
        for client in [c for c in self._clients if c.dead]:
            self._selector.unregister(client.socket)
            client.socket.close()
            self._clients.remove(client)
            if not client.pendant:
                self.controller.lose_client()
                self._end_fri()

    def _accept(self, listener: socket.socket, *, pendant: bool) -> None:
        client = _Client(accept(listener), pendant=pendant)
        if not pendant and self._client is not None:
            self._read(self._client)  # it may have hung up just before
        present = self._client
        if not pendant and present is not None and self.controller.silent_s > GIVES_WAY_S:
            present.dead = True
            self.controller.lose_client()
        if not pendant and self._client is not None:
            client.tell(_error(None, "taken", "another client is connected"))
            client.socket.close()
            return
        self._clients.append(client)
        self._selector.register(client.socket, selectors.EVENT_READ, client)
        if not pendant:
            self.controller.locked = True
            self.controller.hear()
            client.tell(
                {
                    "is": "hello", "protocol": 1, "model": self.controller.model.name,
                    "serial": self.controller.serial, "software": self.controller.software,
                    "time_s": round(self.controller.time_s, 6),
                }
            )  # fmt: skip

    def _read(self, client: _Client) -> None:
        data = client.read()
        if not data:
            return
        *lines, rest = (client.rest + data).split(b"\n")
        client.rest = rest[-LONGEST_LINE:]
        for raw in lines:
            if client.pendant:
                client.tell(self._pendant(raw.decode("utf-8", "replace").split()))
            else:
                self._line(client, raw)

    # --- requests -------------------------------------------------------------------------------------------

    def _line(self, client: _Client, raw: bytes) -> None:
        controller = self.controller
        controller.hear()
        try:
            parsed: object = json.loads(raw)
        except (ValueError, RecursionError):
            parsed = None
        if not isinstance(parsed, dict):
            client.tell(_error(None, "bad_line", "the line is not a JSON object"))
            return
        line = cast("dict[str, object]", parsed)
        if line.get("do") == "beat":
            return
        sequence = line.get("seq")
        if isinstance(sequence, bool) or not isinstance(sequence, int):
            client.tell(_error(None, "bad_line", "seq is not an integer"))
            return
        fault = controller.faults.check(controller.device, str(line.get("do"))) if line.get("do") != "move" else None
        if fault is not None and fault.kind in ("drop", "stall"):
            client.dead = fault.kind == "drop"
            return
        try:
            answer = self._do(line)
        except RefusedError as error:
            client.tell(_error(sequence, error.code, str(error)))
        else:
            client.tell({"is": "ack", "seq": sequence, **answer})

    def _do(self, line: dict[str, object]) -> dict[str, object]:
        controller = self.controller
        actions: dict[str, Callable[[], dict[str, object]]] = {
            "permit": lambda: self._permit(line),
            "tool": lambda: self._tool(line),
            "move": lambda: {
                "motion": controller.move(
                    np.array(_numbers(line, "q", 7)), _positive(line, "speed_rad_s"),
                    _positive(line, "acceleration_rad_s2"),
                )
            },
            "stop": self._stop,
            "fri": lambda: self._start_fri(line),
        }  # fmt: skip
        action = actions.get(str(line.get("do")))
        if action is None:
            raise RefusedError("unknown", f"there is no request {line.get('do')!r}")
        return action()

    def _permit(self, line: dict[str, object]) -> dict[str, object]:
        if not isinstance(line.get("by"), str) or not line["by"]:
            raise RefusedError("bad_value", "by is not a name")
        self.controller.permit()
        return {}

    def _tool(self, line: dict[str, object]) -> dict[str, object]:
        mass_kg = _numbers(line, "mass_kg", 0)[0]
        tool: dict[str, object] = {
            "mass_kg": mass_kg, "centre_m": _numbers(line, "centre_m", 3),
            "tcp_xyz_m": _numbers(line, "tcp_xyz_m", 3), "tcp_abc_rad": _numbers(line, "tcp_abc_rad", 3),
        }  # fmt: skip
        self.controller.set_tool(tool, mass_kg)
        return self.controller.tool

    def _stop(self) -> dict[str, object]:
        self.controller.stop()
        return {}

    def _start_fri(self, line: dict[str, object]) -> dict[str, object]:
        host, port, period_ms = line.get("host"), _numbers(line, "port", 0)[0], _numbers(line, "period_ms", 0)[0]
        if not isinstance(host, str) or not host:
            raise RefusedError("bad_value", "host is not a text")
        if not (1 <= port <= 65535 and 0 <= period_ms <= 100):
            raise RefusedError("bad_value", "port is not from 1 to 65535, or period_ms not from 0 to 100")
        if self._fri_version == "none":
            raise RefusedError("not_ready", "this controller has no FRI")
        self._end_fri()
        if period_ms:
            cycles = max(1, round(seconds(period_ms) / PERIOD_S))
            self._fri = Session(self.controller, self._host, (host, int(port)), self._fri_version, cycles)
        return {}

    def _end_fri(self) -> None:
        if self._fri is not None:
            self._fri.close()
        self._fri = None

    def _pendant(self, words: list[str]) -> str:
        """Carry out what a person does at the smartPAD or the stop buttons."""
        match words:
            case ["mode", mode] if mode in MODES:
                self.controller.mode = mode
            case ["stop", safety] if safety in SAFETY[1:]:
                self.controller.stop_safely(safety)
            case ["release"]:
                self.controller.release()
            case ["override", percent] if percent.isdigit() and 0 < int(percent) <= 100:
                self.controller.override = int(percent) / 100
            case _:
                return f"no: mode {'|'.join(MODES)}, stop {'|'.join(SAFETY[1:])}, release, override PERCENT"
        return "ok"

    def close(self) -> None:
        """Close every socket."""
        self._end_fri()
        for key in list(self._selector.get_map().values()):
            if isinstance(key.fileobj, socket.socket):
                key.fileobj.close()
        self._selector.close()
        if self._world is not None:
            self._world.close()


def _error(sequence: int | None, code: str, what: str) -> dict[str, object]:
    return {"is": "err", "seq": sequence, "motion": None, "code": code, "what": what}


def _numbers(line: dict[str, object], name: str, count: int) -> list[float]:
    """A list of `count` finite numbers, or a single number if `count` is 0. Raises RefusedError."""
    value = line.get(name)
    values = cast("list[object]", value) if count and isinstance(value, list) else [value]
    numbers = [
        float(v) for v in values if isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v)
    ]
    if len(numbers) != max(count, 1) or len(values) != len(numbers):
        raise RefusedError("bad_value", f"{name} is not {f'a list of {count} numbers' if count else 'a number'}")
    return numbers


def _positive(line: dict[str, object], name: str) -> float:
    value = _numbers(line, name, 0)[0]
    if value <= 0:
        raise RefusedError("bad_value", f"{name} is not above 0")
    return value
