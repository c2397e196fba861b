"""The run that the crash sweep kills, and its processes: runner, worker, and the release recorded by the web."""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bench.torture.crash.remembered import remembering
from bench.torture.crash.scene import CAMERA, LAYOUT, VIEWPOINTS, CrashRig, prepare_files
from service.core.gates import evaluate_gates, refuse_release
from service.core.protocol import parse_protocol
from service.core.records.run_events import RunReleased, StepMeasured, StepStarted
from service.core.run.fold import fold
from service.rig import load_rig
from service.run_start import recorded_run, start_run
from service.runner import loop as runner_loop
from service.runner.held_run import software_versions
from service.steps import params_models
from service.store.durable_effects import SystemClock
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.worker import loop
from tests.support.processes.mortal_files import MortalFiles, Point
from tests.support.rig.bench_rig import ScriptedOperator

_SOFTWARE = software_versions()
Role = Literal["begin", "runner", "worker", "web"]
_ARC = VIEWPOINTS.arcs[0]
PROTOCOL = f"""\
id: torture
version: "1"
title: A procedure to be killed
release: second_person
spheres: {{radius_mm: 15, registration: 10}}
camera: {{aperture_f: 22, exposure_s: 1/50, iso: 100}}
motion: {{dwell_s: 0.0}}
settle: {{window_s: 0.01, timeout_s: 5}}
steps:
  - id: calibration
    kind: calibration
    title: Calibrate
    confirm: false
    params: {{solve: [intrinsics, hand_eye]}}
  - id: fixation
    kind: checklist
    title: Fix the specimen
    checklist: [wires hold, board lies]
    gates: [{{measure: checklist_items_open, max: 0}}]
    sign: true
  - id: photographs
    kind: image_import
    title: Bring photographs in
    confirm: false
    params: {{photographs: control_image}}
    gates: [{{measure: images_imported, min: 2}}]
  - id: capture
    kind: viewpoint_capture
    title: Capture
    params:
      purpose: dataset
      viewpoints:
        - station: {LAYOUT.name}
          prefix: {VIEWPOINTS.prefix}
          arcs:
            - tilt_deg: {_ARC.tilt_deg}
              azimuth_from_deg: {_ARC.azimuth_from_deg}
              azimuth_to_deg: {_ARC.azimuth_to_deg}
              count: {_ARC.count}
              distance_m: {_ARC.distance_m}
    gates:
      - {{measure: viewpoints_captured, min: {_ARC.count}}}
      - {{measure: settings_departures, max: 0}}
      - {{measure: moved_during_exposure, max: 0}}
  - id: spraying
    kind: timed_application
    title: Spray
    irreversible: true
    sign: true
    requires: [capture]
    params: {{product: Blue, sublimates_after_s: 600, scan_within_s: 300}}
  - id: scan
    kind: scan_import
    title: Scan
    params: {{spheres: 10, application: spraying, wait_s: 10}}
    gates: [{{measure: spheres_found, min: 10, max: 10}}]
  - id: registration
    kind: registration
    title: Register
    confirm: false
    params: {{images_of: [capture], calibration: calibration, hand_eye: calibration, scan: scan, poses: [robot]}}
    gates: [{{measure: robot_markers, min: 8}}]
  - id: evaluation
    kind: evaluation
    title: Evaluate
    confirm: false
    params: {{registration: registration, images_of: [capture], scan: scan}}
    gates: [{{measure: best_mean_radial_error_mm, max: 1}}]
    sign: true
"""


@dataclass(frozen=True, slots=True)
class Place:
    """One run's folder: data, the processes' journals, the arm's motions, and the output."""

    folder: Path
    files: Path  # created by prepare_files
    remember: bool = True  # whether to cache the answers of jobs, see bench.torture.crash.remembered

    @property
    def data(self) -> Path:
        """The data folder."""
        return self.folder / "data"

    @property
    def rig(self) -> Path:
        """The rig file."""
        return self.files / "rig.yaml"

    @property
    def signature_copy(self) -> Path:
        """The second copy of the signature log."""
        return self.folder / "elsewhere.jsonl"

    def second_place(self, store: Store) -> SecondPlace:
        """Return where that copy is kept."""
        return SecondPlace.of(self.data, self.signature_copy, store.clock, store.files)

    @property
    def motions(self) -> Path:
        """The log of the arm's motions."""
        return self.folder / "motions.txt"

    @property
    def said(self) -> Path:
        """Standard output and error of every process."""
        return self.folder / "processes.log"

    def journal(self, role: Role) -> Path:
        """The journal of a process's file operations."""
        return self.folder / f"{role}.jsonl"


