"""Calls of ur_rtde's control interface: each call, a real controller's answer, and the simulated one's."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.vendor.call import (
    HOME,
    NEAR,
    NOT_SIMULATED,
    NOTHING,
    TOOL,
    Call,
    back,
    done,
    left,
    no,
    numbers,
    second,
    true,
    within,
    zeros,
)


def _arrives(start: Callable[[Any], Any], goal: list[float] = NEAR) -> Callable[[Any], Any]:
    """Start a motion; returns the arm's position after it has ended."""

    def run(s: Any) -> Any:
        started = start(s)
        time.sleep(0.3)
        return [started, max(abs(a - b) for a, b in zip(s.receive.getActualQ(), goal, strict=True))]

    return run


def _arrived(value: Any) -> bool:
    return value[0] is True and value[1] < 2e-3


def _moves(start: Callable[[Any], Any], stop: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Start a continuous motion, measure the speed of the tool or a joint, stop it, and check that the arm stops."""

    def run(s: Any) -> Any:
        said = [start(s)]
        time.sleep(0.3)
        said.append(max(abs(v) for v in s.receive.getActualQd()) > 1e-3)
        stop(s)
        time.sleep(0.6)
        said.append(max(abs(v) for v in s.receive.getActualQd()) < 1e-3)
        return said

    return run


def _moved(value: Any) -> bool:
    return value[0] is True and value[1:] == [True, True]


def _streamed(send: Callable[[Any], Any], goal: list[float]) -> Callable[[Any], Any]:
    def run(s: Any) -> Any:
        sent = None
        for _ in range(120):
            sent = send(s)
            time.sleep(0.008)
        s.control.servoStop()
        return [sent, max(abs(a - b) for a, b in zip(s.receive.getActualQ(), goal, strict=True))]

    return run


def _below(s: Any, down: float = 0.02) -> list[float]:
    pose = s.receive.getActualTCPPose()
    return [*pose[:2], pose[2] - down, *pose[3:]]


def _path(s: Any) -> Any:
    path, entry = s.path(), s.path_entry
    for q in (HOME, NEAR):
        path.addEntry(entry(entry.MoveJ, entry.PositionJoints, [*q, 2.0, 5.0, 0.0]))
    return s.control.movePath(path)


def _watched(s: Any) -> Any:
    control = s.control
    said = [control.setWatchdog(5.0)]
    time.sleep(1.0)
    return [*said, control.isProgramRunning()]


def _kicked(s: Any) -> Any:
    s.control.setWatchdog(2.0)
    kicks: list[Any] = []
    for _ in range(15):
        kicks.append(s.control.kickWatchdog())
        time.sleep(0.08)
    return [all(kicks), s.control.isProgramRunning()]


def _stopped(s: Any) -> Any:
    control = s.control
    control.stopScript()
    time.sleep(0.2)
    return control.isProgramRunning()


def _uploaded(s: Any) -> Any:
    control = s.control
    control.stopScript()
    said = [control.reuploadScript()]
    time.sleep(0.5)
    return [*said, control.isProgramRunning()]


def _script_file(s: Any) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "own.script"
        file.write_text("def own():\n  write_output_integer_register(0, 2)\nend\n")
        return s.control.sendCustomScriptFile(str(file))


def _periods(s: Any) -> Any:
    begun = s.control.initPeriod()
    start = time.monotonic()
    s.control.waitPeriod(begun)
    return time.monotonic() - start


def _untouched(s: Any) -> Any:
    said = [s.control.moveUntilContact([0.0, 0.0, 0.6, 0.0, 0.0, 0.0])]
    end = time.monotonic() + 8
    while not s.receive.isProtectiveStopped() and time.monotonic() < end:
        time.sleep(0.05)
    return [*said, s.receive.isProtectiveStopped()]


_NO_CONTACT = "nothing ever touches the simulated arm"
_NO_FORCE = "accepted without effect, and the simulator's log says so: forces and masses are not simulated"
_LAGS = "the client reads the registers at once: its first answer is that of the call before, on a real arm too"
_NEW = "asked of 5.26"
CONTROL: dict[str, Call] = {
    "moveJ": Call(_arrives(lambda s: s.control.moveJ(NEAR, 2.0, 5.0)), _arrived),
    "moveJ_IK": Call(
        _arrives(
            lambda s: [s.control.setTcp(TOOL), s.control.moveJ_IK(s.control.getForwardKinematics(NEAR, TOOL))][1]
        ),
        _arrived,
    ),
    "moveL": Call(lambda s: s.control.moveL(_below(s), 0.25, 1.2), true),
    "moveL_FK": Call(_arrives(lambda s: s.control.moveL_FK(NEAR, 0.5, 2.0)), _arrived),
    "movePath": Call(_arrives(_path), _arrived, note="each way point is reached at rest: no blending"),
    "moveUntilContact": Call(
        _untouched,
        lambda v: v == [False, True],
        note=f"{_NO_CONTACT}: the arm goes on to the end of its reach, where it stops protectively",
    ),
    "servoJ": Call(_streamed(lambda s: s.control.servoJ(NEAR, 0, 0, 0.008, 0.1, 300), NEAR), _arrived),
    "servoL": Call(
        _streamed(lambda s: s.control.servoL(s.remember("pose", _below), 0, 0, 0.008, 0.1, 300), HOME),
        lambda v: v[0] is True and v[1] > 1e-3,
    ),
    "servoC": Call(
        _moves(lambda s: s.control.servoC(_below(s, 0.2), 0.05, 1.2, 0.0), lambda s: s.control.servoStop()),
        _moved,
        note="on a straight line, no circle. The client leaves the command standing: its next one waits for 4 s",
    ),
    "servoStop": Call(lambda s: s.control.servoStop(), true),
    "speedJ": Call(_moves(lambda s: s.control.speedJ([0.1, 0, 0, 0, 0, 0]), lambda s: s.control.speedStop()), _moved),
    "speedL": Call(
        _moves(lambda s: s.control.speedL([0, 0, 0.02, 0, 0, 0]), lambda s: s.control.speedStop()), _moved
    ),
    "speedStop": Call(lambda s: s.control.speedStop(), true),
    "jogStart": Call(
        _moves(lambda s: s.control.jogStart([0, 0, 0.02, 0, 0, 0], 1), lambda s: s.control.jogStop()), _moved
    ),
    "jogStop": Call(lambda s: s.control.jogStop(), true),
    "stopJ": Call(
        lambda s: [s.control.moveJ(NEAR, 0.2, 1.0, True), s.control.stopJ(2.0)], lambda v: v == [True, None]
    ),
    "stopL": Call(
        lambda s: [s.control.moveL(_below(s), 0.02, 0.2, True), s.control.stopL(2.0)], lambda v: v == [True, None]
    ),
    "getAsyncOperationProgress": Call(
        lambda s: [s.control.moveJ(NEAR, 0.2, 1.0, True), s.control.getAsyncOperationProgress()],
        lambda v: v == [True, 0],
    ),
    "getAsyncOperationProgressEx": Call(
        lambda s: [
            s.control.moveJ(NEAR, 0.2, 1.0, True),
            time.sleep(0.05),
            s.control.getAsyncOperationProgressEx().isAsyncOperationRunning(),
        ][::2],
        lambda v: v == [True, True],
    ),
    "isSteady": Call(lambda s: s.control.isSteady(), true),
    "getForwardKinematics": Call(
        lambda s: [s.control.getForwardKinematics(HOME, TOOL), s.control.getForwardKinematics([], TOOL)],
        lambda v: [len(pose) for pose in v] == [6, 6],
        note="with the tool alone the client sends a package that is too long; the link survives it",
    ),
    "getInverseKinematics": Call(
        lambda s: s.control.getInverseKinematics(s.receive.getActualTCPPose(), HOME), within(HOME)
    ),
    "getInverseKinematicsHasSolution": Call(
        lambda s: [
            s.control.getInverseKinematicsHasSolution(pose, HOME) for pose in (_below(s), [5.0, *NOTHING[1:]])
        ],
        lambda v: v == [True, False],
    ),
    "poseTrans": Call(lambda s: s.control.poseTrans(TOOL, TOOL), within([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])),
    "setTcp": Call(lambda s: [s.control.setTcp(TOOL), *s.control.getTCPOffset()][:4], lambda v: v[3] == 0.1),
    "getTCPOffset": Call(lambda s: s.control.getTCPOffset(), numbers(6)),
    "getActualToolFlangePose": Call(
        second(lambda s: s.control.getActualToolFlangePose()), lambda v: abs(v[0] + 0.691) < 0.01, note=_LAGS
    ),
    "getTargetWaypoint": Call(lambda s: s.control.getTargetWaypoint(), numbers(6)),
    "getActualJointPositionsHistory": Call(
        second(lambda s: s.control.getActualJointPositionsHistory(5)), within(HOME), note=_LAGS
    ),
    "getStepTime": Call(second(lambda s: s.control.getStepTime()), lambda v: v == 0.002, note=_LAGS),
    "isPoseWithinSafetyLimits": Call(
        lambda s: [s.control.isPoseWithinSafetyLimits(pose) for pose in (_below(s), [5.0, *NOTHING[1:]])],
        lambda v: v == [True, False],
        note="limits are the arm's reach; safety planes are not simulated",
    ),
    "isJointsWithinSafetyLimits": Call(
        lambda s: [s.control.isJointsWithinSafetyLimits(q) for q in (HOME, [7.0, *HOME[1:]])],
        lambda v: v == [True, False],
        note="limits are ±360°",
    ),
    "setPayload": Call(
        lambda s: [s.control.setPayload(1.5, [0.0, 0.0, 0.05]), time.sleep(0.1), s.receive.getPayload()][::2],
        lambda v: v == [True, 1.5],
        note="reported back; it changes nothing in the arm's motion",
    ),
    "setTargetPayload": Call(
        lambda s: [
            s.control.setTargetPayload(1.2, [0.0, 0.0, 0.05], [0.01] * 3 + [0.0] * 3),
            time.sleep(0.1),
            s.receive.getPayloadInertia()[0],
        ][::2],
        lambda v: v == [True, 0.01],
    ),
    "setGravity": Call(lambda s: s.control.setGravity([0.0, 0.0, 9.82]), true, NOT_SIMULATED, _NO_FORCE),
    "setWatchdog": Call(_watched, lambda v: v == [True, False]),
    "kickWatchdog": Call(_kicked, lambda v: v == [True, True]),
    "triggerProtectiveStop": Call(
        lambda s: [s.control.triggerProtectiveStop(), time.sleep(0.1), s.receive.isProtectiveStopped()][::2],
        lambda v: v == [False, True],
        note="the client answers False although the arm stopped, as on a real controller",
    ),
    "isConnected": Call(lambda s: s.control.isConnected(), true),
    "isProgramRunning": Call(lambda s: s.control.isProgramRunning(), true),
    "getRobotStatus": Call(lambda s: s.control.getRobotStatus(), lambda v: v & 3 == 3),
    "disconnect": Call(left("control"), no),
    "reconnect": Call(back("control"), lambda v: v == [True, True]),
    "stopScript": Call(_stopped, no),
    "reuploadScript": Call(_uploaded, lambda v: v == [True, True]),
    "initPeriod": Call(
        lambda s: str(type(s.control.initPeriod()).__name__), lambda v: v == "timedelta", note="no wire"
    ),
    "waitPeriod": Call(_periods, lambda v: 0.0 <= v < 0.1, note="no wire"),
    "sendCustomScriptFunction": Call(
        lambda s: s.control.sendCustomScriptFunction("own", 'textmsg("hello")\n'),
        true,
        note="a script of one's own runs, but only the integers it writes are carried out",
    ),
    "sendCustomScript": Call(
        lambda s: s.control.sendCustomScript("def own():\n  write_output_integer_register(0, 2)\nend\n"),
        true,
        note="the client waits until the script itself writes that it is done, on a real arm too",
    ),
    "sendCustomScriptFile": Call(_script_file, true, note="see above"),
    "setCustomScriptFile": Call(lambda s: s.control.setCustomScriptFile(""), done, note="no wire"),
    "freedriveMode": Call(
        lambda s: [s.control.freedriveMode(), s.control.endFreedriveMode()],
        lambda v: v == [True, True],
        note="nobody pushes the simulated arm: it stands",
    ),
    "endFreedriveMode": Call(lambda s: s.control.endFreedriveMode(), true),
    "getFreedriveStatus": Call(lambda s: s.control.getFreedriveStatus(), lambda v: v == 0),
    "teachMode": Call(lambda s: [s.control.teachMode(), s.control.endTeachMode()], lambda v: v == [True, True]),
    "endTeachMode": Call(lambda s: s.control.endTeachMode(), true),
    "toolContact": Call(
        lambda s: s.control.toolContact([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]), lambda v: v == 0, note=_NO_CONTACT
    ),
    "startContactDetection": Call(lambda s: s.control.startContactDetection(), true, note=_NO_CONTACT),
    "readContactDetection": Call(
        lambda s: [s.control.startContactDetection(), s.control.readContactDetection()], lambda v: v == [True, False]
    ),
    "stopContactDetection": Call(
        lambda s: [s.control.startContactDetection(), s.control.stopContactDetection()], lambda v: v == [True, False]
    ),
    "zeroFtSensor": Call(lambda s: s.control.zeroFtSensor(), true, note="the force is always zero"),
    "forceMode": Call(
        lambda s: s.control.forceMode(NOTHING, [0, 0, 1, 0, 0, 0], [0.0, 0.0, -5.0, 0.0, 0.0, 0.0], 2, [0.1] * 6),
        true,
        NOT_SIMULATED,
        _NO_FORCE,
    ),
    "forceModeStop": Call(lambda s: s.control.forceModeStop(), true, NOT_SIMULATED, _NO_FORCE),
    "forceModeSetDamping": Call(lambda s: s.control.forceModeSetDamping(0.1), true, NOT_SIMULATED, _NO_FORCE),
    "forceModeSetGainScaling": Call(lambda s: s.control.forceModeSetGainScaling(0.5), true, NOT_SIMULATED, _NO_FORCE),
    "enableExternalFtSensor": Call(lambda s: s.control.enableExternalFtSensor(True), true, NOT_SIMULATED, _NO_FORCE),
    "ftRtdeInputEnable": Call(lambda s: s.control.ftRtdeInputEnable(True), true, NOT_SIMULATED, _NO_FORCE),
    "setExternalForceTorque": Call(
        lambda s: s.control.setExternalForceTorque(NOTHING), true, NOT_SIMULATED, _NO_FORCE
    ),
    "directTorque": Call(lambda s: s.new_control.directTorque(NOTHING), true, NOT_SIMULATED, f"{_NO_FORCE}; {_NEW}"),
    "getJointTorques": Call(second(lambda s: s.control.getJointTorques()), zeros(6), NOT_SIMULATED, "zeros"),
    "getMassMatrix": Call(
        second(lambda s: s.new_control.getMassMatrix()), zeros(36), NOT_SIMULATED, f"zeros; {_NEW}"
    ),
    "getCoriolisAndCentrifugalTorques": Call(
        second(lambda s: s.new_control.getCoriolisAndCentrifugalTorques()), zeros(6), NOT_SIMULATED, f"zeros; {_NEW}"
    ),
    "getTargetJointAccelerations": Call(
        second(lambda s: s.new_control.getTargetJointAccelerations()), numbers(6), note=_NEW
    ),
    "getJacobian": Call(
        second(lambda s: s.new_control.getJacobian()),
        lambda v: len(v) == 36 and sum(abs(x) for x in v) > 1,
        note=_NEW,
    ),
    "getJacobianTimeDerivative": Call(
        second(lambda s: s.new_control.getJacobianTimeDerivative()), numbers(36), note=_NEW
    ),
}
