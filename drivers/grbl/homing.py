"""Homes the axes, and notices when the controller has homed and its answer, or the command, was lost."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from drivers.errors import DeviceRefusedError
from drivers.grbl import GrblConfig
from drivers.grbl.link import Link
from drivers.grbl.wire import HOME, UNLOCKED, Feedback, Status

_LOOK_S = 0.05


def home(link: Link, newest: Callable[[], tuple[Status | None, float]], config: GrblConfig) -> None:
    """Home the axes, and return when the controller has answered that they are.

    GRBL reports nothing while it homes, and later firmware the state Home. So a report of another state that was
    asked for some time after the command says that it does not home any more, or never did. It does not prove that
    the position is right: only the answer does.

    Args:
        link: the link to the controller, which was just reset.
        newest: the newest report, and when it was asked for, monotonic.
        config: how long homing and an answer may take.

    Raises:
        DeviceRefusedError: it was refused, or the line spoilt the command.
        DeviceTimeoutError, DeviceUnavailableError: there was no answer.
    """
    sent = link.send(HOME)
    ended_s, why = math.inf, f" in {config.homing_timeout_s:g} s"
    while not link.await_answer(sent, _LOOK_S):
        now_s = time.monotonic()
        status, asked_s = newest()
        reports = status is not None and status.state != "Home" and asked_s > sent.sent_s + config.answer_timeout_s
        ended_s = min(ended_s, now_s) if reports else math.inf
        if now_s - ended_s > config.answer_timeout_s:
            why = ", although the controller reports that it does not home any more"
            break
        if now_s - sent.sent_s > config.homing_timeout_s:
            break
    said = link.answer_to(sent, why)
    if any(isinstance(one, Feedback) and one.text == UNLOCKED for one in said):
        what = "the controller took the command to home for the one that unlocks it: the line spoils what is sent"
        remedy = "Check the cable and its distance from motors; the axes are homed after a person has confirmed"
        raise DeviceRefusedError(what, where=config.port, remedy=remedy)
