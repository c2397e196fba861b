"""A call of the vendor's client: how it is made, what answer is right, and the predicates for answers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

AS_REAL, REFUSED, NOT_SIMULATED = "as the real one", "refused as the real one refuses", "not simulated"
HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
NEAR = [0.1, *HOME[1:]]
TOOL = [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]
NOTHING = [0.0] * 6


@dataclass(frozen=True)
class Call:
    """One method: how it is called, whether its answer is as expected, its verdict, and the reason."""

    run: Callable[[Any], Any]  # called with the clients of a session
    right: Callable[[Any], bool]
    worth: str = AS_REAL
    note: str = ""
    crashes: bool = False  # the client itself crashes, whatever the controller does


def true(value: Any) -> bool:
    """Return whether the call returned True."""
    return value is True


def done(value: Any) -> bool:
    """Return whether the call returned without a value."""
    return value is None


def numbers(count: int) -> Callable[[Any], bool]:
    """Return whether the value is a list of `count` finite numbers."""
    return lambda value: len(value) == count and all(math.isfinite(v) for v in value)


def number(value: Any) -> bool:
    """Return whether the value is one finite number."""
    return isinstance(value, (int, float)) and math.isfinite(value)


def within(what: list[float], tolerance: float = 1e-3) -> Callable[[Any], bool]:
    """Return whether the value equals these numbers within the tolerance."""
    return lambda value: (
        len(value) == len(what) and all(abs(a - b) < tolerance for a, b in zip(value, what, strict=True))
    )


def zeros(count: int) -> Callable[[Any], bool]:
    """Return whether the value is a list of `count` zeros."""
    return lambda value: list(value) == [0.0] * count


def error(words: str) -> Callable[[Any], bool]:
    """Return whether the call raised an error containing these words."""
    return lambda value: isinstance(value, str) and words in value


def left(name: str) -> Callable[[Any], Any]:
    """Disconnect one of the clients; returns whether it reports so."""

    def run(s: Any) -> Any:
        client = getattr(s, name)
        client.disconnect()
        return client.isConnected()

    return run


def back(name: str) -> Callable[[Any], Any]:
    """Disconnect and reconnect one of the clients; returns its answer."""

    def run(s: Any) -> Any:
        client = getattr(s, name)
        client.disconnect()
        return [client.reconnect(), client.isConnected()]

    return run


def no(value: Any) -> bool:
    """Return whether the call returned False."""
    return value is False


def second(ask: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Call twice: the real-time getters return the previous content of the registers, so the second answer counts."""

    def run(s: Any) -> Any:
        ask(s)
        time.sleep(0.05)
        return ask(s)

    return run
