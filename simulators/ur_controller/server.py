"""The controller's ports in one thread, with their clients, and its link to the world."""

from __future__ import annotations

import logging
import math
import selectors
import socket
import time
from collections.abc import Callable

from simulators.connection import accept
from simulators.serve import SimulatorError, Termination, listening
from simulators.ur_controller import fields
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.dashboard import Words
from simulators.ur_controller.links import EARLY_S, LineLink, Link, PendantLink, PrimaryLink, RtdeLink, ScriptLink
from simulators.ur_controller.program import Interpreter
from simulators.world_link import WorldLink

_LOG = logging.getLogger(__name__)

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, PRIMARY_PORT = 30004, 29999, 30003, 30001
LONGEST_REST_S = 0.008
CUT_OFF_S = 10.0  # without a byte read, after which a client is disconnected
_SEND_BUFFER_BYTES = 1 << 14  # of the system, for a client that does not read
# EtherNet/IP and PROFINET reserve the lower half of the general purpose registers.
_FIELDBUS = frozenset(f"input_{kind}_register_{number}" for kind in ("int", "double") for number in range(24))


class Server:
    """Listens on the four ports and the pendant's, and advances the controller in real time."""

    def __init__(
        self,
        controller: Controller,
        host: str,
        world: WorldLink | None,
        pendant_port: int,
        *,
        cut_off_s: float = CUT_OFF_S,
        fieldbus: bool = False,
        words: Words | None = None,
    ) -> None:
        self.controller = controller
        self.words = words  # of a recorded dashboard
        self.reserved = _FIELDBUS if fieldbus else frozenset[str]()  # registers that no client may write
        self._cut_off_s = cut_off_s
        self.interpreter = Interpreter(controller)
        self.output_types = fields.outputs(controller.version)
        self.input_types = fields.inputs(controller.version)
        self.owners: dict[str, Link] = {}
        self._world = world
        self._links: list[Link] = []
        # select() waits in microseconds; epoll's milliseconds are half a cycle long.
        self._selector = selectors.SelectSelector()
        self._stalled_until_s = 0.0
        self._advanced_s = 0.0
        self._values: tuple[int, dict[str, tuple[float, ...]]] = (-1, {})
        self._listen(host, RTDE_PORT, lambda s: RtdeLink(s, self))
        self._listen(host, DASHBOARD_PORT, lambda s: LineLink(s, self))
        self._listen(host, SCRIPT_PORT, lambda s: ScriptLink(s, self))
        self._listen(host, PRIMARY_PORT, lambda s: PrimaryLink(s, self))
        self._listen(host, pendant_port, lambda s: PendantLink(s, self))

    def _listen(self, host: str, port: int, make: Callable[[socket.socket], Link]) -> None:
        try:
            listener = listening(host, port)
        except SimulatorError:
            self.close()
            raise
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
        """Return whether the fault plan spoils this message: by a dropped link, silence or a refusal."""
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
        elif fault.kind == "say":
            link.send(f"{fault.value}\n".encode())
        elif fault.kind == "protective_stop":
            self.controller.protective_stop("fault plan")
            return False
        return True

    # --- loop ------------------------------------------------------------------------------------------------

    def run(self, termination: Termination) -> None:
        """Serve until the termination is set."""
        self._advanced_s = next_s = due_s = time.monotonic()
        while not termination.is_set():
            if self._exchange(max(0.0, due_s - time.monotonic())):
                due_s = next_s + self._rest_s(next_s)
            now_s = time.monotonic()
            if now_s < due_s:
                continue
            next_s = max(due_s + self.controller.step_s, now_s - 0.02)
            self.interpreter.step()
            self._advance(now_s)
            # The program must see the end of a motion in the same cycle.
            self.interpreter.step()
            self._stream(now_s)
            if self._world is not None:
                self._world.push([float(v) for v in self.controller.actual_q], self.controller.time_s, now_s)
            due_s = next_s + self._rest_s(next_s)

    def _rest_s(self, next_s: float) -> float:
        """The time of those whole cycles from `next_s` on in which nothing changes and no data package is due."""
        if self.controller.busy or self.controller.faults.faults:  # faults count the cycles
            return 0.0
        streams = [link.due_s for link in self._links if isinstance(link, RtdeLink) and link.streaming]
        rest_s = min([*streams, next_s + LONGEST_REST_S]) - next_s
        step_s = self.controller.step_s
        return step_s * max(0, math.ceil((rest_s - EARLY_S) / step_s))

    def _advance(self, now_s: float) -> None:
        self.controller.advance(now_s - self._advanced_s)
        self._advanced_s = now_s

    def _exchange(self, timeout_s: float) -> bool:
        """Wait for clients and serve them; returns whether there was anything to do."""
        ready = self._selector.select(timeout_s)
        if ready and not self.controller.busy:
            self._advance(time.monotonic())  # what begins now has not gone on while the controller rested
        for key, _ in ready:
            if isinstance(key.data, Link):
                self._read(key.data)
            else:
                listener = key.fileobj
                assert isinstance(listener, socket.socket)
                self._accept(listener, key.data)
        for link in [link for link in self._links if link.dead]:
            self._drop(link)
        return bool(ready)

    def _accept(self, listener: socket.socket, make: Callable[[socket.socket], Link]) -> None:
        accepted = accept(listener)
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        link = make(accepted)
        self._links.append(link)
        self._selector.register(link.socket, selectors.EVENT_READ, link)
        if isinstance(link, RtdeLink):
            self.faulty(link, "rtde_connect")

    def _read(self, link: Link) -> None:
        data = link.read()
        if data:
            link.receive(data)

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
            if link.unread_since_s is not None and now_s - link.unread_since_s > self._cut_off_s:
                _LOG.warning("a client that has not read for %.1f s is disconnected", self._cut_off_s)
                link.dead = True
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
