"""Rarely made calls of ur_rtde against one address, with their answers as JSON; run as a child process."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

from dashboard_client import DashboardClient
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface

from tests.support.processes.waiting import until

TOOL = [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]
GOAL = [0.1, -1.57, 1.57, -1.57, -1.57, 0.0]


def _said(call: Callable[[], Any]) -> Any:
    try:
        return call()
    except RuntimeError as error:
        return str(error)


def forward_kinematics(host: str) -> dict[str, Any]:
    """The client's data package is longer than its recipe if it is given the tool alone, or a list of seven."""
    control = RTDEControlInterface(host)
    long = [
        _said(lambda: control.getForwardKinematics([], TOOL)),
        _said(lambda: control.getForwardKinematics([*GOAL, 0])),
    ]
    said = {
        "long": [len(pose) for pose in long],
        "connected": control.isConnected(),
        "plain": control.getForwardKinematics(GOAL, [0.0] * 6),
        "with_tool": control.getForwardKinematics(GOAL, TOOL),
        "moveJ": control.moveJ(GOAL, 2.0, 5.0),
    }
    control.stopScript()
    control.disconnect()
    return said


def watchdog(host: str) -> dict[str, Any]:
    control, receive = RTDEControlInterface(host), RTDEReceiveInterface(host)
    said: dict[str, Any] = {"set": control.setWatchdog(0.5)}  # at least once in two seconds
    began_s = receive.getTimestamp()
    while receive.getTimestamp() < began_s + 2.5:  # longer than it would wait for a kick
        control.kickWatchdog()
    said["kicked"] = control.isProgramRunning()
    until(lambda: not control.isProgramRunning(), "it runs on")
    said["alone"] = control.isProgramRunning()
    said["moveJ"] = control.moveJ(GOAL, 2.0, 5.0)
    control.disconnect()
    return said


def upper_registers(host: str) -> dict[str, Any]:
    flags = RTDEControlInterface.FLAG_UPLOAD_SCRIPT | RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
    control = RTDEControlInterface(host, 500.0, flags)
    there = [GOAL[0] + 0.2, *GOAL[1:]]
    said: dict[str, Any] = {"moveJ": control.moveJ(there, 2.0, 5.0), "fk": control.getForwardKinematics(there, TOOL)}
    said["tcp"] = [control.setTcp(TOOL), control.getTCPOffset()]
    control.stopScript()
    control.disconnect()
    return said


def own_function(host: str) -> dict[str, Any]:
    control = RTDEControlInterface(host)
    said: dict[str, Any] = {"done": control.sendCustomScriptFunction("speak", 'textmsg("now")\n')}
    said["again"] = control.moveJ(GOAL, 2.0, 5.0)
    control.stopScript()
    control.disconnect()
    return said


def pendant(host: str) -> dict[str, Any]:
    dashboard = DashboardClient(host)
    dashboard.connect()
    said: dict[str, Any] = {"nothing_loaded": _said(dashboard.play), "no_file": _said(lambda: dashboard.loadURP("x"))}
    dashboard.loadURP("capture.urp")
    said["loaded"] = dashboard.getLoadedProgram()
    said["states"] = []
    for order in (dashboard.play, dashboard.pause, dashboard.play, dashboard.stop):
        order()
        said["states"].append([dashboard.programState(), dashboard.running()])
    said["pause_idle"] = _said(dashboard.pause)
    said["unlock_idle"] = _said(dashboard.unlockProtectiveStop)
    dashboard.disconnect()
    return said


if __name__ == "__main__":
    calls = (forward_kinematics, watchdog, upper_registers, own_function, pendant)
    print("\n" + json.dumps({call.__name__: call(sys.argv[1]) for call in calls}))  # noqa: T201 - to the parent
