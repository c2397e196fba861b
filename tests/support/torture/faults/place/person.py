"""The person in a case, who takes the first way on that the screen lists, and the observer of all motions."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from service.core.records.run_events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.monitor.snapshot import Doing
from service.runner.held_run import AnswerBy
from tests.support.rig.bench_rig import ScriptedOperator, agree, answer
from tests.support.vendor.ur_rtde_protocol import RtdeClient

_STILL_S = 0.25  # a motion after a longer rest is another one; positions arrive at least ten times a second
_MAY_MOVE = 0b11  # safety_status_bits: normal, reduced


_READS_S = 2.0  # that a run waits for its record until the person ends the program


class LeftError(Exception):
    """The person has left the question open and gone."""


class EndedWaitingError(Exception):
    """The person has read why the run waits, and ended the program to do what it says."""


@dataclass
class Person(ScriptedOperator):
    """Does what the screen lists, a few times.

    Attributes:
        fix: repair made at the device before an answer.
        patience: answers to the same question before it is left open.
        look: called several times a second.
    """

    fix: Callable[[], None] = lambda: None
    patience: int = 3
    look: Callable[[RunState], None] = lambda _state: None
    open: AskOperator | None = None
    stopped: list[AskOperator] = field(default_factory=list[AskOperator])

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        """Return the person's answer to a question, or None while there is none yet. Raises LeftError."""
        if question.for_ != "recovery":
            return agree(question, state)
        self.stopped.append(question)
        ways = [way for way in question.ways if way.available and way.verb != "abort"]
        if len(self.stopped) > self.patience or not ways:
            self.open = question
            raise LeftError
        self.fix()
        way = ways[0]
        if way.verb == "confirm":
            return answer(question, "confirm")
        return OperatorAction(action=way.verb, step=way.step, reason="as the screen says")

    def stuck(self, why: str, for_s: float) -> None:
        """Read why the run waits, and end the program. Raises EndedWaitingError."""
        if for_s > _READS_S:
            raise EndedWaitingError(why)

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        """Observe what the runner is doing."""
        del doing, pedal_armed, asked
        self.look(state)


class Motions:
    """Times at which an arm began to move, and at which it was in a safety stop: host time.monotonic()."""

    def __init__(self) -> None:
        self.begun_s: list[float] = []
        self.stopped_s: list[float] = []

    def began(self, _number: int = 0) -> None:
        """Note the start of a motion, reported by an in-memory arm."""
        self.begun_s.append(time.monotonic())


class PlaceEye(Motions):
    """Observes a simulated device through what it tells the simulated world of its place, past the proxy."""

    def __init__(self) -> None:
        super().__init__()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = "{}:{}".format(*self._listener.getsockname())  # for the option --world

    def begin(self) -> None:
        """Observe in a thread; not before all simulators are forked."""
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Stop observing."""
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                threading.Thread(target=self._read, args=(link,), daemon=True).start()

    def _read(self, link: socket.socket) -> None:
        place: object = None
        moved_s = time.monotonic()
        with contextlib.suppress(OSError), link, link.makefile("r") as lines:
            for line in lines:
                told, now_s = json.loads(line), time.monotonic()
                before, place = place, told.get("q") or told.get("T_world_camera")
                if before is not None and before != place:
                    if now_s - moved_s > _STILL_S:
                        self.begun_s.append(now_s)
                    moved_s = now_s


class ArmEye(Motions):
    """Observes a simulated controller over a connection of its own, past the proxy."""

    def __init__(self, host: str) -> None:
        super().__init__()
        self._client = RtdeClient(host)
        self._client.output_setup(["target_qd", "safety_status_bits"], 125.0)
        self._client.start()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop observing."""
        with contextlib.suppress(OSError):
            self._client.shutdown()
        self._thread.join(5.0)
        self._client.close()

    def _run(self) -> None:
        moving = False
        with contextlib.suppress(OSError):
            while True:
                data, now_s = self._client.data(), time.monotonic()
                moves = any(data["target_qd"])
                if moves and not moving:
                    self.begun_s.append(now_s)
                moving = moves
                if not int(data["safety_status_bits"][0]) & _MAY_MOVE:
                    self.stopped_s.append(now_s)
