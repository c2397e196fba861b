"""A small run with results computed by a real worker: two scans of spheres, a registration on exact outlines."""

from __future__ import annotations

import io
import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from service.core.gates import evaluate_gates
from service.core.jobs import Reference
from service.core.protocol import parse_protocol
from service.core.records.base import ArtefactRef
from service.core.records.run_events import (
    FilesKept,
    OperatorAction,
    RunCompleted,
    SessionStarted,
    StepMeasured,
    StepPassed,
    StepStarted,
)
from service.rig import load_rig
from service.run_start import start_run
from service.runner.held_run import software_versions
from service.steps import params_models
from service.store.records import NewArtefact, NewJob
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from tests.support.record.outsider import copy_data
from tests.support.record.store import enqueue
from tests.support.runs.computing_run import compute_jobs
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, exact_outlines, scene
from tests.support.scenes.sphere_meshes import MeshBuilder, cap

PROTOCOL = """\
id: recorded
version: "2"
title: Two scans and a registration
spheres: {radius_mm: 15, registration: 10}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: first_scan
    kind: scan_import
    title: Scan the spheres
    confirm: false
    params: {spheres: 10}
    gates: [{measure: spheres_found, min: 10, max: 10, unit: spheres}]
    sign: true
  - id: second_scan
    kind: scan_import
    title: Scan them again
    confirm: false
    params: {spheres: 10, compare_with: first_scan}
    gates:
      - {measure: sphere_change_max_mm, max: 0.3, unit: mm, why: nothing may have moved}
  - id: registration
    kind: registration
    title: Register
    confirm: false
    params: {images_of: [first_scan], calibration: first_scan, hand_eye: first_scan, scan: second_scan}
    gates:
      - {measure: colmap_rms_px, max: 1.0, unit: px}
"""
# A step to follow those of PROTOCOL.
FUSION = """\
  - id: ground_truth
    kind: ground_truth
    title: Fuse
    params: {ct: first_scan, scan: second_scan}
"""


def record_run(folder: Path, *, complete: bool = True, version: int = 1, protocol: str = PROTOCOL) -> str:
    """Record a run in folder/data, from its first event to its last; returns its id.

    With version 1 its jobs hold copies of earlier results, with version 2 references to them. A protocol may have
    steps after those of PROTOCOL, which are not done. Each such run is computed once in a process, which takes a
    second; where there is no data yet, a copy of it is put there.
    """
    if (folder / "data").exists():
        return _record(folder, complete=complete, version=version, protocol=protocol)
    recorded, run_id = _recorded(complete=complete, version=version, protocol=protocol)
    copy_data(Path(recorded.name), folder)
    return run_id


@cache
def _recorded(*, complete: bool, version: int, protocol: str) -> tuple[TemporaryDirectory[str], str]:
    """A folder with such a run, which goes with this process."""
    folder = TemporaryDirectory(prefix="recorded-run-")
    return folder, _record(Path(folder.name), complete=complete, version=version, protocol=protocol)


def _record(folder: Path, *, complete: bool, version: int, protocol: str) -> str:
    (folder / "rig.yaml").write_text("name: small\nsimulated: true\ndevices: {}\n")
    loaded = parse_protocol(protocol.encode(), params_models(), name="recorded.yaml")
    with Store.open(folder / "data") as store:
        run_id = start_run(store, loaded, load_rig(folder / "rig.yaml"), operator="Ada", auto_confirm=False)
        software = software_versions() | {"numpy": "1.0.0-recorded"}
        session = SessionStarted(resumed=False, software=software, host="here", pid=1)
        store.record(run_id, [session], actor="runner")
        run = _Recorder(store, run_id, loaded.protocol, version)
        first = run.scan("first_scan", seed=1)
        run.store.record(run_id, [OperatorAction(action="redo", step="first_scan", reason="a hole")], actor="Ada")
        first = run.scan("first_scan", seed=1, attempt=2)
        second = run.scan(
            "second_scan",
            seed=2,
            reference_m=run.taken("spheres_m", first["spheres_m"]),
            reference_covariances_m2=run.taken(*_covariances(first)),
        )
        run.register(second)
        if complete:
            store.record(run_id, [RunCompleted(deviations=1)], actor="runner")
        checkpoint(store, run_id)
    return run_id


