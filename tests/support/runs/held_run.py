"""A run on the in-memory rig in which a simulated person takes the images by hand; what they show is made up."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from drivers.interfaces import CameraSettings
from service.compute.hand_held import HandView
from service.compute.planning.coverage import ViewInformation
from service.core.errors import ComputeError
from service.core.geometry import Array
from simulators.hand.technician import Grip, follow
from tests.support.rig.bench_rig import BenchRig, ScriptedOperator
from tests.support.runs.bench_run import PROTOCOL, Bench
from tests.support.runs.computing_run import compute_jobs
from tests.support.runs.measuring_rig import MEASURED, SPHERES_M, BenchCt, MeasuringRig
from tests.support.scenes.sphere_images import camera

STEP = """\
  - id: capture
    kind: manual_capture
    title: Capture
    params:
      purpose: dataset
      min_images: 6
      calibration: camera
      spheres_of: [ct]
      hemisphere:
        - {tilt_deg: 10, count: 2, distance_m: 0.66}
        - {tilt_deg: 30, count: 5, distance_m: 0.66}
      wait_s: 600
    gates:
      - {measure: images_used, min: 6}
      - {measure: hemisphere_coverage, min: 0.9}
      - {measure: predicted_target_error_mm, max: 0.5, unit: mm}
    recovery: {retries: 0, wait_s: 0}
"""
MIDDLE_M = SPHERES_M.mean(axis=0)


@dataclass
class Person:
    """Follows the guidance and presses the camera's button; `mishaps` by number of the press."""

    rig: BenchRig
    mishaps: dict[int, str] = field(default_factory=dict[int, str])
    grip: Grip = field(default_factory=lambda: Grip(MIDDLE_M + np.array([0.1, 0.0, 0.8])))
    views: list[tuple[Array, str]] = field(default_factory=list[tuple[Array, str]])
    presses: int = 0
    idle: bool = False

    def read(self, message: str) -> None:
        """React to the words on the screen."""
        if not message.startswith("next: ") or self.idle:
            return
        self.presses += 1
        mishap = self.mishaps.get(self.presses, "")
        if mishap != "stays":
            self.grip = follow(message, self.grip, MIDDLE_M)
        self.views.append((self.grip.T_world_camera(), mishap))
        self.rig.shutter.pressed.append(CameraSettings(22.0, 1 / 50, 400) if mishap == "dial" else None)


P = TypeVar("P", bound=Person)


@dataclass
class ReadingOperator(ScriptedOperator):
    """Passes what it is told to a person."""

    person: Person | None = None

    def tell(self, message: str) -> None:
        super().tell(message)
        if self.person is not None:
            self.person.read(message)


def held_run(
    begin: Callable[[str], Bench],
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    mishaps: dict[int, str],
    step: str,
    person_of: Callable[[BenchRig, dict[int, str]], P] = Person,
) -> tuple[Bench, P]:
    """A hand-held run; what the images show follows from where the person held the camera."""
    head = PROTOCOL.split("  - id: capture\n")[0]
    bench = begin(head + MEASURED + step)
    rig = MeasuringRig()
    rig.suite = BenchCt(folder)
    bench.rig = rig
    person = person_of(rig, mishaps)
    bench.operator = ReadingOperator(person=person)
    known: dict[str, Any] = {
        "calibrate": {"camera": asdict(camera(1200)), "T_flange_camera": np.eye(4).tolist(), "details": {}},
        "locate_spheres": {"spheres_m": SPHERES_M.tolist(), "details": {}},
    }

    looks = count()

    def look(*_args: Any, **_options: Any) -> HandView:
        T, mishap = person.views[next(looks)]  # images are evaluated one by one, in the order of arrival
        if mishap == "fails":
            raise ComputeError("the image cannot be decoded", remedy="Take it again")
        if mishap == "nothing":
            return HandView(None, None, 1, 0, 0, 2.0, 0.2, 0.0, "1 spheres found, which do not tell where it was")
        why = "blurred: outlines are 9.0 px wide; hold the camera still" if mishap == "blurred" else ""
        information = np.diag([4e8] * 3 + [4e6] * 3)
        return HandView(T, ViewInformation(information, np.zeros(6), 10), 10, 10, 10, 1.5, 0.1, 0.0, why)

    def serve(_what: str) -> None:
        job = bench.store.claim_job("test", 30, kinds=list(known))
        if job is not None:
            bench.store.finish_job(job, measures={}, duration_s=0.1, result=known[job.kind])
        compute_jobs(bench.store)

    monkeypatch.setattr("service.computations.hand_held.compute.look_at_image", look)
    bench.operator.on_show = serve
    return bench, person


class _LeftError(BaseException):
    """The runner's process ended in the middle."""


def left_held_run(
    begin: Callable[[str], Bench],
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    mishaps: dict[int, str] | None = None,
) -> Bench:
    """A hand-held run with four images, the second one blurred, that nobody drives any more."""
    bench, person = held_run(begin, monkeypatch, folder, mishaps or {2: "blurred"}, STEP)
    serve = bench.operator.on_show

    def until_four(what: str) -> None:
        serve(what)
        if person.presses == 5:
            raise _LeftError

    bench.operator.on_show = until_four
    with contextlib.suppress(_LeftError):
        bench.run()
    return bench
