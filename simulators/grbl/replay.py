"""What a recorded GRBL controller said, served again: settings, build, options and the state after power-up."""

from __future__ import annotations

import re
from dataclasses import dataclass

from simulators.grbl.machine import AXES, FACTORY
from simulators.recordings import TAKEN_OUT, RecordedDevice
from simulators.serve import SimulatorError

OWN_NAME = "simulated table"
_SETTING = re.compile(r"\$(?P<number>\d{1,3})=(?P<value>-?\d+(?:\.\d+)?)")
_BUILD = re.compile(r"\[VER:(?P<build>[^:\]]*):?(?P<name>[^\]]*)\]")
_VERSION = re.compile(r"v?\d+\.\d+[a-z]?")  # the build without its date
_STATES = ("Idle", "Alarm")  # in which a controller is after a reset
_USED = (10, 20, 21, 22, 25, 27)  # by the simulated machine, besides those of the axes
_PER_AXIS = 100  # settings from here on: ten numbers for each quantity, one for each axis


@dataclass(frozen=True, slots=True)
class Said:
    """Holds version, build and settings as a controller states them."""

    version: str  # as in its welcome
    build: tuple[str, ...]  # lines of the answer to `$I`
    listed: tuple[int, ...]  # settings that it has
    state: str = ""  # after power-up; "": that which homing ($22) demands
    not_served: tuple[str, ...] = ()


def recorded(device: RecordedDevice) -> tuple[Said, dict[int, float]]:
    """Read what a controller said of itself, and its settings. Raises SimulatorError if that is too little."""
    not_served: list[str] = []
    settings: dict[int, float] = {}
    for line in device.lines("$$"):
        if found := _SETTING.fullmatch(line):
            settings[int(found["number"])] = float(found["value"])
        else:
            not_served.append(f"$$: {line}")
    build = [_own_name(line, not_served) for line in device.lines("$I")]
    version = next((found["build"] for line in build if (found := _BUILD.fullmatch(line))), "")
    stated = _VERSION.match(version)
    if not settings or stated is None:
        raise SimulatorError(f"{device.name} stated no settings or no version: there is nothing to serve")
    beyond = [number for number in settings if number >= _PER_AXIS and number % 10 >= AXES]
    if beyond:
        numbers = ", ".join(f"${number}" for number in beyond)
        not_served.append(f"$$: {numbers}: listed, but the simulated machine has {AXES} axes")
    not_served += [
        f"$$: ${number} was not recorded; the machine moves as with {value:g}"
        for number, value in FACTORY.items()
        if number not in settings and (number >= _PER_AXIS or number in _USED)
    ]
    state = next(iter(device.lines("?")), "")
    if state not in ("", *_STATES):
        not_served.append(f"?: {state}; it starts as after power-up")
        state = ""
    served = ("$$", "$I", "?")
    not_served += [f"{asked}: {answer}" for asked, answer in device.exchanges.items() if asked not in served]
    not_served += device.unanswered
    return Said(stated[0].removeprefix("v"), tuple(build), tuple(settings), state, tuple(not_served)), settings


def _own_name(line: str, not_served: list[str]) -> str:
    """The line with the simulated machine's name, where the owner's was taken out."""
    if TAKEN_OUT.search(line):
        not_served.append(f"$I: {line}")
        return TAKEN_OUT.sub(OWN_NAME, line)
    return line
