"""The hands of a simulated technician: on a simulated rig, a confirmation also does what it confirms."""

from __future__ import annotations

import json
import socket
import time
from dataclasses import dataclass, field
from typing import Any

from service.core.errors import OrthocaptureError
from service.core.protocol import Step


@dataclass
class SimulatedHands:
    """Acts on the simulated world through its control socket; without an address (a real rig) it does nothing."""

    address: str | None  # HOST:PORT
    _done: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])

    def do(self, step: Step, attempt: int) -> None:
        """What a technician does before confirming this step; once for each attempt."""
        if self.address is None or (step.id, attempt) in self._done:
            return
        for action in step.simulated_hands:
            answer = _ask_world(self.address, {"op": "act", **action.model_dump(exclude_none=True)})
            if not answer.get("ok"):
                raise OrthocaptureError(f"the simulated technician could not {action.action}: {answer.get('error')}")
        self._done.add((step.id, attempt))


def _ask_world(address: str, request: dict[str, Any]) -> dict[str, Any]:
    host, _, port = address.rpartition(":")
    deadline_s = time.monotonic() + 300
    try:
        with socket.create_connection((host, int(port)), timeout=10) as link:
            link.settimeout(deadline_s - time.monotonic())
            link.sendall(json.dumps(request).encode() + b"\n")
            with link.makefile("r", encoding="utf-8") as answers:
                return json.loads(answers.readline() or '{"ok": false, "error": "no answer"}')
    except OSError as error:
        raise OrthocaptureError(
            f"the simulated technician does not answer: {error}", where=address, remedy="Start the rig again"
        ) from error
