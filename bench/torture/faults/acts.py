"""What somebody or something does in a case besides the wire, and what the person does before going on."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from tests.support.ur_rtde_protocol import RtdeClient

if TYPE_CHECKING:
    from bench.torture.faults.trial import Trial

_DASHBOARD = 29999


def _say(trial: Trial, *orders: str) -> list[str]:
    """To the simulated controller's dashboard, as at the pendant."""
    with (
        socket.create_connection((trial.arm_host, _DASHBOARD), timeout=3) as link,
        link.makefile("rw") as lines,
    ):
        lines.readline()
        answers: list[str] = []
        for order in orders:
            lines.write(f"{order}\n")
            lines.flush()
            answers.append(lines.readline().strip())
        return answers


def _slider(trial: Trial, fraction: float) -> None:
    """Somebody moves the speed slider at the pendant."""
    import struct  # noqa: PLC0415 - only this speaks of its bytes

    client = RtdeClient(trial.arm_host)
    recipe, _ = client.input_setup(["speed_slider_mask", "speed_slider_fraction"])
    client.send("U", struct.pack(">BId", recipe, 1, fraction))
    time.sleep(0.1)
    client.close()


def _unlock(trial: Trial) -> None:
    """The protective stop, which the controller releases some seconds after it happened."""
    deadline_s = time.monotonic() + 15.0
    while time.monotonic() < deadline_s:
        if _say(trial, "unlock protective stop")[0].startswith(("Protective stop rel", "Failed")):
            return
        time.sleep(0.3)


def _power_up(trial: Trial) -> None:
    """Turn the emergency stop out, power on, release the brakes."""
    deadline_s = time.monotonic() + 15.0
    while time.monotonic() < deadline_s:
        _say(trial, "power on", "brake release")
        if "RUNNING" in _say(trial, "robotmode")[0]:
            return
        time.sleep(0.3)


ACTS: Mapping[str, Callable[[Trial], None]] = {
    "slider": lambda trial: _slider(trial, float(trial.case.value["fraction"])),
}
MENDS: Mapping[str, Callable[[Trial], None]] = {
    "unlock": _unlock,
    "power_up": _power_up,
    "slider_up": lambda trial: _slider(trial, 1.0),
}
SEAMS: Mapping[str, Callable[[Trial], dict[str, Any]]] = {}
