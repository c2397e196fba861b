"""What a recorded KUKA application said, served again: model, software, mode, safety, override, joints and clock."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import cast

import numpy as np

from simulators.kuka_controller.controller import MODES, SAFETY, Controller
from simulators.kuka_controller.kinematics import MODELS, Array, Model
from simulators.recordings import TAKEN_OUT, RecordedDevice
from simulators.serve import SimulatorError

_STATE = re.compile(r"mode (?P<mode>.*), safety (?P<safety>\w+), ready (?P<ready>\w+), locked (?P<locked>\w+)")
_TAKEN_FOR = {"safeguard_stop": "external_stop"}  # older recordings have one word for two of the wire's
_APART_RAD = 1e-3  # of a resting arm's measured joints from the commanded ones
_SERVED = ("time_s", "joints_rad", "commanded_rad", "override")


@dataclass(frozen=True, slots=True)
class Recorded:
    """An application of a recording, before it starts."""

    model: Model
    serial: str  # "": it was taken out
    software: str
    mode: str
    safety: str
    ready: bool
    joints: Array | None  # (7,); None if its stream told nothing
    override: float
    time_s: float
    not_served: tuple[str, ...]

    def set_up(self, controller: Controller) -> None:
        """Put a controller into the recorded state."""
        controller.software, controller.mode, controller.safety = self.software, self.mode, self.safety
        controller.ready, controller.override, controller.time_s = self.ready, self.override, self.time_s


def recorded(device: RecordedDevice) -> Recorded:
    """Read what an application said. Raises SimulatorError for one of which no simulator can be made."""
    answers, stream = device.exchanges, device.sample("stream")
    greeting = _greeting(device.name, answers)
    model, serial = MODELS.get(greeting["model"]), greeting["serial"]
    if model is None:
        raise SimulatorError(f"{device.name} is a {greeting['model']!r}; there is {', '.join(sorted(MODELS))}")
    not_served: list[str] = []
    if TAKEN_OUT.search(serial):
        not_served.append(f"greeting, serial number: {serial}")
        serial = ""
    found = _STATE.fullmatch(answers.get("state", ""))
    state = found.groupdict() if found else {}
    if "state" in answers and not found:
        not_served.append(f"state: {answers['state']}")
    mode, safety = state.get("mode", "AUT"), state.get("safety", "normal")
    if mode not in MODES:
        raise SimulatorError(f"{device.name} was in the mode {mode!r}; there is {', '.join(MODES)}")
    if safety not in SAFETY:
        said = _TAKEN_FOR.get(safety, safety)
        not_served.append(f"state, safety {safety}: the wire's own word was not recorded; served as {said}")
        safety = said
    if state.get("locked") == "False":
        not_served.append("state, locked False: a client finds the arm locked")
    joints = np.array(stream["joints_rad"]) if len(stream.get("joints_rad", ())) == len(model.limits_rad) else None
    if joints is not None and not np.allclose(joints, stream.get("commanded_rad", joints), atol=_APART_RAD):
        not_served.append("stream, commanded_rad: served equal to joints_rad")
    not_served += [f"stream, {name}" for name in stream if name not in _SERVED]
    not_served += [f"{asked}: {answer}" for asked, answer in answers.items() if asked not in ("greeting", "state")]
    details = cast("dict[str, str]", device.report.get("details", {}))
    not_served += [f"report, {name}: {text}" for name, text in details.items() if name.startswith("FRI")]
    return Recorded(
        model,
        serial,
        greeting["software"],
        mode,
        safety,
        state.get("ready") != "False",
        joints,
        stream.get("override", (1.0,))[0],
        stream.get("time_s", (0.0,))[0],
        (*not_served, *device.unanswered),
    )


def _greeting(name: str, answers: dict[str, str]) -> dict[str, str]:
    """The fields of the greeting. Raises SimulatorError without them."""
    try:
        said: object = json.loads(answers.get("greeting", ""))
    except ValueError:
        said = None
    fields = cast("dict[str, object]", said) if isinstance(said, dict) else {}
    texts = {key: value for key in ("model", "serial", "software") if isinstance(value := fields.get(key), str)}
    if len(texts) != 3:
        raise SimulatorError(f"{name} gave no greeting: there is nothing to serve")
    return texts
