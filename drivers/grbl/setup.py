"""What a GRBL controller's settings say, and which of them do not suit a machine that poses a camera; no I/O."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import DeviceFaultError
from drivers.grbl import LETTERS, GrblAxis
from drivers.grbl.wire import Feedback, Setting
from service.core.geometry import Array

_IDLE_DELAY, _INCHES, _SOFT_LIMITS, _HARD_LIMITS, _HOMING = 1, 13, 20, 21, 22
_STAY_ON = 255  # $1: the motors hold the axes after a motion
_ACCELERATION, _TRAVEL = 120, 130


@dataclass(frozen=True, slots=True)
class Setup:
    """The settings of the axes in use, in machine units: degrees or millimetres."""

    build: str  # version and date of the firmware
    name: str  # that its owner gave the machine, or ""
    acceleration: Array  # (N,), a second squared
    problems: tuple[str, ...]


def setup_of(
    settings: Iterable[Setting | Feedback], build: Iterable[Setting | Feedback], axes: Sequence[GrblAxis], where: str
) -> Setup:
    """Judge the answers to `$$` and `$I`.

    Raises DeviceFaultError for another version than 1.1, and for settings with which positions would be wrong.
    """
    values = {one.number: one.value for one in settings if isinstance(one, Setting)}
    said = dict(one.text.split(":", 1) for one in build if isinstance(one, Feedback) and ":" in one.text)
    version, _, name = said.get("VER", "").partition(":")
    if not version.removeprefix("v").startswith("1.1"):
        raise DeviceFaultError(
            f"the firmware is {version or 'unknown'}, not GRBL 1.1",
            where=where,
            remedy="Install GRBL 1.1 or a later 1.1x",
        )
    _refuse_unsuitable(values, where)
    indices = [LETTERS.index(axis.letter) for axis in axes]
    lacking = [axis.letter for axis, i in zip(axes, indices, strict=True) if _ACCELERATION + i not in values]
    if lacking:
        remedy = "Correct `axes` in rig.yaml"
        raise DeviceFaultError(f"the controller has no axis {', '.join(lacking)}", where=where, remedy=remedy)
    return Setup(
        build=version.removeprefix("v"),
        name=name,
        acceleration=np.array([values[_ACCELERATION + i] for i in indices]),
        problems=tuple(_problems(values, axes)),
    )


def _refuse_unsuitable(values: dict[int, float], where: str) -> None:
    unsuitable = (
        (values.get(_INCHES) != 0, "it reports inches", "$13=0"),
        (values.get(_HOMING) != 1, "homing is off, so that nobody knows the position after a stop", "$22=1"),
    )
    for wrong, what, setting in unsuitable:
        if wrong:
            raise DeviceFaultError(
                f"the controller's settings do not suit: {what}",
                where=where,
                remedy=f"Set {setting} at its console (docs/howto/grbl.md)",
            )


def _problems(values: dict[int, float], axes: Sequence[GrblAxis]) -> Iterable[str]:
    if values.get(_SOFT_LIMITS) != 1:
        yield "Soft limits are off ($20=0): the controller does not keep the axes within their travel. Set $20=1"
    if values.get(_HARD_LIMITS) != 1:
        yield "Hard limits are off ($21=0): a limit switch does not stop the axes. Set $21=1"
    if values.get(_IDLE_DELAY) != _STAY_ON:
        yield f"The motors are released after a motion, and the axes may give way. Set $1={_STAY_ON}"
    for axis in axes:
        travel = values.get(_TRAVEL + LETTERS.index(axis.letter), 0.0)
        if axis.lowest < -travel or axis.highest > 0:
            yield (
                f"The range of axis {axis.letter} in rig.yaml, {axis.lowest:g} to {axis.highest:g}, is not within "
                f"its travel of {-travel:g} to 0. Correct it"
            )
