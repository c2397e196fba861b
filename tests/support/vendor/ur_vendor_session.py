"""Uses all four ur_rtde interfaces against one address and prints their answers as JSON; run as a child process."""

from __future__ import annotations

import json
import sys
from typing import Any

from dashboard_client import DashboardClient
from rtde_control import Path, PathEntry, RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

from tests.support.processes.waiting import until

Receive = Any  # the client library has no types


def apart(joints_rad: list[float], others_rad: list[float]) -> float:
    return max(abs(a - b) for a, b in zip(joints_rad, others_rad, strict=True))


def current(receive: Receive) -> float:
    """Wait for packages that were sent after this call; the controller's time, s."""
    start_s = receive.getTimestamp()
    until(lambda: receive.getTimestamp() > start_s + 0.05, "no new package", every_s=0.01)
    return receive.getTimestamp()


def at_rest(receive: Receive) -> list[float]:
    """Joints once the arm no longer swings."""
    current(receive)
    until(lambda: not any(receive.getActualQd()), "it does not come to rest")
    return receive.getActualQ()


def unlocked(dashboard: Any) -> bool:
    """Return whether the protective stop could be released, for which some time must have passed."""
    try:
        dashboard.unlockProtectiveStop()
    except RuntimeError:
        return False
    return True


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
    until(lambda: receive.getActualDigitalOutputBits() & 0x1020A == 0x10208, "no outputs")
    said["outputs"] = receive.getActualDigitalOutputBits()
    said["analog"] = receive.getStandardAnalogOutput0()

    goal = [said["q0"][0] + 0.2, *said["q0"][1:]]
    start_s = receive.getTimestamp()
    said["moveJ"] = control.moveJ(goal, 1.05, 1.4)
    said["moveJ_s"] = current(receive) - start_s
    said["moveJ_error"] = apart(at_rest(receive), goal)

    said["setTcp"] = control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    said["tcp"] = control.getTCPOffset()
    said["setPayload"] = control.setPayload(1.6, [0.0, 0.0, 0.08])
    said["fk"] = control.getForwardKinematics(goal, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    current(receive)
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
    until(lambda: receive.getActualTCPPose()[2] - below[2] > 0.001, "it does not move")
    said["running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    control.stopL(2.0)
    said["stopped_at"] = receive.getActualTCPPose()[2] - below[2]
    said["running_after_stop"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()

    said["speedJ"] = control.speedJ([0.1, 0, 0, 0, 0, 0], 1.0, 0)
    until(lambda: receive.getActualQd()[0] > 0.49, "it does not reach the speed")
    said["speed"] = receive.getActualQd()[0]
    said["speedStop"] = control.speedStop()

    path = Path()
    for joints in (said["q0"], goal, said["q0"]):
        entry = [*joints, 2.0, 5.0, 0.0]
        path.addEntry(PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, entry))
    said["path"] = control.movePath(path)
    said["path_error"] = apart(at_rest(receive), said["q0"])

    control.triggerProtectiveStop()
    until(lambda: receive.isProtectiveStopped() and not control.isProgramRunning(), "no protective stop")
    said["protective"] = [receive.isProtectiveStopped(), control.isProgramRunning(), receive.getSafetyMode()]
    try:
        dashboard.unlockProtectiveStop()
        said["early_unlock"] = "allowed"
    except RuntimeError as error:
        said["early_unlock"] = str(error)
    dashboard.closeSafetyPopup()
    until(lambda: unlocked(dashboard), "it cannot be unlocked")
    control.reuploadScript()
    until(lambda: control.isProgramRunning() and not receive.isProtectiveStopped(), "the script does not run")
    said["again"] = [receive.isProtectiveStopped(), control.moveJ(goal, 2.0, 5.0)]
    io.setSpeedSlider(0.5)
    until(lambda: receive.getTargetSpeedFraction() < 0.75, "the slider does not move")
    said["slider"] = receive.getTargetSpeedFraction()
    control.stopScript()
    for client in (control, io, receive, dashboard):
        client.disconnect()
    return said


if __name__ == "__main__":
    sys.stdout.write("\n" + json.dumps(session(sys.argv[1], e_series=sys.argv[2] != "3.15")) + "\n")
