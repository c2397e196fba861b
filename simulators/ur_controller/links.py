"""The controller's ends of its connections: RTDE, dashboard, script port, and the pendant's hand."""

from __future__ import annotations

import logging
import socket
import struct
import time
from typing import TYPE_CHECKING

from simulators.connection import Connection
from simulators.serve import SimulatorError
from simulators.ur_controller import rtde_codec as codec
from simulators.ur_controller.dashboard import WELCOME, Dashboard
from simulators.ur_controller.pendant import Pendant
from simulators.ur_controller.primary import kinematics_message
from simulators.ur_controller.program import ScriptReader
from simulators.ur_controller.spoilt import SpoiltFields

if TYPE_CHECKING:
    from simulators.ur_controller.server import Server

_LOG = logging.getLogger(__name__)

MAX_BACKLOG_BYTES = 1 << 18  # a client that does not read loses data packages beyond this
MOST_RECIPES = 255  # the recipe number is one byte
LONGEST_LINE = 1 << 16
EARLY_S = 0.0005  # a data package is sent in a cycle that begins this much before it is due


class Link(Connection):
    """A connection that a fault can silence."""

    def __init__(self, accepted: socket.socket) -> None:
        super().__init__(accepted)
        self.muted_until_s = 0.0
        self.unread_since_s: float | None = None  # the time.monotonic() since which the peer has read nothing

    def send(self, data: bytes) -> None:
        """Send now, or later when the peer reads again; nothing while silenced."""
        if not self.dead and time.monotonic() >= self.muted_until_s:
            super().send(data)

    def flush(self) -> None:
        """Send the queued bytes, and note since when the peer has read none of them."""
        waiting = len(self.out)
        super().flush()
        if not self.out:
            self.unread_since_s = None
        elif self.unread_since_s is None or len(self.out) < waiting:
            self.unread_since_s = time.monotonic()

    def receive(self, data: bytes) -> None:
        """Handle bytes from the peer."""
        raise NotImplementedError


class RtdeLink(Link):
    """One RTDE client."""

    def __init__(self, connection: socket.socket, server: Server) -> None:
        super().__init__(connection)
        self._server = server
        self._reader = codec.FrameReader()
        self._inputs: dict[int, codec.Recipe] = {}
        self._output: codec.Recipe | None = None
        self._every_s = server.controller.step_s
        self._next_s = 0.0
        self._streaming = False
        self._packed: tuple[int, bytes] = (-1, b"")
        self._timestamp_at: int | None = None
        self._spoilt = SpoiltFields(server.controller.faults, server.controller.device)

    def receive(self, data: bytes) -> None:
        """Handle RTDE frames."""
        try:
            for kind, payload in self._reader.feed(data):
                if not self._server.faulty(self, f"rtde_{chr(kind)}"):
                    self._message(kind, payload)
        except codec.FrameError as error:
            _LOG.warning("RTDE client dropped: %s", error)
            self.dead = True

    def _message(self, kind: int, payload: bytes) -> None:
        controller = self._server.controller
        if kind == codec.DATA_PACKAGE:
            recipe = self._inputs.get(payload[0]) if payload else None
            if recipe is not None:
                self._apply(recipe, payload)
        elif kind == codec.REQUEST_PROTOCOL_VERSION:
            wanted = struct.unpack_from(">H", payload)[0] if len(payload) >= 2 else 0
            self.send(codec.frame(kind, bytes([wanted == codec.PROTOCOL_VERSION])))
        elif kind == codec.GET_CONTROL_VERSION:
            self.send(codec.frame(kind, struct.pack(">4I", *controller.version, 0, 106331)))
        elif kind == codec.SETUP_OUTPUTS:
            self._set_up_outputs(payload)
        elif kind == codec.SETUP_INPUTS:
            self._set_up_inputs(payload)
        elif kind in (codec.START, codec.PAUSE):
            self._streaming = kind == codec.START and self._output is not None
            self._next_s = time.monotonic()
            self.send(codec.frame(kind, bytes([kind == codec.PAUSE or self._streaming])))

    def _apply(self, recipe: codec.Recipe, payload: bytes) -> None:
        try:
            written = recipe.unpack(payload)
        except codec.FrameError as error:  # the frame itself was complete, so the link stays open
            _LOG.warning("data package ignored: %s", error)
            return
        self._server.controller.apply(written)
        self._server.interpreter.step()

    def _set_up_outputs(self, payload: bytes) -> None:
        frequency_hz, names = codec.parse_setup_outputs(payload)
        known = self._server.output_types
        types = ["NOT_FOUND" if self._spoilt.absent(name) else known.get(name, "NOT_FOUND") for name in names]
        found = "NOT_FOUND" not in types and bool(names)
        self._output = codec.Recipe(1, names, types) if found else None
        self._timestamp_at = None
        self._packed = (-1, b"")
        if self._output is not None and "timestamp" in names:
            before = types[: names.index("timestamp")]
            self._timestamp_at = 4 + struct.calcsize(">" + "".join(codec.FORMATS[t] for t in before))
        self._every_s = max(1.0 / frequency_hz if frequency_hz > 0 else 0.0, self._server.controller.step_s)
        self.send(codec.setup_reply(codec.SETUP_OUTPUTS, int(found), types))

    def _set_up_inputs(self, payload: bytes) -> None:
        names = codec.parse_names(payload)
        owners = self._server.owners
        taken = {name for name in names if owners.get(name, self) is not self} | self._server.reserved
        types = ["IN_USE" if name in taken else self._server.input_types.get(name, "NOT_FOUND") for name in names]
        number = len(self._inputs) + 1
        if not names or "NOT_FOUND" in types or "IN_USE" in types or number > MOST_RECIPES:
            number = 0
        else:
            self._inputs[number] = codec.Recipe(number, names, types)
            owners.update(dict.fromkeys(names, self))
        self.send(codec.setup_reply(codec.SETUP_INPUTS, number, types))

    @property
    def only_receives(self) -> bool:
        """Return whether the client has set up outputs but no inputs."""
        return self._output is not None and not self._inputs

    @property
    def streaming(self) -> bool:
        """Return whether the client wants data packages and reads them."""
        return self._streaming and not self.dead and len(self.out) < MAX_BACKLOG_BYTES

    @property
    def due_s(self) -> float:
        """The time.monotonic() at which the next data package is due."""
        return self._next_s

    def stream(self, now_s: float) -> None:
        """Send a data package if one is due."""
        if self._output is None or now_s < self._next_s - EARLY_S:
            return
        self._next_s = max(self._next_s + self._every_s, now_s - self._every_s)
        controller = self._server.controller
        if self._spoilt:
            self._send_spoilt(self._output)
            return
        generation, data = self._packed
        if generation != controller.generation or self._timestamp_at is None:
            flat = [number for value in self._values(self._output) for number in value]
            if "timestamp" in self._output.names and self._timestamp_at is None:
                raise SimulatorError("timestamp without a place")
            data = self._output.pack(flat)
            self._packed = (controller.generation, data)
        if self._timestamp_at is not None:  # the bytes of a robot at rest differ only in the timestamp
            at = self._timestamp_at
            data = data[:at] + struct.pack(">d", controller.time_s) + data[at + 8 :]
        self.send(data)

    def _values(self, recipe: codec.Recipe) -> list[tuple[float, ...]]:
        values = self._server.values()
        return [
            values.get(name) or self._server.register(name) or (0,) * codec.LENGTHS[kind]
            for name, kind in zip(recipe.names, recipe.types, strict=True)
        ]

    def _send_spoilt(self, recipe: codec.Recipe) -> None:
        self._spoilt.next_package()
        fields = zip(recipe.names, recipe.types, self._values(recipe), strict=True)
        self.send(recipe.pack([number for field in fields for number in self._spoilt.value(*field)]))


