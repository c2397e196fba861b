"""The child of bench.vendor.surface: holds ur_rtde's clients and makes one call per line of its input."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import dashboard_client
import rtde_control
import rtde_io
import rtde_receive
import script_client

from bench.vendor.call import HOME, Call
from bench.vendor.calls import CONTROL
from bench.vendor.reads import DASHBOARD, IO, RECEIVE, SCRIPT

INTERFACES: dict[str, tuple[type[Any], dict[str, Call]]] = {
    "RTDEControlInterface": (rtde_control.RTDEControlInterface, CONTROL),
    "RTDEReceiveInterface": (rtde_receive.RTDEReceiveInterface, RECEIVE),
    "RTDEIOInterface": (rtde_io.RTDEIOInterface, IO),
    "DashboardClient": (dashboard_client.DashboardClient, DASHBOARD),
    "ScriptClient": (script_client.ScriptClient, SCRIPT),
}
VERSION = (5, 12)


class Clients:
    """All clients of one controller and of a newer one; each is created on demand and kept."""

    path, path_entry = rtde_control.Path, rtde_control.PathEntry

    def __init__(self, host: str, new_host: str) -> None:
        self._host, self._new_host = host, new_host
        self._made: dict[str, Any] = {}
        self._remembered: dict[str, Any] = {}

    def _kept(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._made or not self._made[name].isConnected():
            self._made[name] = make()
        return self._made[name]

    @property
    def control(self) -> Any:
        """The control interface with its script running."""
        control = self._kept("control", lambda: rtde_control.RTDEControlInterface(self._host))
        if not control.isProgramRunning():
            control.reuploadScript()
            end = time.monotonic() + 3
            while not control.isProgramRunning() and time.monotonic() < end:
                time.sleep(0.02)
        return control

    @property
    def new_control(self) -> Any:
        """The control interface of the newer controller."""
        return self._kept("new control", lambda: rtde_control.RTDEControlInterface(self._new_host))

    @property
    def receive(self) -> Any:
        """The receive interface."""
        return self._kept("receive", lambda: rtde_receive.RTDEReceiveInterface(self._host))

    @property
    def io(self) -> Any:
        """The input/output interface."""
        return self._kept("io", lambda: rtde_io.RTDEIOInterface(self._host))

    @property
    def dashboard(self) -> Any:
        """A connected dashboard client."""
        return self._kept("dashboard", lambda: _connected(dashboard_client.DashboardClient(self._host)))

    @property
    def new_dashboard(self) -> Any:
        """A connected dashboard client of the newer controller."""
        return self._kept("new dashboard", lambda: _connected(dashboard_client.DashboardClient(self._new_host)))

    @property
    def script(self) -> Any:
        """A connected script client."""
        return self._kept("script", lambda: _connected(script_client.ScriptClient(self._host, *VERSION)))

    def remember(self, name: str, make: Callable[[Any], Any]) -> Any:
        """Return what was made under this name within the current call, making it the first time."""
        if name not in self._remembered:
            self._remembered[name] = make(self)
        return self._remembered[name]

    def begin(self, *, arm: bool) -> None:
        """Reset before each call: no stop, brakes released, full speed, and the arm at rest at its start."""
        self._remembered.clear()
        dashboard = self.dashboard
        dashboard.brakeRelease()
        while self.receive.isProtectiveStopped():
            with suppress(RuntimeError):  # too early
                dashboard.unlockProtectiveStop()
            time.sleep(0.2)
        if self.receive.getTargetSpeedFraction() != 1.0:
            self.io.setSpeedSlider(1.0)
            time.sleep(0.1)
        if arm:
            self.control.moveJ(HOME, 3.0, 10.0)
            self.control.setTcp([0.0] * 6)
        else:
            dashboard.stop()


def _connected(client: Any) -> Any:
    client.connect()
    return client


def _answer(clients: Clients, interface: str, method: str) -> dict[str, Any]:
    call = INTERFACES[interface][1][method]
    clients.begin(arm=interface == "RTDEControlInterface")
    start = time.monotonic()
    try:
        value = call.run(clients)
    except (RuntimeError, ValueError, TypeError) as error:
        value = f"{type(error).__name__}: {str(error).splitlines()[0]}"
    seconds = time.monotonic() - start
    try:
        right = bool(call.right(value))
    except (TypeError, IndexError, KeyError):  # the answer has another form
        right = False
    return {"value": repr(value)[:160], "right": right, "seconds": round(seconds, 2)}


def main() -> None:
    """Read lines `interface<TAB>method` and answer each with a line of JSON after a mark.

    The mark is needed because the library prints too.
    """

    clients = Clients(sys.argv[1], sys.argv[2])
    for line in sys.stdin:
        interface, _, method = line.rstrip("\n").partition("\t")
        print("\n@@" + json.dumps(_answer(clients, interface, method)), flush=True)


if __name__ == "__main__":
    main()
