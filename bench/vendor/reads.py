"""Calls of ur_rtde's receive, input/output, dashboard and script interfaces, as in bench.vendor.calls."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.vendor.call import (
    AS_REAL,
    HOME,
    NOT_SIMULATED,
    REFUSED,
    Call,
    back,
    done,
    error,
    left,
    no,
    number,
    numbers,
    true,
    within,
    zeros,
)

_SIX_NUMBERS = (
    "getActualQd", "getTargetQd", "getTargetQdd", "getActualTCPPose", "getActualTCPSpeed", "getTargetTCPPose",
    "getTargetTCPSpeed", "getJointTemperatures", "getActualJointVoltage", "getJointMode", "getPayloadInertia",
)  # fmt: skip
_SIX_ZEROS = (
    "getActualCurrent", "getTargetCurrent", "getTargetMoment", "getJointControlOutput", "getActualTCPForce",
    "getFtRawWrench",
)  # fmt: skip
_STILL = "zero: currents, torques and forces are not simulated"


def _read(name: str, right: Callable[[Any], bool], worth: str = AS_REAL, note: str = "") -> Call:
    return Call(lambda s: getattr(s.receive, name)(), right, worth, note)


def _equals(wanted: Any) -> Callable[[Any], bool]:
    return lambda value: value == wanted


def _recording(s: Any) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "record.csv"
        started = s.receive.startFileRecording(str(file), ["timestamp", "actual_q"])
        time.sleep(0.3)
        stopped = s.receive.stopFileRecording()
        return [started, stopped, len(file.read_text().splitlines()) > 10]


def _period(s: Any) -> Any:
    begun = s.receive.initPeriod()
    s.receive.waitPeriod(begun)
    return type(begun).__name__


RECEIVE: dict[str, Call] = {
    **{name: _read(name, within(HOME)) for name in ("getActualQ", "getTargetQ")},
    **{name: _read(name, numbers(6)) for name in _SIX_NUMBERS},
    **{name: _read(name, zeros(6), NOT_SIMULATED, _STILL) for name in _SIX_ZEROS},
    **{
        name: _read(name, _equals(0.0), NOT_SIMULATED, _STILL)
        for name in (
            "getActualMomentum",
            "getActualRobotCurrent",
            "getStandardAnalogInput0",
            "getStandardAnalogInput1",
        )
    },
    "getActualExecutionTime": _read("getActualExecutionTime", _equals(0.0), NOT_SIMULATED, "zero"),
    "getActualDigitalInputBits": _read(
        "getActualDigitalInputBits", _equals(0), note="nothing is wired to the inputs"
    ),
    "getActualDigitalOutputBits": _read("getActualDigitalOutputBits", number),
    "getActualMainVoltage": _read("getActualMainVoltage", _equals(48.0)),
    "getActualRobotVoltage": _read("getActualRobotVoltage", _equals(48.0)),
    "getActualToolAccelerometer": _read(
        "getActualToolAccelerometer", numbers(3), NOT_SIMULATED, "gravity along the tool's z axis, always"
    ),
    "getPayload": _read("getPayload", number),
    "getPayloadCog": _read("getPayloadCog", numbers(3)),
    "getRobotMode": _read("getRobotMode", _equals(7)),
    "getRobotStatus": _read("getRobotStatus", lambda v: v & 1 == 1),
    "getRuntimeState": _read("getRuntimeState", number),
    "getSafetyMode": _read("getSafetyMode", _equals(1)),
    "getSafetyStatusBits": _read("getSafetyStatusBits", _equals(1)),
    "getSpeedScaling": _read("getSpeedScaling", _equals(1.0)),
    "getSpeedScalingCombined": _read("getSpeedScalingCombined", _equals(1.0)),
    "getTargetSpeedFraction": _read("getTargetSpeedFraction", _equals(1.0)),
    "getStandardAnalogOutput0": _read("getStandardAnalogOutput0", number),
    "getStandardAnalogOutput1": _read("getStandardAnalogOutput1", number),
    "getDigitalInState": Call(lambda s: s.receive.getDigitalInState(0), _equals(False)),
    "getDigitalOutState": Call(
        lambda s: [s.io.setStandardDigitalOut(2, True), time.sleep(0.1), s.receive.getDigitalOutState(2)][::2],
        _equals([True, True]),
    ),
    "getOutputIntRegister": Call(lambda s: s.receive.getOutputIntRegister(12), _equals(0)),
    "getOutputDoubleRegister": Call(lambda s: s.receive.getOutputDoubleRegister(12), _equals(0.0)),
    "getTimestamp": _read("getTimestamp", lambda v: v > 0),
    "isConnected": _read("isConnected", true),
    "isEmergencyStopped": _read("isEmergencyStopped", _equals(False)),
    "isProtectiveStopped": _read("isProtectiveStopped", _equals(False)),
    "startFileRecording": Call(_recording, _equals([True, True, True])),
    "stopFileRecording": Call(_recording, _equals([True, True, True])),
    "disconnect": Call(left("receive"), no),
    "reconnect": Call(back("receive"), _equals([True, True])),
    "initPeriod": Call(_period, _equals("timedelta"), note="no wire"),
    "waitPeriod": Call(_period, _equals("timedelta"), note="no wire"),
}


def _shown(order: Callable[[Any], Any], read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Give an order; returns what the stream then reports."""

    def run(s: Any) -> Any:
        given = order(s)
        time.sleep(0.15)
        return [given, read(s)]

    return run