class LineLink(Link):
    """One dashboard client."""

    def __init__(self, connection: socket.socket, server: Server) -> None:
        super().__init__(connection)
        self._server = server
        self._dashboard = Dashboard(server.controller, server.interpreter, server.words)
        self._rest = b""
        if not server.faulty(self, "dashboard_connect"):
            self.send(f"{WELCOME}\n".encode())

    def receive(self, data: bytes) -> None:
        """Handle complete lines."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-LONGEST_LINE:]
        for raw in lines:
            line = raw.decode("utf-8", "replace").strip()
            if not line or self._server.faulty(self, "dashboard"):
                continue
            if self._server.faulty(self, f"dashboard {' '.join(line.lower().split())}"):
                continue
            self.send(f"{self._dashboard.answer(line)}\n".encode())
            if line.lower() in ("quit", "shutdown"):
                self.dead = True


class PendantLink(Link):
    """One who acts for a person at the pendant."""

    def __init__(self, connection: socket.socket, server: Server) -> None:
        super().__init__(connection)
        self._pendant = Pendant(server.controller, server.interpreter)
        self._rest = b""

    def receive(self, data: bytes) -> None:
        """Carry out complete lines."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-LONGEST_LINE:]
        for raw in lines:
            self.send(f"{self._pendant.carry_out(raw.decode('utf-8', 'replace'))}\n".encode())


class PrimaryLink(Link):
    """One client of the primary interface, which is told the kinematics; the rest of the robot state is not sent."""

    def __init__(self, connection: socket.socket, server: Server) -> None:
        super().__init__(connection)
        if not server.faulty(self, "primary"):
            self.send(kinematics_message(server.controller.model))

    def receive(self, data: bytes) -> None:
        """Ignore it: programs come by the script port."""


class ScriptLink(Link):
    """One client of the script port; nothing is sent to it."""

    def __init__(self, connection: socket.socket, server: Server) -> None:
        super().__init__(connection)
        self._server = server
        self._reader = ScriptReader()

    def receive(self, data: bytes) -> None:
        """Handle script text."""
        for program in self._reader.feed(data):
            if self._server.controller.local:
                _LOG.warning("a program was ignored: the controller is in local control")
            elif not self._server.faulty(self, "script"):
                self._server.interpreter.load(program)
