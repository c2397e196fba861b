"""What a recorded controller said, served again: model, version, words, calibration, modes, payload and joints."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from simulators.recordings import TAKEN_OUT, RecordedDevice
from simulators.serve import SimulatorError
from simulators.ur_controller import fields, kinematics
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.dashboard import Dashboard, Words
from simulators.ur_controller.kinematics import MODELS, Array, Model, Six
from simulators.ur_controller.modes import SAFETY_BITS, RobotMode, SafetyMode
from simulators.ur_controller.program import Interpreter

_VERSION = re.compile(r"([0-9]{1,3})\.([0-9]{1,3})")
_OF_THE_PROGRAM = ("running", "programstate", "get loaded program")
_NO_TOOL_M = 1e-9
_SET = ("actual_q", "robot_mode", "safety_status_bits", "target_speed_fraction", "payload", "payload_cog")


@dataclass(frozen=True, slots=True)
class Recorded:
    """A controller of a recording, before it starts."""

    model: Model
    version: fields.Version
    joints: Array | None  # (6,); None if its stream was not open
    answers: Mapping[str, str]
    sample: Mapping[str, tuple[float, ...]]
    unanswered: tuple[str, ...]

    def set_up(self, controller: Controller) -> Words:
        """Put a controller into the recorded state; returns the words in which its dashboard answered."""
        said = self.sample
        controller.local = self.answers.get("is in remote control", "").lower() == "false"
        if "robot_mode" in said:
            controller.robot_mode = RobotMode(int(said["robot_mode"][0]))
        if "safety_status_bits" in said:
            controller.safety = _safety(int(said["safety_status_bits"][0]))
        controller.set_speed(said.get("target_speed_fraction", (1.0,))[0])
        controller.payload_kg = said.get("payload", (0.0,))[0]
        controller.payload_cog_m = list(said.get("payload_cog", (0.0, 0.0, 0.0)))
        if self.joints is not None and "actual_TCP_pose" in said:
            T_base_flange = kinematics.forward(self.model, self.joints)
            T_base_tcp = kinematics.from_pose(np.array(said["actual_TCP_pose"]))
            tool = kinematics.to_pose(kinematics.rigid_inverse(T_base_flange) @ T_base_tcp)
            controller.set_tcp(np.where(np.abs(tool) < _NO_TOOL_M, 0.0, tool))
        own = Dashboard(controller, Interpreter(controller))
        return {
            (question.lower(), own.answer(question)): answer
            for question, answer in self.answers.items()
            if question.lower() not in _OF_THE_PROGRAM and not TAKEN_OUT.search(answer)
        }

    @property
    def not_served(self) -> tuple[str, ...]:
        """Return what the recording holds and the simulator answers by itself, and what it does not hold."""
        own = [
            f"dashboard, {question}: {answer}"
            for question, answer in self.answers.items()
            if question.lower() in _OF_THE_PROGRAM or TAKEN_OUT.search(answer)
        ]
        own += [f"RTDE, {name}" for name in self.sample if name not in (*_SET, "actual_TCP_pose")]
        return (*own, *self.unanswered)


def recorded(device: RecordedDevice) -> Recorded:
    """Read what a controller said. Raises SimulatorError for one of which no simulator can be made."""
    answers = device.exchanges
    stated = _VERSION.search(answers.get("PolyscopeVersion", ""))
    if stated is None:
        raise SimulatorError(f"{device.name} did not tell its version: there is nothing to serve")
    version = (int(stated[1]), int(stated[2]))
    name = answers.get("get robot model", "")
    model = next((MODELS[known] for known in (f"{name}e", name) if known in MODELS and _fits(known, version)), None)
    if model is None:
        raise SimulatorError(f"{device.name} is a {name or 'robot of unknown model'}; there is {', '.join(MODELS)}")
    own = device.sample("primary interface")
    if own:
        model = replace(model, **{field: cast(Six, values) for field, values in own.items()})
    sample = device.sample("RTDE")
    joints = np.array(sample["actual_q"]) if "actual_q" in sample else None
    return Recorded(model, version, joints, answers, sample, device.unanswered)


def _fits(model: str, version: fields.Version) -> bool:
    return MODELS[model].e_series == (version[0] >= 5)


def _safety(bits: int) -> SafetyMode:
    """The mode of these bits. Raises SimulatorError for a combination that is not known."""
    for mode, known in SAFETY_BITS.items():
        if known == bits:
            return mode
    raise SimulatorError(f"the recorded safety bits {bits:#x} are those of no known mode")