IO: dict[str, Call] = {
    "setStandardDigitalOut": Call(
        _shown(
            lambda s: s.io.setStandardDigitalOut(3, True), lambda s: s.receive.getActualDigitalOutputBits() >> 3 & 1
        ),
        _equals([True, 1]),
    ),
    "setConfigurableDigitalOut": Call(
        _shown(
            lambda s: s.io.setConfigurableDigitalOut(1, True),
            lambda s: s.receive.getActualDigitalOutputBits() >> 9 & 1,
        ),
        _equals([True, 1]),
    ),
    "setToolDigitalOut": Call(
        _shown(lambda s: s.io.setToolDigitalOut(0, True), lambda s: s.receive.getActualDigitalOutputBits() >> 16 & 1),
        _equals([True, 1]),
    ),
    "setAnalogOutputVoltage": Call(
        _shown(lambda s: s.io.setAnalogOutputVoltage(0, 0.25), lambda s: s.receive.getStandardAnalogOutput0()),
        _equals([True, 0.25]),
    ),
    "setAnalogOutputCurrent": Call(
        _shown(lambda s: s.io.setAnalogOutputCurrent(1, 0.5), lambda s: s.receive.getStandardAnalogOutput1()),
        _equals([True, 0.5]),
    ),
    "setSpeedSlider": Call(
        _shown(lambda s: s.io.setSpeedSlider(0.5), lambda s: s.receive.getTargetSpeedFraction()), _equals([True, 0.5])
    ),
    "setInputIntRegister": Call(lambda s: s.io.setInputIntRegister(20, 7), true),
    "setInputDoubleRegister": Call(lambda s: s.io.setInputDoubleRegister(20, 1.5), true),
    "isConnected": Call(lambda s: s.io.isConnected(), true),
    "disconnect": Call(left("io"), no),
    "reconnect": Call(back("io"), _equals([True, True])),
}


def _ask(name: str, right: Callable[[Any], bool], worth: str = AS_REAL, note: str = "") -> Call:
    return Call(lambda s: getattr(s.dashboard, name)(), right, worth, note)


def _starts(words: str) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, str) and value.startswith(words)


def _played(s: Any) -> Any:
    s.dashboard.loadURP("capture.urp")
    s.dashboard.play()
    return [s.dashboard.programState(), s.dashboard.running()]


def _paused(s: Any) -> Any:
    _played(s)
    s.dashboard.pause()
    return s.dashboard.programState()


def _unlocked(s: Any) -> Any:
    time.sleep(0.3)  # for the client to notice that its script was stopped
    s.control.triggerProtectiveStop()
    time.sleep(1.3)  # five seconds on the simulated controller's clock
    s.dashboard.closeSafetyPopup()
    s.dashboard.unlockProtectiveStop()
    time.sleep(0.1)
    return s.receive.isProtectiveStopped()


def _ended(name: str) -> Callable[[Any], Any]:
    def run(s: Any) -> Any:
        client = s.dashboard
        said = getattr(client, name)()
        client.disconnect()
        return [said, client.isConnected()]

    return run


def _asked(s: Any) -> Any:
    s.dashboard.send("robotmode\n")
    return s.dashboard.receive()


