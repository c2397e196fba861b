"""The controller's sockets (RTDE, dashboard and script port) in one thread, and its link to the world."""

from __future__ import annotations

import json
import logging
import selectors
import socket
import struct
import time
from collections.abc import Callable

from simulators.serve import SimulatorError, Termination
from simulators.ur_controller import fields
from simulators.ur_controller import rtde_codec as codec
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.dashboard import WELCOME, Dashboard
from simulators.ur_controller.program import Interpreter, ScriptReader

_LOG = logging.getLogger(__name__)

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
MAX_BACKLOG_BYTES = 1 << 18  # a client that does not read loses data packages beyond this
MOST_RECIPES = 255  # the recipe number is one byte
LONGEST_LINE = 1 << 16
WORLD_MOVING_S, WORLD_STILL_S = 0.016, 0.1


class Link:
    """An accepted connection with its unsent bytes."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.out = bytearray()
        self.dead = False
        self.muted_until_s = 0.0

    def send(self, data: bytes) -> None:
        """Send now, or later when the peer reads again."""
        if not self.dead and time.monotonic() >= self.muted_until_s:
            self.out += data
            self.flush()

    def flush(self) -> None:
        """Send the queued bytes, as far as the peer reads."""
        try:
            while self.out:
                del self.out[: self.socket.send(self.out)]
        except BlockingIOError:
            return
        except OSError:
            self.dead = True

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
        types = [self._server.output_types.get(name, "NOT_FOUND") for name in names]
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
        types = [
            "IN_USE" if owners.get(name, self) is not self else self._server.input_types.get(name, "NOT_FOUND")
            for name in names
        ]
        number = len(self._inputs) + 1
        if not names or "NOT_FOUND" in types or "IN_USE" in types or number > MOST_RECIPES:
            number = 0
        else:
            self._inputs[number] = codec.Recipe(number, names, types)
            owners.update(dict.fromkeys(names, self))
        self.send(codec.setup_reply(codec.SETUP_INPUTS, number, types))

    @property
    def only_receives(self) -> bool:
        """Whether the client has set up outputs but no inputs."""
        return self._output is not None and not self._inputs

    @property
    def streaming(self) -> bool:
        """Whether the client wants data packages and reads them."""
        return self._streaming and not self.dead and len(self.out) < MAX_BACKLOG_BYTES

    def stream(self, now_s: float) -> None:
        """Send a data package if one is due."""
        if self._output is None or now_s < self._next_s - 0.0005:
            return
        self._next_s = max(self._next_s + self._every_s, now_s - self._every_s)
        controller = self._server.controller
        generation, data = self._packed
        if generation != controller.generation or self._timestamp_at is None:
            values = self._server.values()
            flat: list[float] = []
            for name, kind in zip(self._output.names, self._output.types, strict=True):
                value = values.get(name) or self._server.register(name) or (0,) * codec.LENGTHS[kind]
                flat.extend(value)
            if "timestamp" in self._output.names and self._timestamp_at is None:
                raise SimulatorError("timestamp without a place")
            data = self._output.pack(flat)
            self._packed = (controller.generation, data)
        if self._timestamp_at is not None:  # the bytes of a robot at rest differ only in the timestamp
            at = self._timestamp_at
            data = data[:at] + struct.pack(">d", controller.time_s) + data[at + 8 :]
        self.send(data)


class LineLink(Link):
    """One dashboard client."""

    def __init__(self, connection: socket.socket, server: Server) -> None:
        super().__init__(connection)
        self._server = server
        self._dashboard = Dashboard(server.controller, server.interpreter)
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
            self.send(f"{self._dashboard.answer(line)}\n".encode())
            if line.lower() in ("quit", "shutdown"):
                self.dead = True


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


class WorldLink:
    """Reports the arm's joints to the world; reconnects by itself and never blocks."""

    def __init__(self, address: tuple[str, int], arm: str) -> None:
        self._address, self._arm = address, arm
        self._socket: socket.socket | None = None
        self._next_s = 0.0
        self._generation = -1

    def push(self, controller: Controller, now_s: float) -> None:
        """Send the joints if they changed, and otherwise now and then."""
        moving = controller.generation != self._generation
        if now_s < self._next_s - (WORLD_STILL_S - WORLD_MOVING_S if moving else 0.0):
            return
        self._next_s = now_s + WORLD_STILL_S
        self._generation = controller.generation
        message = {"op": "robot", "arm": self._arm, "q": list(controller.actual_q), "t": controller.time_s}
        try:
            if self._socket is None:
                self._socket = socket.create_connection(self._address, timeout=0.2)
                self._socket.setblocking(False)
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            _LOG.warning("world %s:%d: %s", *self._address, error)
            self.close()
            self._next_s = now_s + 1.0

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Server:
    """Listens on the three ports and advances the controller in real time."""

    def __init__(self, controller: Controller, host: str, world: WorldLink | None) -> None:
        self.controller = controller
        self.interpreter = Interpreter(controller)
        self.output_types = fields.outputs(controller.version)
        self.input_types = fields.inputs(controller.version)
        self.owners: dict[str, Link] = {}
        self._world = world
        self._links: list[Link] = []
        # select() waits in microseconds; epoll's milliseconds are half a cycle long.
        self._selector = selectors.SelectSelector()
        self._stalled_until_s = 0.0
        self._values: tuple[int, dict[str, tuple[float, ...]]] = (-1, {})
        self._listen(host, RTDE_PORT, lambda s: RtdeLink(s, self))
        self._listen(host, DASHBOARD_PORT, lambda s: LineLink(s, self))
        self._listen(host, SCRIPT_PORT, lambda s: ScriptLink(s, self))

    def _listen(self, host: str, port: int, make: Callable[[socket.socket], Link]) -> None:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            listener.close()
            self.close()
            raise SimulatorError(f"cannot listen on {host}:{port}: {error.strerror}") from error
        listener.listen(8)
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, make)

    # --- what links ask ------------------------------------------------------------------------------------

    def values(self) -> dict[str, tuple[float, ...]]:
        """The field values of this cycle, computed once for all clients."""
        if self._values[0] != self.controller.generation:
            self._values = (self.controller.generation, self.controller.values())
        return self._values[1] | {"timestamp": (self.controller.time_s,)}

    def register(self, name: str) -> tuple[float, ...] | None:
        """The value of a register field; None if there is no such register."""
        direction, _, rest = name.partition("_")
        if direction not in ("output", "input") or "_register_" not in rest:
            return None
        registers = self.controller.outputs if direction == "output" else self.controller.inputs
        kind, _, index = rest.partition("_register_")
        return (registers.ints[int(index)],) if kind == "int" else (registers.doubles[int(index)],)

    def faulty(self, link: Link, message: str) -> bool:
        """Whether the fault plan spoils this message: by a dropped link, silence or a refusal."""
        fault = self.controller.faults.check(self.controller.device, message)
        if fault is None:
            return False
        _LOG.warning("fault: %s on %s", fault.kind, message)
        if fault.kind == "drop":
            link.dead = True
        elif fault.kind == "stall":
            seconds = float(fault.value) if isinstance(fault.value, (int, float)) else 1e9
            link.muted_until_s = time.monotonic() + seconds
        elif fault.kind == "reject" and isinstance(link, LineLink):
            link.send(b"Failed to execute\n")
        elif fault.kind == "protective_stop":
            self.controller.protective_stop("fault plan")
            return False
        return True

    # --- loop ------------------------------------------------------------------------------------------------

    def run(self, termination: Termination) -> None:
        """Serve until the termination is set."""
        last_s = next_s = time.monotonic()
        while not termination.is_set():
            self._exchange(max(0.0, next_s - time.monotonic()))
            now_s = time.monotonic()
            if now_s < next_s:
                continue
            next_s = max(next_s + self.controller.step_s, now_s - 0.02)
            self.interpreter.step()
            self.controller.advance(now_s - last_s)
            last_s = now_s
            # The program must see the end of a motion in the same cycle.
            self.interpreter.step()
            self._stream(now_s)
            if self._world is not None:
                self._world.push(self.controller, now_s)

    def _exchange(self, timeout_s: float) -> None:
        for key, _ in self._selector.select(timeout_s):
            if isinstance(key.data, Link):
                self._read(key.data)
            else:
                listener = key.fileobj
                assert isinstance(listener, socket.socket)
                self._accept(listener, key.data)
        for link in [link for link in self._links if link.dead]:
            self._drop(link)

    def _accept(self, listener: socket.socket, make: Callable[[socket.socket], Link]) -> None:
        connection, _ = listener.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link = make(connection)
        self._links.append(link)
        self._selector.register(connection, selectors.EVENT_READ, link)
        if isinstance(link, RtdeLink):
            self.faulty(link, "rtde_connect")

    def _read(self, link: Link) -> None:
        try:
            data = link.socket.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            link.receive(data)
        else:
            link.dead = True

    def _drop(self, link: Link) -> None:
        self._selector.unregister(link.socket)
        link.socket.close()
        self._links.remove(link)
        for name in [name for name, owner in self.owners.items() if owner is link]:
            del self.owners[name]

    def _stream(self, now_s: float) -> None:
        controller = self.controller
        fault, controller.stream_fault = controller.stream_fault, None
        if fault is None and controller.faults.faults:
            fault = controller.faults.check(controller.device, "stream")
        if fault is not None and fault.kind == "stall":
            seconds = float(fault.value) if isinstance(fault.value, (int, float)) else 1e9
            self._stalled_until_s = now_s + seconds
        elif fault is not None:
            for link in self._links:
                if isinstance(link, RtdeLink) and (fault.value != "receivers" or link.only_receives):
                    link.dead = True
        if now_s < self._stalled_until_s:
            return
        for link in self._links:
            if link.out:
                link.flush()
            if isinstance(link, RtdeLink) and link.streaming:
                link.stream(now_s)

    def close(self) -> None:
        """Close every socket."""
        for key in list(self._selector.get_map().values()):
            if isinstance(key.fileobj, socket.socket):
                key.fileobj.close()
        self._selector.close()
        if self._world is not None:
            self._world.close()
