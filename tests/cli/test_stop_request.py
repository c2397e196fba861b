"""A signal that comes at any moment of a wait ends it: no line of the wait holds a lock that the handler wants."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Waits again and again; each time SIGTERM comes one line later, wherever in the wait that is.
_WAITING = """
import signal
import sys

{make}

def interrupted_at(number: int) -> bool:
    waiting, passed = made(), 0

    def trace(frame, event, _argument):
        nonlocal passed
        if event == "line":
            passed += 1
            if passed == number:
                sys.settrace(None)
                signal.raise_signal(signal.SIGTERM)
        return trace

    sys.settrace(trace)
    waiting.wait(0.02)
    sys.settrace(None)
    assert passed < number or waiting.wait(5.0), f"line {{number}} of the wait"
    return passed >= number

number = 1
while interrupted_at(number):
    number += 1
print(number)
"""
_TERMINATION = "from simulators.serve import Termination as made"
_REQUEST = """
from service.cli.ending import stop_requested

contexts = []

def made():
    contexts.append(stop_requested())
    return contexts[-1].__enter__()
"""
_EVENT = """
import threading

def made():
    event = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: event.set())
    return event
"""


def run_waits(make: str, patience_s: float) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _WAITING.format(make=make)]
    return subprocess.run(command, capture_output=True, text=True, timeout=patience_s, check=False)


@pytest.mark.parametrize("make", [_TERMINATION, _REQUEST], ids=["simulators", "commands"])
def test_no_moment_of_a_wait_is_too_early_for_a_signal(make: str) -> None:
    done = run_waits(make, 120.0)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 5, "the wait has lines"


def test_an_event_would_wait_for_ever() -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        run_waits(_EVENT, 5.0)