DASHBOARD: dict[str, Call] = {
    "connect": _ask("isConnected", true),
    "isConnected": _ask("isConnected", true),
    "disconnect": Call(left("dashboard"), no),
    "polyscopeVersion": _ask("polyscopeVersion", lambda v: v[:1].isdigit()),
    "getRobotModel": _ask("getRobotModel", _equals("UR10")),
    "getSerialNumber": _ask("getSerialNumber", lambda v: v.isdigit()),
    "robotmode": _ask("robotmode", _equals("Robotmode: RUNNING")),
    "safetymode": _ask("safetymode", _equals("Safetymode: NORMAL")),
    "safetystatus": _ask("safetystatus", _equals("Safetystatus: NORMAL")),
    "isInRemoteControl": _ask("isInRemoteControl", true),
    "running": _ask("running", _equals(False)),
    "programState": _ask("programState", _starts("STOPPED")),
    "getLoadedProgram": Call(
        lambda s: [s.dashboard.loadURP("capture.urp"), s.dashboard.getLoadedProgram()],
        _equals([None, "Loaded program: capture.urp"]),
    ),
    "isProgramSaved": Call(
        lambda s: [s.dashboard.loadURP("capture.urp"), s.dashboard.isProgramSaved()][1],
        _equals(False),
        note="the client compares the answer `true capture.urp` with `True`, and says no to every controller",
    ),
    "loadURP": Call(
        lambda s: s.dashboard.loadURP("capture.urp"), done, note="every file name that ends in .urp is found"
    ),
    "play": Call(
        _played, _equals(["PLAYING capture.urp", True]), note="the program does nothing until it is stopped"
    ),
    "pause": Call(_paused, _equals("PAUSED capture.urp")),
    "stop": Call(lambda s: [_played(s), s.dashboard.stop(), s.dashboard.running()][1:], _equals([None, False])),
    "powerOff": Call(
        lambda s: [s.dashboard.powerOff(), s.dashboard.robotmode()], _equals([None, "Robotmode: POWER_OFF"])
    ),
    "powerOn": Call(
        lambda s: [s.dashboard.powerOff(), s.dashboard.powerOn(), s.dashboard.robotmode()][2],
        _equals("Robotmode: IDLE"),
    ),
    "brakeRelease": Call(
        lambda s: [s.dashboard.powerOff(), s.dashboard.brakeRelease(), s.dashboard.robotmode()][2],
        _equals("Robotmode: RUNNING"),
    ),
    "unlockProtectiveStop": Call(_unlocked, _equals(False)),
    "unlockProtectiveStop (nothing to unlock)": Call(
        lambda s: s.dashboard.unlockProtectiveStop(), error("Unlock protective stop failure"), REFUSED
    ),
    "play (nothing loaded)": Call(lambda s: s.new_dashboard.play(), error("Failed to execute: play"), REFUSED),
    "closePopup": _ask("closePopup", done),
    "closeSafetyPopup": _ask("closeSafetyPopup", done),
    "popup": Call(lambda s: s.dashboard.popup("look"), done),
    "addToLog": Call(lambda s: s.dashboard.addToLog("a note"), done),
    "setUserRole": Call(
        lambda s: s.dashboard.setUserRole("programmer"),
        error("incompatible function arguments"),
        REFUSED,
        "the client's roles have no Python type: no wire",
    ),
    "restartSafety": _ask("restartSafety", done),
    "send": Call(_asked, lambda v: "RUNNING" in v),
    "receive": Call(_asked, lambda v: "RUNNING" in v),
    "quit": Call(_ended("quit"), _equals([None, False])),
    "shutdown": Call(
        _ended("shutdown"),
        _equals([None, False]),
        NOT_SIMULATED,
        "the line is answered and closed; the controller stays up",
    ),
}


def _sent(s: Any) -> Any:
    said = s.script.sendScriptCommand('textmsg("hello")\n')
    time.sleep(0.1)
    return said


SCRIPT: dict[str, Call] = {
    "connect": Call(lambda s: s.script.isConnected(), true),
    "isConnected": Call(lambda s: s.script.isConnected(), true),
    "disconnect": Call(left("script"), no),
    "sendScriptCommand": Call(_sent, true, note="the line is taken; only the integers it writes are carried out"),
    "sendScript": Call(
        lambda s: [s.script.sendScript(), time.sleep(0.3), s.receive.getRuntimeState()][::2],
        _equals([True, 2]),
        note="the client's own control script runs",
    ),
    "getScript": Call(lambda s: len(s.script.getScript()) > 10_000, true, note="no wire"),
    "setScriptFile": Call(
        lambda s: s.script.setScriptFile(),
        done,
        NOT_SIMULATED,
        "no wire: called as its signature has it, without a file name, the client crashes",
        crashes=True,
    ),
}