def prepare(folder: Path) -> Place:
    """Make a run that has only been calibrated, without a signature; copies of it are killed."""
    place = Place(folder / "seed", folder / "files")
    for made in (place.folder, place.files):
        made.mkdir(parents=True)
    prepare_files(place.files)
    place.rig.write_text("name: torture\nsimulated: true\ndevices: {}\n")
    with Store.open(place.data) as store:
        _begin(store, place, 0, "Ada")
        run_id = store.find_run("latest")
        protocol, _ = recorded_run(store, run_id)
        result = {
            "camera": CAMERA.record(),
            "T_flange_camera": CrashRig().nominal_T_flange_camera().tolist(),
            "robots": ["robot"],
            "details": {},
        }
        step = protocol.step("calibration")
        store.record(run_id, [StepStarted(step=step.id, attempt=1)], actor="runner")
        measured = StepMeasured(step=step.id, attempt=1, measures={}, artefacts=(), result=result)
        store.record(run_id, [measured, evaluate_gates(step, 1, {})], actor="runner")
    return place


def start(role: Role, place: Place, *, die_at: Point | None = None, person: str = "Ada") -> int:
    """Fork a process of the run from this one, which has imported everything; returns its pid.

    It exits with status 0 when its work is done, with 3 after an exception, and dies of SIGKILL at `die_at`.
    """
    parent = os.getpid()
    child = os.fork()
    if child:
        return child
    status = 3
    try:
        said = os.open(place.said, os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        os.dup2(said, 1)
        os.dup2(said, 2)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        # Helper processes would import everything again, a thousand times: compute the jobs in this process.
        os.cpu_count = lambda: 1
        np.seterr(all="ignore")
        runner_loop.software_versions = _SOFTWARE.copy  # also read the installed packages only once
        files = MortalFiles(place.data, place.journal(role), die_at)
        with Store.open(place.data, _HastyClock(parent), files=files) as store:
            _ROLES[role](store, place, parent, person)
        status = 0
    except BaseException:  # noqa: BLE001 - the sweep reads it in the log, and that the status is not 0
        traceback.print_exc()
    finally:
        os._exit(status)


@dataclass(frozen=True)
class _HastyClock(SystemClock):
    """The host's clocks, of a process that waits for hundredths of a second only, and ends with the sweep."""

    parent: int

    def sleep(self, seconds: float) -> None:
        if os.getppid() != self.parent:
            raise SystemExit("the sweep has ended")
        time.sleep(min(seconds, 0.01))


def _begin(store: Store, place: Place, _parent: int, person: str) -> None:
    """Begin the run, as `orthocapture run` does first."""
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="torture.yaml")
    start_run(store, loaded, load_rig(place.rig), operator=person, auto_confirm=False)


def _run(store: Store, place: Place, _parent: int, person: str) -> None:
    """Run, as `drive` of service.cli.run does."""
    run_id = store.find_run("latest")
    protocol, _ = recorded_run(store, run_id)
    rig = CrashRig(folder=place.files, motions=place.motions)

    rig.keep_time(store.clock)
    operator = ScriptedOperator(name=person)
    runner_loop.Runner(store, run_id, protocol, rig, operator, second_place=place.second_place(store)).run()


def _work(store: Store, place: Place, parent: int, _person: str) -> None:
    """Work until killed by the sweep. It claims only when a job exists, so that its points are reproducible."""

    def stop() -> bool:
        while os.getppid() == parent:
            if store.open_jobs():
                return False
            time.sleep(0.005)
        return True

    if place.remember:
        loop.HANDLERS = remembering(loop.HANDLERS, place.files / "answers")
    loop.work(store, until_idle=False, stop=stop, progress=lambda _what, _done, _total: None)


def _release(store: Store, place: Place, _parent: int, person: str) -> None:
    """Release the completed run as a second person, as service.web.audit_exports.release does."""
    run_id = store.find_run("latest")
    protocol, _ = recorded_run(store, run_id)
    state = fold(protocol, store.events(run_id))
    if not state.released_by:
        refusal = refuse_release(state, person, state.completed_sha256)
        if refusal is not None:
            raise refusal
        store.record(run_id, [RunReleased(meaning="released", signed_sha256=state.completed_sha256)], actor=person)
    checkpoint(store, run_id)
    place.second_place(store).update()


_ROLES: dict[Role, Callable[[Store, Place, int, str], None]] = {
    "begin": _begin,
    "runner": _run,
    "worker": _work,
    "web": _release,
}