class _Recorder:
    def __init__(self, store: Store, run_id: str, protocol: Any, version: int) -> None:
        self.store, self.run_id, self.protocol, self.version = store, run_id, protocol, version
        self.last_job = ""

    def taken(self, field: str, value: Any) -> Any:
        """A part of the last job's answer, as it stands in the arguments of the next one."""
        return value if self.version == 1 else Reference(self.last_job, f"result/{field}").record()

    def scan(self, step: str, *, seed: int, attempt: int = 1, **more: Any) -> dict[str, Any]:
        """Record a whole scan_import step; returns the job's result."""
        self._begin(step, attempt)
        mesh = self.put(_mesh(seed), "scan_mesh", "application/x-npz", "scan.npz")
        kept = FilesKept(step=step, attempt=attempt, device="scanner", note="scan", artefacts=(mesh,))
        row = NewArtefact(mesh, "scanner", step, attempt)
        self.store.record(self.run_id, [kept], actor="runner", artefacts=[row])
        arguments = {"mesh": mesh.sha256, "radius_m": RADIUS_M, "expected": 10, **more}
        measures, result, _ = self._compute(step, attempt, "locate_spheres", arguments)
        self._end(step, attempt, measures, (mesh,), result, sign=step == "first_scan" and attempt == 2)
        return result

    def register(self, scan: dict[str, Any]) -> None:
        """Record a registration step on structure from motion, with outlines as from a detector."""
        step = "registration"
        self._begin(step, 1)
        made = scene(6, width=1200, seed=5)
        # Imported here, because records of outlines need the worker's numerics.
        from service.compute.markers.records import outline_record  # noqa: PLC0415

        outlines = [exact_outlines(made, i, REGISTRATION_M, noise_px=0.05, seed=5)[0] for i in range(6)]
        found = {f"v{i}": [outline_record(o) for o in mine] for i, mine in enumerate(outlines)}
        poses = {f"v{i}": T.tolist() for i, T in enumerate(made.T_world_camera)}
        refs = [
            self.put(json.dumps(data).encode(), kind, "application/json", f"{kind}.json")
            for kind, data in (("outlines", found), ("sfm_model", {"T_world_camera": poses}))
        ]
        kept = FilesKept(step=step, attempt=1, device="worker", note="made", artefacts=tuple(refs))
        rows = [NewArtefact(ref, "worker", step, 1) for ref in refs]
        self.store.record(self.run_id, [kept], actor="runner", artefacts=rows)
        images = [{"viewpoint": f"v{i}", "station": "station_1", "sha256": refs[0].sha256} for i in range(6)]
        arguments = {
            "images": images,
            "camera": made.camera.record(),
            "outlines": refs[0].sha256,
            "model": refs[1].sha256,
            "poses": "colmap",
            "spheres_m": self.taken("spheres_m", scan["spheres_m"]),
            "sphere_covariance_m2": self.taken(*_covariances(scan)),
            "radius_m": RADIUS_M,
        }
        measures, result, artefacts = self._compute(step, 1, "register", arguments)
        named = {f"colmap_{name}": value for name, value in measures.items()}
        whole = {"outlines_sha256": refs[0].sha256, "registrations": {"colmap": result}}
        self._end(step, 1, named, artefacts, whole)

    def put(self, data: bytes, kind: str, media_type: str, name: str) -> ArtefactRef:
        return self.store.put_bytes(data, kind=kind, media_type=media_type, original_name=name)

    def _begin(self, step: str, attempt: int) -> None:
        self.store.record(self.run_id, [StepStarted(step=step, attempt=attempt)], actor="runner")

    def _compute(
        self, step: str, attempt: int, kind: str, arguments: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Any], tuple[ArtefactRef, ...]]:
        job = NewJob(kind, step, attempt, f"{step}/{attempt}/{kind}", arguments, version=self.version)
        enqueue(self.store, self.run_id, job, actor="runner")
        assert compute_jobs(self.store) == 1
        end: Any = self.store.events(self.run_id)[-1].payload
        assert end.kind == "job_finished", end
        self.last_job = end.job
        return end.measures, end.result, end.artefacts

    def _end(
        self,
        step: str,
        attempt: int,
        measures: dict[str, float],
        artefacts: tuple[ArtefactRef, ...],
        result: dict[str, Any],
        *,
        sign: bool = False,
    ) -> None:
        measured = StepMeasured(step=step, attempt=attempt, measures=measures, artefacts=artefacts, result=result)
        gates = evaluate_gates(self.protocol.step(step), attempt, measures)
        assert gates.passed, gates
        *_, judged = self.store.record(self.run_id, [measured, gates], actor="runner")
        if sign:
            action = OperatorAction(action="sign", step=step, meaning="reviewed", signed_sha256=judged.sha256)
            self.store.record(self.run_id, [action], actor="Ada")
        if sign or not self.protocol.step(step).sign:
            self.store.record(self.run_id, [StepPassed(step=step, attempt=attempt)], actor="runner")


def _covariances(scan: dict[str, Any]) -> tuple[str, Any]:
    """Where the covariances stand in a scan's result, and what they are."""
    return "details/spheres/*/covariance_m2", [s["covariance_m2"] for s in scan["details"]["spheres"]]


def _mesh(seed: int) -> bytes:
    """The scanner's mesh of the registration spheres, as stored."""
    rng = np.random.default_rng(seed)
    built = MeshBuilder()
    for centre in REGISTRATION_M:
        built.add(*cap(centre, 1.3, rng, level=4, white_m=2e-5))
    vertices, faces = built.build()
    buffer = io.BytesIO()
    np.savez(buffer, vertices_m=vertices, faces=faces)
    return buffer.getvalue()
