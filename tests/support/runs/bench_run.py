"""A small run on the in-memory rig, through the public interface of store and runner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from service.core.protocol import Protocol, parse_protocol
from service.core.records.run_events import OperatorAction, ViewpointCaptured
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.rig import load_rig
from service.run_start import recorded_run, start_run
from service.runner.loop import Runner, Starvation
from service.steps import params_models
from service.store.durable_effects import SystemClock
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.timestamps import Authority
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.stepped_clock import SteppedClock
from tests.support.rig.bench_rig import Answer, BenchRig, ScriptedOperator, answer

VIEWS = ["v001", "v002", "v003", "v004"]  # of the capture in PROTOCOL
PROTOCOL = """\
id: bench
version: "1"
title: A small procedure
spheres: {radius_mm: 15, registration: 10, control: 3}
board: {columns: 4, rows: 5, square_mm: 15}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
motion: {dwell_s: 0.0}
settle: {window_s: 0.01, timeout_s: 5}
steps:
  - id: fixation
    kind: checklist
    title: Fix the specimen
    checklist: [wires hold, board lies]
    gates: [{measure: checklist_items_open, max: 0}]
    skippable: true
  - id: capture
    kind: viewpoint_capture
    title: Capture
    params:
      purpose: dataset
      viewpoints:
        - station: station_1
          prefix: v
          arcs: [{tilt_deg: 20, azimuth_from_deg: -50, azimuth_to_deg: 50, count: 4, distance_m: 0.6}]
    gates:
      - {measure: viewpoints_captured, min: 3}
      - {measure: settings_departures, max: 0}
      - {measure: moved_during_exposure, max: 0}
    recovery: {retries: 2, wait_s: 0}
  - id: spraying
    kind: timed_application
    title: Spray
    irreversible: true
    sign: true
    requires: [capture]
    params: {product: Blue, sublimates_after_s: 60, scan_within_s: 30}
"""
P = TypeVar("P")


@dataclass
class Squeezed:
    """A program that could not run for this long, and for this share of the time in which it wanted to."""

    seconds: float
    share: float


def unhindered() -> Squeezed:
    """Measure nothing of the machine on which the tests run: how busy that is decides no test."""
    return Squeezed(0.0, 0.0)


@dataclass
class Bench:
    """One run on an in-memory rig, which lives by the store's clock."""

    store: Store
    run_id: str
    data: Path
    rig: BenchRig = field(default_factory=BenchRig)
    operator: ScriptedOperator = field(default_factory=ScriptedOperator)
    authority: Authority | None = None
    second_place: SecondPlace | None = None
    held_up: Callable[[], Starvation] = unhindered
    on_wait: Callable[[float], None] | None = None  # called when the runner waits, in a store of `bench_store`

    @property
    def clock(self) -> SteppedClock:
        """The time of store, runner and devices, of a store that `bench_store` has opened."""
        clock = self.store.clock
        assert isinstance(clock, SteppedClock)
        return clock

    @property
    def protocol(self) -> Protocol:
        """The recorded protocol."""
        return recorded_run(self.store, self.run_id)[0]

    def run(self) -> RunState:
        """Run one runner process to its end."""
        self.rig.keep_time(self.store.clock)
        if self.on_wait is not None:
            self.clock.on_sleep = self.on_wait
        protocol, _ = recorded_run(self.store, self.run_id)
        return Runner(
            self.store,
            self.run_id,
            protocol,
            self.rig,
            self.operator,
            self.authority,
            self.second_place,
            self.held_up,
        ).run()

    def act(self, verb: str, **fields: object) -> None:
        """Append an action, as from another terminal."""
        action = OperatorAction.model_validate({"action": verb, **fields})
        self.store.record(self.run_id, [action], actor="Grace")

    def state(self) -> RunState:
        protocol, _ = recorded_run(self.store, self.run_id)
        return fold(protocol, self.store.events(self.run_id))

    def payloads(self, kind: type[P]) -> list[P]:
        """All payloads of a kind, in order."""
        return [e.payload for e in self.store.events(self.run_id) if isinstance(e.payload, kind)]

    def captured(self) -> list[str]:
        """The viewpoints in the order of their exposures, including repetitions."""
        return [capture.viewpoint for capture in self.payloads(ViewpointCaptured)]

    def script(self, step: str, kind: str, *answers: Answer) -> None:
        """Set the operator's answers to a question."""
        self.operator.script = {**self.operator.script, (step, kind): list(answers)}

    def must_verify(self) -> None:
        """Assert that the evidence is intact."""
        report = verify(self.data, self.run_id)
        assert report.ok, report.first_fault


class HastyClock(SystemClock):
    """The host's clocks, for a run beside other processes whose time matters: it waits for 2 ms at most."""

    def sleep(self, seconds: float) -> None:
        super().sleep(min(seconds, 0.002))


def bench_store(data: Path) -> Store:
    """A data folder in which time passes only when a runner waits, a device works, or a test says so."""
    return Store.open(data, SteppedClock.from_now())


def begin_run(store: Store, text: str, folder: Path) -> Bench:
    """Begin a run of a protocol text in the store of folder/data, without running it; its rig file has no devices."""
    rig_file = folder / "rig.yaml"
    rig_file.write_text("name: bench\nsimulated: true\ndevices: {}\n")
    loaded = parse_protocol(text.encode(), params_models(), name="bench.yaml")
    run_id = start_run(store, loaded, load_rig(rig_file), operator="Ada", auto_confirm=False)
    return Bench(store, run_id, folder / "data")


def record_runs(folder: Path) -> tuple[str, str]:
    """Record a completed run and, after it, one that waits for its first confirmation, in folder/data."""
    with bench_store(folder / "data") as store:
        completed = begin_run(store, PROTOCOL, folder)
        completed.run()
        return completed.run_id, begin_run(store, PROTOCOL, folder).run_id


def say(verb: str, **fields: object) -> Answer:
    """An answer with the step's id, checklist or signature filled in."""
    return lambda question, _state: answer(question, verb, **fields)


class KilledError(BaseException):
    """The process was killed."""
