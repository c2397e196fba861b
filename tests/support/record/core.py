"""A small protocol with toy step kinds, and a log that creates events without a store."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from datetime import datetime, timedelta
from typing import Any

from pydantic import Field

from service.core.protocol import LoadedProtocol, Protocol, parse_protocol
from service.core.records.base import ArtefactRef
from service.core.records.events import Event, Payload
from service.core.records.run_events import (
    OperatorAction,
    OperatorVerb,
    RunStarted,
    StepMeasured,
    StepPassed,
    StepStarted,
    ViewImported,
    ViewpointCaptured,
)
from service.core.run.decide import AskOperator, Decision, RunState, advance, decide, evaluate_gates, initial_state
from service.core.step_params import MovingParams, StepParams


class ChecklistParams(StepParams):
    """No parameters."""


class CaptureParams(MovingParams):
    """Views to take."""

    views: int = Field(ge=1)
    distance_m: float = 0.6


KINDS: dict[str, type[StepParams]] = {
    "checklist": ChecklistParams,
    "capture": CaptureParams,
    "spray": ChecklistParams,
    "registration": ChecklistParams,
}

TOY = """\
id: toy
version: "1.0"
title: A toy
spheres: {radius_mm: 15, registration: 10, control: 3}
camera: {aperture_f: 22, exposure_s: 1/15, iso: 100}
steps:
  - id: fix_it
    kind: checklist
    title: Fix
    checklist: [wires hold, board lies]
    skippable: true
  - id: capture
    kind: capture
    title: Capture
    params: {views: 3}
    sign: true
    skippable: true
    gates:
      - {measure: views, min: 3, unit: views}
      - {measure: sharp, min: 0.2, max: 1.0}
    recovery: {retries: 2, on_failure: ask}
  - id: spray
    kind: spray
    title: Spray
    checklist: [window open]
    irreversible: true
    sign: true
    requires: [capture]
  - id: scan
    kind: checklist
    title: Scan
    confirm: false
    gates: [{measure: rms_mm, max: 0.1, unit: mm}]
    skippable: true
  - id: register
    kind: registration
    title: Register
    confirm: false
"""


def toy_protocol(text: str = TOY) -> Protocol:
    """Load the toy protocol, or another text."""
    return load(text).protocol


def load(text: str) -> LoadedProtocol:
    """Load a protocol text as if it were the file lab.yaml."""
    return parse_protocol(text.encode(), KINDS, name="lab.yaml")


def artefact(kind: str = "image") -> ArtefactRef:
    """A reference to no file."""
    return ArtefactRef(sha256="0" * 64, kind=kind, media_type="image/jpeg", size_bytes=1, original_name="a.jpg")


EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def captured(step: str, attempt: int, viewpoint: str) -> ViewpointCaptured:
    """A capture event with plausible figures."""
    return ViewpointCaptured(
        step=step,
        attempt=attempt,
        viewpoint=viewpoint,
        station="station_1",
        artefacts=(artefact(),),
        T_base_flange=EYE,
        pose_sigma_m=0.0,
        pose_sigma_rad=0.0,
        joints_rad=(0.0,) * 6,
        pose_samples=10,
        trigger_monotonic_s=1.0,
        arrival_monotonic_s=2.0,
        controller_time_s=1.0,
        clock_offset_s=0.0,
        camera={},
    )


def imported(step: str, attempt: int, viewpoint: str) -> ViewImported:
    """An imported photograph."""
    return ViewImported(
        step=step,
        attempt=attempt,
        viewpoint=viewpoint,
        station="",
        artefacts=(artefact(),),
        camera={},
        imported_by="Ada",
        file_name=f"images/{viewpoint}.jpg",
        modified_utc="2024-03-01T10:00:00Z",
    )


class Log:
    """The events of one run, folded as they are appended."""

    def __init__(
        self, protocol: Protocol | None = None, *, simulated: bool = True, auto_confirm: bool = True
    ) -> None:
        self.protocol = protocol or toy_protocol()
        self.events: list[Event] = []
        self.late_s = 0.0  # by which the next events come later
        self.state: RunState = initial_state(self.protocol)
        self.append(
            RunStarted(
                protocol_id=self.protocol.id,
                protocol_version=self.protocol.version,
                protocol_sha256="0" * 64,
                protocol=artefact("protocol"),
                rig=artefact("rig"),
                simulated=simulated,
                auto_confirm=auto_confirm,
                operator="Ada",
                software={},
            )
        )

    def event(self, payload: Payload, actor: str = "runner") -> Event:
        """The event that would come next."""
        seq = len(self.events) + 1
        at = datetime(2026, 11, 21) + timedelta(seconds=self.late_s, microseconds=seq)  # noqa: DTZ001 - written as UTC
        return Event(
            seq=seq,
            run_id="run",
            at_utc=f"{at.isoformat(timespec='microseconds')}Z",
            monotonic_s=seq + self.late_s,
            actor=actor,
            payload=payload,
            previous_sha256="0" * 64,
            sha256=hashlib.sha256(str(seq).encode()).hexdigest(),
        )

    def append(self, payload: Payload, actor: str = "runner") -> RunState:
        """Fold one more event; a refused one (IntegrityError) leaves no trace."""
        event = self.event(payload, actor)
        self.state = advance(self.protocol, self.state, event)
        self.events.append(event)
        return self.state

    def act(self, action: OperatorVerb, actor: str = "Ada", **fields: Any) -> RunState:
        """Append an operator's action, whether allowed or not."""
        return self.append(OperatorAction.model_validate({"action": action, **fields}), actor)

    @property
    def decision(self) -> Decision:
        """The current decision."""
        return decide(self.protocol, self.state)

    @property
    def question(self) -> AskOperator:
        """The open question; fails if there is none."""
        decision = self.decision
        assert isinstance(decision, AskOperator), decision
        return decision

    # --- shortcuts through a step ---

    def confirm(self) -> RunState:
        """Confirm the current step with every item ticked."""
        return self.act("confirm", checklist=self.protocol.step(self.state.current).checklist)

    def sign(self) -> RunState:
        """Sign what is due."""
        return self.act("sign", meaning="I have checked this", signed_sha256=self.question.sign_sha256)

    def begin(self) -> RunState:
        """Release, confirm and start the current step, as far as each is due."""
        while isinstance(self.decision, AskOperator):
            if self.question.for_ == "sign":
                self.sign()
            else:
                self.confirm()
        return self.append(StepStarted(step=self.state.current, attempt=self.state.step.attempt))

    def measure(self, **measures: float) -> RunState:
        """Finish the work of the current step with these measures, and judge its gates."""
        step, attempt = self.state.current, self.state.step.attempt
        self.append(StepMeasured(step=step, attempt=attempt, measures=measures))
        return self.append(evaluate_gates(self.protocol.step(step), attempt, measures))

    def accept(self) -> RunState:
        """Sign if due, and pass the step."""
        if isinstance(self.decision, AskOperator):
            self.sign()
        return self.append(StepPassed(step=self.state.current, attempt=self.state.step.attempt))

    def do(self, **measures: float) -> RunState:
        """Do the whole current step."""
        self.begin()
        self.measure(**measures)
        return self.accept()

    def capture(self, viewpoints: Iterable[str]) -> RunState:
        """Take viewpoints in the running step."""
        for viewpoint in viewpoints:
            self.append(captured(self.state.current, self.state.step.attempt, viewpoint))
        return self.state


GOOD = {"views": 3.0, "sharp": 0.5}
