"""Uses all four ur_rtde interfaces against one address and prints their answers as JSON; run as a child process."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from dashboard_client import DashboardClient
from rtde_control import Path, PathEntry, RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface


def session(host: str, *, e_series: bool) -> dict[str, Any]:
    said: dict[str, Any] = {}
    dashboard = DashboardClient(host)
    dashboard.connect()
    questions = ["polyscopeVersion", "robotmode", "running"]
    if e_series:  # the client refuses the others for a CB3
        questions += [
            "getSerialNumber",
            "getRobotModel",
            "safetymode",
            "safetystatus",
            "programState",
            "isInRemoteControl",
        ]
    for question in questions:
        said[question] = getattr(dashboard, question)()
    for order in ("stop", "closePopup", "closeSafetyPopup", "powerOn", "brakeRelease", "restartSafety"):
        getattr(dashboard, order)()
    receive = RTDEReceiveInterface(host)
    said["q0"] = receive.getActualQ()
    said["temperatures"] = receive.getJointTemperatures()
    io = RTDEIOInterface(host)
    said["io"] = [
        io.setStandardDigitalOut(3, True),
        io.setConfigurableDigitalOut(1, True),
        io.setToolDigitalOut(0, True),
    ]
    said["io"] += [io.setAnalogOutputVoltage(0, 0.25), io.setInputDoubleRegister(20, 1.5)]
    control = RTDEControlInterface(host)
    time.sleep(0.1)
    said["outputs"] = receive.getActualDigitalOutputBits()
    said["analog"] = receive.getStandardAnalogOutput0()

    goal = [said["q0"][0] + 0.2, *said["q0"][1:]]
    start = time.monotonic()
    said["moveJ"] = control.moveJ(goal, 1.05, 1.4)
    said["moveJ_s"] = time.monotonic() - start
    time.sleep(0.5)
    said["moveJ_error"] = max(abs(a - b) for a, b in zip(receive.getActualQ(), goal, strict=True))

    said["setTcp"] = control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    said["tcp"] = control.getTCPOffset()
    said["setPayload"] = control.setPayload(1.6, [0.0, 0.0, 0.08])
    said["fk"] = control.getForwardKinematics(goal, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    time.sleep(0.05)
    pose = receive.getActualTCPPose()
    said["pose"] = pose
    if e_series:
        said["payload"] = receive.getPayload()

    below = [*pose[:2], pose[2] - 0.03, *pose[3:]]
    said["has_solution"] = control.getInverseKinematicsHasSolution(below, goal)
    said["has_no_solution"] = control.getInverseKinematicsHasSolution([5.0, 0.0, 0.0, 0.0, 0.0, 0.0], goal)
    said["ik"] = control.getInverseKinematics(below, goal)
    said["ik_fk"] = control.getForwardKinematics(said["ik"], [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    said["below"] = below
    said["moveL"] = control.moveL(below, 0.25, 1.2)

    said["async"] = control.moveL(pose, 0.02, 0.2, True)
    time.sleep(0.2)
    said["running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    control.stopL(2.0)
    said["stopped_at"] = receive.getActualTCPPose()[2] - below[2]
    said["running_after_stop"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()

    said["speedJ"] = control.speedJ([0.1, 0, 0, 0, 0, 0], 1.0, 0)
    time.sleep(0.3)
    said["speed"] = receive.getActualQd()[0]
    said["speedStop"] = control.speedStop()

    path = Path()
    for joints in (said["q0"], goal, said["q0"]):
        entry = [*joints, 2.0, 5.0, 0.0]
        path.addEntry(PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, entry))
    said["path"] = control.movePath(path)
    time.sleep(0.3)
    said["path_error"] = max(abs(a - b) for a, b in zip(receive.getActualQ(), said["q0"], strict=True))

    control.triggerProtectiveStop()
    time.sleep(0.1)
    said["protective"] = [receive.isProtectiveStopped(), control.isProgramRunning(), receive.getSafetyMode()]
    try:
        dashboard.unlockProtectiveStop()
        said["early_unlock"] = "allowed"
    except RuntimeError as error:
        said["early_unlock"] = str(error)
    time.sleep(5.1 / 5)  # the simulator runs five times as fast
    dashboard.closeSafetyPopup()
    dashboard.unlockProtectiveStop()
    control.reuploadScript()
    deadline = time.monotonic() + 30
    while (not control.isProgramRunning() or receive.isProtectiveStopped()) and time.monotonic() < deadline:
        time.sleep(0.02)
    said["again"] = [receive.isProtectiveStopped(), control.moveJ(goal, 2.0, 5.0)]
    io.setSpeedSlider(0.5)
    time.sleep(0.1)
    said["slider"] = receive.getTargetSpeedFraction()
    control.stopScript()
    for client in (control, io, receive, dashboard):
        client.disconnect()
    return said


if __name__ == "__main__":
    sys.stdout.write("\n" + json.dumps(session(sys.argv[1], e_series=sys.argv[2] != "3.15")) + "\n")
