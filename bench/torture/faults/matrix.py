"""Every case, device by device; names are stable."""

from __future__ import annotations

from collections.abc import Iterator

from bench.torture.faults.case import Case, Scene
from bench.torture.faults.proxy import Column, Spoil

COLUMNS: dict[Column, str] = {
    "drop": "is lost",
    "stall": "and all that follow on the connection never arrive",
    "truncate": "is cut in half",
    "corrupt": "arrives with bytes changed",
    "duplicate": "arrives twice",
    "reorder": "arrives after the next one",
    "reject": "is refused",
    "away_1s": "never arrives: the device is gone for 1 s",
    "away_30s": "never arrives: the device is gone for 30 s",
    "away_never": "never arrives: the device is gone for good",
    "slow": "and each of its kind comes 0.3 s late",
    "noise": "and each of its kind is random bytes",
    "mutated": "and each of its kind comes with bytes changed",
}
# device and wire, kind → (what it is, images in the record before it is armed, which message of the kind, how many)
_ROBOT: dict[str, tuple[str, int, int, int]] = {
    "rtde/version": ("the answer to the protocol version", -1, 1, 1),
    "rtde/controller": ("the answer to the controller's version", -1, 1, 1),
    "rtde/outputs": ("the answer to the setup of outputs", -1, 1, 1),
    "rtde/inputs": ("the answer to the setup of inputs", -1, 1, 1),
    "rtde/start": ("the answer to the start of the stream", -1, 1, 1),
    "rtde/stream": ("a package of the stream", 1, 40, 1),
    "rtde/command": ("a command written to a register", 1, 5, 1),
    "dashboard/welcome": ("the dashboard's welcome", -1, 1, 1),
    "dashboard/answer": ("an answer of the dashboard", -1, 1, 1),
    "script/script": ("the control script", -1, 1, 1),
}
_CAMERA: dict[str, tuple[str, int, int, int]] = {
    "ptpip/connect": ("the answer to the command connection", -1, 1, 1),
    "ptpip/event_connect": ("the answer to the event connection", -1, 1, 1),
    "ptpip/session": ("the answer to the session", -1, 1, 1),
    "ptpip/device_info": ("the description of the device", -1, 1, 1),
    "ptpip/properties": ("the list of properties", 1, 2, 1),
    "ptpip/set": ("the answer to a setting", -1, 2, 1),
    "ptpip/release": ("the answer to the shutter", 1, 1, 1),
    "ptpip/event": ("the event of a new file", 1, 1, 1),
    "ptpip/file_info": ("the description of a file", 1, 1, 1),
    "ptpip/file": ("a packet of a file", 1, 2, 1),
    "ptpip/request": ("a request to the camera", 1, 6, 1),
}
_LIGHTBOX: dict[str, tuple[str, int, int, int]] = {
    "serial/identity": ("the box's identity", -1, 1, 1),
    "serial/light": ("a reading of the light", 1, 1, 1),
    "serial/temperature": ("a reading of the temperature", 1, 1, 1),
    "serial/pedal": ("the count of the pedal", -1, 1, 1),
    "serial/request": ("a request to the box", 1, 1, 1),
}
# What cannot be refused in the wire's own words, or cannot come in another order since it is waited for.
_NO_REFUSAL = {"rtde/controller", "rtde/stream", "rtde/command", "dashboard/welcome", "script/script"} | {
    "ptpip/event", "ptpip/request", "serial/request",
}  # fmt: skip


def _wires(device: str, scene: Scene, kinds: dict[str, tuple[str, int, int, int]]) -> Iterator[Case]:
    for place, (what, after, nth, times) in kinds.items():
        kind = place.split("/")[1]
        for column, happens in COLUMNS.items():
            if column == "reject" and place in _NO_REFUSAL:
                continue
            spoil = Spoil(kind, column, nth, times)
            yield Case(f"{device}/{place}/{column}", scene, f"{what} {happens}", spoil, after)


def _robot_itself() -> Iterator[Case]:
    def plan(kind: str, on: str = "move", nth: int = 2, **more: object) -> tuple[dict[str, object], ...]:
        return ({"device": "robot", "on": on, "kind": kind, "nth": nth, **more},)

    own = "robot/itself"
    yield Case(f"{own}/protective_stop", "arm", "a protective stop in a motion", faults=plan("protective_stop"), mend="unlock")
    yield Case(f"{own}/emergency_stop", "arm", "the emergency stop in a motion", faults=plan("emergency_stop"), mend="power_up")
    yield Case(f"{own}/joint_limit", "arm", "a joint at its limit", faults=plan("joint_limit"), mend="unlock")
    yield Case(f"{own}/motion_refused", "arm", "the controller does not start a motion", faults=plan("reject"))
    yield Case(f"{own}/script_ends", "arm", "the control script ends at a command", faults=plan("reject", "command", 6))
    yield Case(f"{own}/no_ik", "arm", "views out of the arm's reach", act="nothing", value={"distance_m": 1.9})
    yield Case(f"{own}/slider_0", "arm", "the speed slider at 0", after=1, act="slider", value={"fraction": 0.0}, mend="slider_up")
    yield Case(f"{own}/slider_10", "arm", "the speed slider at 10 %", after=1, act="slider", value={"fraction": 0.1})


def cases() -> dict[str, Case]:
    """By name, in the order of the table."""
    found = [
        *_wires("robot", "arm", _ROBOT),
        *_robot_itself(),
        *_wires("camera", "camera", _CAMERA),
        *_wires("lightbox", "lightbox", _LIGHTBOX),
    ]
    return {case.name: case for case in found}
