"""The file in which a rig's devices are recorded: JSON that a stranger can read, and that simulators serve.

`orthocapture doctor --record FILE` writes it. Fields that are empty are left out. A change that readers of
version 1 would misunderstand gets the next number.
"""

from __future__ import annotations

import json
from typing import Any, Literal, cast

from pydantic import Field

from drivers.interfaces import DeviceAnswers, DeviceReport
from drivers.interfaces.answers import Part

_LINE = 110  # what fits stands on one line


class RecordedDevice(Part):
    """One device: what its driver reported, and what it said word for word."""

    kind: str = Field(description="robot, camera, scanner, ct or lightbox")
    driver: str
    report: DeviceReport | None = Field(default=None, description="as `orthocapture doctor` shows it")
    error: str = Field(default="", description="why it could not be opened, or gave no report")
    answers: DeviceAnswers = DeviceAnswers()


class Recording(Part):
    """The devices of a rig, named by their kind."""

    form: Literal["orthocapture device recording"] = "orthocapture device recording"
    version: Literal[1] = 1
    by: str = Field(description="the program that wrote it")
    recorded_utc: str = ""
    source: str = Field(default="", description="where it was published, if it was transcribed")
    taken_out: tuple[str, ...] = Field(default=(), description="personal data that is not in the file")
    devices: dict[str, RecordedDevice]


def readable(recording: Recording) -> str:
    """The text of the file: JSON with each property, exchange or list of numbers on one line."""
    head = {"form": recording.form, "version": recording.version}
    return _text(head | recording.model_dump(mode="json", exclude_defaults=True)) + "\n"


def _text(value: Any, indent: str = "") -> str:
    line = json.dumps(value, ensure_ascii=False)
    if len(line) <= _LINE or not isinstance(value, dict | list) or _is_flat(value):
        return line
    inner = indent + " "
    if isinstance(value, dict):
        named = cast("dict[str, Any]", value).items()
        parts = [f"{json.dumps(key, ensure_ascii=False)}: {_text(part, inner)}" for key, part in named]
    else:
        parts = [_text(part, inner) for part in cast("list[Any]", value)]
    begin, end = "{}" if isinstance(value, dict) else "[]"
    return f"{begin}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{end}"


def _is_flat(value: Any) -> bool:
    """Return whether it is a list of numbers, or a property, however many choices it has."""
    if isinstance(value, dict):
        return "code" in value
    return all(isinstance(part, int | float) for part in cast("list[Any]", value))
