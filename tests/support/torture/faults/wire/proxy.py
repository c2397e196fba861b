"""A proxy between a driver and its simulator, in a process of its own, that spoils one message unnoticed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import struct
import time
import tty
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, Literal

from tests.support.torture.faults.wire.framing import (
    RESPONSE,
    START_DATA,
    Dicom,
    Framer,
    Grbl,
    JsonLines,
    Lines,
    PtpIp,
    Rtde,
    Script,
    denied,
    refused,
)
from tests.support.torture.faults.wire.gige import GigeVision
from tests.support.torture.faults.wire.streams import Datagrams, Link, Pipe, Stream

Column = Literal[
    "drop", "stall", "truncate", "corrupt", "duplicate", "reorder", "reject",
    "away_1s", "away_30s", "away_never", "slow", "noise", "mutated",
]  # fmt: skip
AWAY_S: dict[str, float | None] = {"away_1s": 1.0, "away_30s": 30.0, "away_never": None}
SLOW_S = 0.3  # delay of every message of the kind
_IDLE_S = 0.2  # time after which an incomplete message is passed on
_FLIPS = 24  # maximum number of corrupted bytes of a message, from its middle on


@dataclass(frozen=True, slots=True)
class Spoil:
    """The fault of the `nth` message (from 1) of a kind, and of the `times` - 1 after it, once the proxy is armed."""

    kind: str
    column: Column
    nth: int = 1
    times: int = 1


@dataclass(frozen=True, slots=True)
class Wire:
    """One TCP port or pseudo-terminal: the driver's end and the simulator's address.

    Of FRI, whose messages the controller begins, `listen` is where it sends them, and `upstream` the driver's port.
    `rewrite` is replaced in requests, as by a router that translates addresses.
    """

    device: Literal["robot", "camera", "lightbox", "table", "kuka", "ct", "gige"]
    protocol: Literal["rtde", "dashboard", "script", "ptpip", "serial", "grbl", "kuka", "fri", "dicom", "gige"]
    listen: tuple[str, int] | str
    upstream: tuple[str, int] | str
    rewrite: tuple[bytes, bytes] = (b"", b"")


class Proxy:
    """All wires of one device. It appends one JSON line to `journal` for each thing it does."""

    def __init__(self, wires: list[Wire], spoil: Spoil | None, journal: Path, seed: int) -> None:
        self._wires, self._spoil, self._journal = wires, spoil, journal
        self._rng = Random(seed)
        self._armed = False
        self._count = 0
        self._slow = False
        self._links: set[Link] = set()
        self._servers: list[asyncio.Server] = []
        self._terminals: list[tuple[int, int, str]] = []
        self._tasks: set[asyncio.Task[None]] = set()

    async def serve(self, control: int) -> None:
        """Serve until the other end of `control` is closed; a byte received there arms the fault."""
        await self._plug_in()
        os.write(control, b"r")
        pipe = Pipe(control)
        while await pipe.read():
            self._armed = True
            self._note("armed")
        for link in list(self._links):
            link.close()
        self._unplug_terminals()

    # --- connections ------------------------------------------------------------------------------------

    async def _plug_in(self) -> None:
        for wire in self._wires:
            if isinstance(wire.listen, str):
                self._plug_in_terminal(wire)
            elif wire.protocol == "fri":
                await self._plug_in_datagrams(wire)
            elif wire.protocol == "gige":
                await self._plug_in_gige(wire)
            else:
                handler = self._handler(wire)
                server = await asyncio.start_server(handler, *wire.listen, reuse_address=True)
                self._servers.append(server)

    def _plug_in_terminal(self, wire: Wire) -> None:
        assert isinstance(wire.listen, str)
        assert isinstance(wire.upstream, str)
        master, slave = os.openpty()
        tty.setraw(slave)
        far = os.open(wire.upstream, os.O_RDWR | os.O_NOCTTY)
        link_path = Path(wire.listen)
        link_path.unlink(missing_ok=True)
        link_path.symlink_to(os.ttyname(slave))
        self._terminals.append((master, slave, wire.listen))
        near_pipe, far_pipe = Pipe(master), Pipe(far)

        def close() -> None:
            for descriptor in (master, far):
                asyncio.get_running_loop().remove_reader(descriptor)  # the descriptor's number is about to be reused
            for pump in pumps:
                pump.cancel()
            for descriptor in (master, slave, far):
                with contextlib.suppress(OSError):
                    os.close(descriptor)

        link = Link(close)
        self._links.add(link)
        pumps = [
            self._begin(self._pump(wire, link, near_pipe, far_pipe, answers=False)),
            self._begin(self._pump(wire, link, far_pipe, near_pipe, answers=True)),
        ]

    async def _plug_in_datagrams(self, wire: Wire) -> None:
        assert not isinstance(wire.listen, str)
        assert not isinstance(wire.upstream, str)
        controller, driver = Datagrams(), Datagrams()
        driver.peer = wire.upstream
        link = Link(lambda: (controller.close(), driver.close()))

        async def from_controller(data: bytes) -> None:
            await self._pass(wire, link, "message", data, driver, answers=True)

        async def from_driver(data: bytes) -> None:
            await self._pass(wire, link, "reply", data, controller, answers=False)

        await controller.open(wire.listen, lambda data: self._begin(from_controller(data)))
        await driver.open((wire.listen[0], 0), lambda data: self._begin(from_driver(data)))
        self._links.add(link)

    async def _plug_in_gige(self, wire: Wire) -> None:
        assert not isinstance(wire.listen, str)
        assert not isinstance(wire.upstream, str)
        camera = GigeVision(wire.listen, wire.upstream, self._begin, partial(self._pass, wire))
        await camera.open()
        self._links.add(Link(camera.close))

    def _unplug_terminals(self) -> None:
        for _, _, path in self._terminals:
            Path(path).unlink(missing_ok=True)
        self._terminals.clear()

    def _handler(
        self, wire: Wire
    ) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[Any, Any, None]]:
        async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            near = Stream(reader, writer)
            assert not isinstance(wire.upstream, str)
            try:
                far = Stream(*await asyncio.open_connection(*wire.upstream))
            except OSError:
                near.cut()
                return

            def close() -> None:
                near.cut()
                far.cut()

            link = Link(close)
            self._links.add(link)
            pumps = [
                asyncio.create_task(self._pump(wire, link, near, far, answers=False)),
                asyncio.create_task(self._pump(wire, link, far, near, answers=True)),
            ]
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.sleep(0.02)  # time for what the other direction has not sent yet
            for pump in pumps:
                pump.cancel()
            link.close()
            self._links.discard(link)

        return connected

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _pump(
        self, wire: Wire, link: Link, source: Stream | Pipe, target: Stream | Pipe, *, answers: bool
    ) -> None:
        framer = _framer(wire, link, answers=answers)
        reading: asyncio.Task[bytes] | None = None
        try:
            while True:
                reading = reading or asyncio.create_task(source.read())
                done, _ = await asyncio.wait([reading], timeout=_IDLE_S)
                if not done:
                    late = framer.rest() + link.held.pop(answers, b"")
                    if late and answers not in link.stalled:
                        await target.write(late)
                    continue
                data, reading = reading.result(), None
                if not data:
                    return
                for kind, message in framer.feed(data):
                    await self._pass(wire, link, kind, message, target, answers=answers)
        except (OSError, ValueError):
            return
        finally:
            if reading is not None:
                reading.cancel()

    # --- messages ---------------------------------------------------------------------------------------

    async def _pass(
        self,
        wire: Wire,
        link: Link,
        kind: str,
        message: bytes,
        target: Stream | Pipe | Datagrams,
        *,
        answers: bool,
    ) -> None:
        if answers in link.stalled:
            return
        if wire.rewrite[0] and not answers:
            message = message.replace(*wire.rewrite)
        spoilt = self._spoilt(wire, link, kind, message, answers=answers)
        if self._slow and self._spoil is not None and kind == self._spoil.kind:
            await asyncio.sleep(SLOW_S)
        if spoilt:
            await target.write(spoilt)
            if held := link.held.pop(answers, b""):
                await target.write(held)

    def _spoilt(self, wire: Wire, link: Link, kind: str, message: bytes, *, answers: bool) -> bytes:  # noqa: PLR0911, PLR0912 - one line a column
        """Return what is passed on instead of a message."""
        if link.refusing:
            link.refusing = struct.unpack_from("<I", message, 4)[0] != RESPONSE
            return b""
        spoil = self._spoil
        if spoil is None or not self._armed or kind != spoil.kind:
            return message
        self._count += 1
        lasting = spoil.column in ("noise", "mutated")
        if self._count < spoil.nth or (not lasting and self._count >= spoil.nth + spoil.times):
            return message
        if not lasting or self._count == spoil.nth:
            self._note(spoil.column, kind=kind, bytes=len(message))
        match spoil.column:
            case "drop":
                return b""
            case "stall":
                link.stalled.add(answers)
                return b""
            case "truncate":
                return message[: len(message) // 2]
            case "corrupt" | "mutated":
                return self._corrupted(message)
            case "noise":
                return self._rng.randbytes(len(message))
            case "duplicate" if wire.protocol in ("fri", "gige"):  # in a datagram of its own
                link.held[answers] = message
                return message
            case "duplicate":
                return message + message
            case "reorder":
                link.held[answers] = message
                return b""
            case "reject":
                return self._refusal(wire, link, kind, message)
            case "slow":
                self._slow = True
                return message
            case _:
                self._go_away(AWAY_S[spoil.column])
                return b""

    def _corrupted(self, message: bytes) -> bytes:
        """Corrupt a message's content; its length stays right."""
        damaged = bytearray(message)
        first = min(len(message) - 1, 3 if len(message) < 64 else 12)
        for at in self._rng.sample(range(first, len(message)), min(_FLIPS, (len(message) - first + 3) // 4)):
            damaged[at] ^= self._rng.randrange(1, 256)
        return bytes(damaged)

    def _refusal(self, wire: Wire, link: Link, kind: str, message: bytes) -> bytes:
        if wire.protocol == "ptpip" and struct.unpack_from("<I", message, 4)[0] == START_DATA:
            link.refusing = True
            return denied(message[8:12])
        return refused(wire.device, kind, message)

    def _go_away(self, seconds: float | None) -> None:
        """Close every connection of the device and refuse new ones for `seconds` (None: for good)."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        for link in list(self._links):
            link.close()
        self._links.clear()
        self._unplug_terminals()

        async def come_back() -> None:
            assert seconds is not None
            await asyncio.sleep(seconds)
            await self._plug_in()
            self._note("back")

        if seconds is not None:
            self._begin(come_back())

    def _note(self, what: str, **more: object) -> None:
        with self._journal.open("a") as journal:
            journal.write(json.dumps({"at_s": time.monotonic(), "what": what, **more}) + "\n")


def _framer(wire: Wire, link: Link, *, answers: bool) -> Framer:  # noqa: PLR0911 - one for each wire
    match wire.protocol:
        case "rtde":
            return Rtde(answers=answers)
        case "dashboard":
            return Lines({"connected:": "welcome"}, "answer") if answers else Lines({})
        case "script":
            return Lines({}) if answers else Script()
        case "ptpip":
            return PtpIp(link.talk, answers=answers)
        case "grbl":
            return Grbl(link.talk, answers=answers)
        case "kuka":
            return JsonLines(answers=answers)
        case "dicom":
            return Dicom(answers=answers)
        case _:  # the light box
            words = {"*idn": "identity", "light": "light", "temp": "temperature", "shutter": "shutter"}
            return Lines({**words, "pedal": "pedal", "#": "banner"}) if answers else Lines({}, "request")


@dataclass(frozen=True, slots=True)
class RunningProxy:
    """The proxy's process, as seen by the case."""

    pid: int
    control: socket.socket
    journal: Path

    def arm(self) -> None:
        """Make the proxy count and act from now on."""
        with contextlib.suppress(OSError):
            self.control.sendall(b"a")

    def deeds(self) -> list[dict[str, Any]]:
        """Return what the proxy has done so far, oldest first."""
        if not self.journal.exists():
            return []
        return [json.loads(line) for line in self.journal.read_text().splitlines()]


def start_proxy(wires: list[Wire], spoil: Spoil | None, journal: Path, seed: int) -> RunningProxy:
    """Fork the proxy, before this process has threads; returns once it listens."""
    ours, theirs = socket.socketpair()
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            ours.close()
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            os.dup2(os.open(journal.with_suffix(".log"), os.O_CREAT | os.O_APPEND | os.O_WRONLY), 2)
            asyncio.run(Proxy(wires, spoil, journal, seed).serve(theirs.fileno()))
            status = 0
        finally:
            os._exit(status)
    theirs.close()
    if ours.recv(1) != b"r":
        raise RuntimeError("the proxy did not start")
    return RunningProxy(pid, ours, journal)
