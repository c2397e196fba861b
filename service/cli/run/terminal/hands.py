"""The hands of a simulated technician: on a simulated rig, confirming something also does it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from service.core.errors import OrthocaptureError
from service.core.protocol.models import Step
from service.core.run.noted import HandWork
from service.core.text.files import parse_json

_ASKS_FOR_A_PHOTOGRAPH = ("next: ", "take the photograph now")  # beginnings of messages that ask for a photograph
_LONGEST_ANSWER = 1 << 20  # characters
_PATIENCE_S = 900  # a CT volume or a scan of the whole scene takes minutes on a busy machine


@dataclass
class SimulatedHands:
    """Acts on the simulated world through its control socket; without an address (a real rig) it does nothing."""

    address: str | None  # HOST:PORT
    _done: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])

    def do(self, step: Step, attempt: int) -> None:
        """Do what a technician does before confirming this step, once for each attempt. Raises as `act` does."""
        wanted = (action.model_dump(exclude_none=True) for action in step.simulated_hands)
        self.act(step.id, attempt, [HandWork.model_validate(action) for action in wanted])

    def act(self, step: str, attempt: int, actions: Sequence[HandWork]) -> None:
        """Do these actions (those of simulators/rig/world_server.py) one after the other; once for each attempt.

        Raises OrthocaptureError if the simulated world does not answer or cannot do one of them.
        """
        if self.address is None or (step, attempt) in self._done:
            return
        for action in actions:
            answer = _ask_world(self.address, {**action.model_dump(mode="json"), "op": "act"})
            if not answer.get("ok"):
                raise OrthocaptureError(
                    f"the simulated technician could not {action.action}: {answer.get('error')}",
                    where=f"step {step}",
                    remedy="Give the step an action that simulators/rig/world_server.py lists",
                )
        self._done.add((step, attempt))

    def read(self, message: str) -> None:
        """Let the technician read a message of the screen."""
        if self.address is not None and message.startswith(_ASKS_FOR_A_PHOTOGRAPH):
            _ask_world(self.address, {"op": "act", "action": "read", "words": message})


def _ask_world(address: str, request: dict[str, Any]) -> dict[str, Any]:
    host, _, port = address.rpartition(":")
    deadline_s = time.monotonic() + _PATIENCE_S
    try:
        with socket.create_connection((host, int(port)), timeout=10) as link:
            link.settimeout(deadline_s - time.monotonic())
            link.sendall(json.dumps(request).encode() + b"\n")
            with link.makefile("r", encoding="utf-8", errors="replace") as answers:
                line = answers.readline(_LONGEST_ANSWER) or '{"ok": false, "error": "no answer"}'
                answer = parse_json(line, name=address, remedy="Start the rig again")
                return answer if isinstance(answer, dict) else {}
    except (OSError, ValueError) as error:
        raise OrthocaptureError(
            f"the simulated technician does not answer: {error}", where=address, remedy="Start the rig again"
        ) from error
