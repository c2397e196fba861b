"""Reads recordings of devices: the files of `orthocapture doctor --record FILE`, in the form of drivers/recording."""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from simulators.serve import SimulatorError

_FORM, _VERSION = "orthocapture device recording", 1
# What stands in a recording instead of personal data.
TAKEN_OUT = re.compile(r"\((?:serial number|program|file|address|path|e-mail) \d+\)")


@dataclass(frozen=True, slots=True)
class RecordedDevice:
    """One device of a recording."""

    name: str
    kind: str
    driver: str
    report: dict[str, Any]
    answers: dict[str, Any]

    @property
    def listing(self) -> dict[str, Any]:
        """The properties of a still camera. Raises SimulatorError if it stated none."""
        if not self.answers.get("listing"):
            raise SimulatorError(f"the recording holds no properties of {self.name}")
        return self.answers["listing"]

    @property
    def exchanges(self) -> dict[str, str]:
        """The answer to each question."""
        return {one["question"]: one["answer"] for one in self.answers.get("exchanges", ())}

    def lines(self, question: str) -> tuple[str, ...]:
        """All lines with which a question was answered."""
        return tuple(said["answer"] for said in self.answers.get("exchanges", ()) if said["question"] == question)

    @property
    def silent(self) -> tuple[str, ...]:
        """Return the questions that were asked in vain, each with the reason."""
        return tuple(self.answers.get("silent", ()))

    @property
    def unanswered(self) -> tuple[str, ...]:
        """Return the same in the words of a ready line, which names what is not served."""
        return tuple(f"not recorded: {question}" for question in self.silent)

    def sample(self, source: str) -> dict[str, tuple[float, ...]]:
        """The numbers of a source that begins so; none if it was silent."""
        found = next((one for one in self.answers.get("samples", ()) if one["source"].startswith(source)), None)
        return {} if found is None else {name: tuple(values) for name, values in found["fields"].items()}


def add_replay(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a simulator that serves what a recording says."""
    parser.add_argument(
        "--replay", type=Path, metavar="FILE", help="serve what `orthocapture doctor --record FILE` has written"
    )
    parser.add_argument(
        "--replayed", default="", metavar="NAME", help="which device of the recording; default: the first that fits"
    )


def not_recorded(args: argparse.Namespace) -> list[str]:
    """Return what the body that is replayed did not tell when it was recorded, and what was taken out."""
    if not args.replay:
        return []
    device = recorded_device(args.replay, "gphoto", args.replayed)
    texts = [one["code"] for one in device.listing["properties"] if one["type"] == "str" and not one["value"]]
    empty = [f"texts that are empty or were taken out: {', '.join(texts)}"] if texts else []
    return [*empty, *device.unanswered]


def recorded_devices(file: Path) -> tuple[RecordedDevice, ...]:
    """The devices of a recording. Raises SimulatorError if it cannot be read."""
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SimulatorError(f"the recording {file.name} cannot be read: {error}") from error
    if not isinstance(data, dict):
        data = {}
    found = cast("dict[str, Any]", data)
    if (found.get("form"), found.get("version")) != (_FORM, _VERSION):
        raise SimulatorError(f"{file.name} is no recording of devices of version {_VERSION}")

    return tuple(
        RecordedDevice(name, one["kind"], one["driver"], one.get("report") or {}, one.get("answers") or {})
        for name, one in found["devices"].items()
    )


def recorded_device(file: Path, driver: str, name: str = "") -> RecordedDevice:
    """The device of this name, or the first of a driver. Raises SimulatorError if there is none."""
    devices = recorded_devices(file)
    for device in devices:
        if device.driver == driver and name in ("", device.name):
            return device
    there = ", ".join(f"{device.name} ({device.driver})" for device in devices) or "none"
    raise SimulatorError(f"{file.name} holds no {name or 'device'} of the driver {driver}; there is {there}")
