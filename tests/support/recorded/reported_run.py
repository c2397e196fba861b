"""A run with everything that a report must state: a certificate, a failed gate, a redo, a correction, a result."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from service.core.arms import arm_model, flange_pose
from service.core.gates import evaluate_gates
from service.core.protocol import Protocol, parse_protocol
from service.core.records.base import ArtefactRef
from service.core.records.events import Payload
from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    OperatorAction,
    RecordCorrected,
    RunCompleted,
    StepMeasured,
    StepPassed,
    StepStarted,
    Uncertainty,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.records import NewArtefact
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from tests.support.record.core import EYE
from tests.support.recorded.registration_record import registration_record

PROTOCOL = """\
id: reported
version: "3"
title: A run with deviations
spheres: {radius_mm: 15, registration: 10, control: 3}
board: {columns: 4, rows: 5, square_mm: 15}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: calibration
    kind: calibration
    title: Calibrate the camera
    confirm: false
    params: {solve: [intrinsics, hand_eye]}
    gates: [{measure: rms_px, max: 0.5, unit: px}]
  - id: capture
    kind: viewpoint_capture
    title: Capture the specimen
    confirm: false
    params: {purpose: dataset, viewpoints: []}
    gates:
      - {measure: viewpoints_captured, min: 2, unit: views}
      - {measure: optics_departures, max: 0, unit: images}
  - id: evaluation
    kind: evaluation
    title: Evaluate
    confirm: false
    params: {registration: capture, images_of: [capture], scan: capture}
    gates: [{measure: best_mean_radial_error_mm, max: 0.35, unit: mm}]
    sign: true
"""


_JOINTS_RAD = (0.0,) * 6
_STRETCHED = tuple(map(tuple, flange_pose(arm_model("UR10e"), np.array(_JOINTS_RAD)).tolist()))
_ERROR = "best_mean_radial_error_mm"
T_SCAN_CAMERA = [[0.0, -1.0, 0.0, 0.25], [1.0, 0.0, 0.0, -0.125], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
REGISTRATION = """\
  - id: scan
    kind: scan_import
    title: Scan the spheres
    confirm: false
    params: {spheres: 10}
  - id: registration
    kind: registration
    title: Register
    confirm: false
    params: {images_of: [capture], calibration: calibration, hand_eye: calibration, scan: scan}
  - id: evaluation
"""


def record_reported_run(
    folder: Path,
    *,
    error_mm: float = 0.213,
    person: str = "Ada Λ. Müller",
    release: str = "none",
    registered: bool = False,
    acceptable: bool = False,
    accepted_by: str = "",
    error_bounds_mm: tuple[float, float] | None = None,
    serials: tuple[str, str] = ("", ""),
    photographs: int = 2,
) -> str:
    """Record the run in folder/data; returns its id.

    `acceptable`: a figure outside its limit may be accepted; `accepted_by`: who accepts it. `error_bounds_mm`: the
    uncertainty stated by the evaluation and the calibration. `serials`: of the camera, by its connection and in its
    photographs. `photographs`: number in the last attempt; more than two are as large and detailed as real ones after
    reduction, with a mesh and overlays to match.
    """
    text = PROTOCOL.replace("steps:", f"release: {release}\nsteps:", 1)
    if registered:
        text = text.replace("  - id: evaluation\n", REGISTRATION)
    if acceptable or accepted_by:
        text = text.replace("max: 0.35, unit: mm", "max: 0.35, unit: mm, accept_by: another_supervisor")
    (folder / "rig.yaml").write_text("name: small\nsimulated: true\ndevices: {}\n")
    loaded = parse_protocol(text.encode(), params_models(), name="reported.yaml")
    with Store.open(folder / "data") as store:
        run_id = start_run(store, loaded, load_rig(folder / "rig.yaml"), operator=person, auto_confirm=False)
        run = _Writer(store, run_id, loaded.protocol, person, serials[1], large=photographs > 2)
        run.calibrate(bounded=error_bounds_mm is not None)
        run.capture_twice(photographs)
        if serials[0]:
            run.open_camera(serials[0])
        if registered:
            run.register()
        judged, passed = run.evaluate(error_mm, error_bounds_mm, overlays=6 if photographs > 2 else 0)
        if accepted_by:
            run.accept("evaluation", judged, accepted_by)
        if accepted_by or passed:  # otherwise nobody can sign, and the run waits
            run.act("sign", step="evaluation", meaning="reviewed and accepted", signed_sha256=judged)
            run.add(StepPassed(step="evaluation", attempt=1), RunCompleted(deviations=3))
        checkpoint(store, run_id)
    return run_id


class _Writer:
    def __init__(
        self, store: Store, run_id: str, protocol: Protocol, person: str, body_serial: str, *, large: bool
    ) -> None:
        self._large, self._random = large, np.random.default_rng(5)
        self._stated = {"body_serial": body_serial} if body_serial else {}
        self._store, self._run_id, self._protocol, self._person = store, run_id, protocol, person

    def add(self, *payloads: Payload, actor: str = "runner", artefacts: tuple[NewArtefact, ...] = ()) -> str:
        """Append events; returns the hash of the last one."""
        return self._store.record(self._run_id, payloads, actor=actor, artefacts=artefacts)[-1].sha256

    def act(self, verb: str, **fields: Any) -> None:
        self.add(OperatorAction.model_validate({"action": verb, **fields}), actor=self._person)

    def accept(self, step: str, judged: str, by: str) -> None:
        action = OperatorAction(
            action="accept",
            step=step,
            reason="the pilot does not need it",
            signed_sha256=judged,
            role="supervisor",
            identified="password",
        )
        self.add(action, actor=by)

    def put(self, data: bytes, kind: str, media_type: str, name: str) -> ArtefactRef:
        return self._store.put_bytes(data, kind=kind, media_type=media_type, original_name=name)

    def photograph(self, name: str, kind: str, attempt: int = 1) -> ArtefactRef:
        """A photograph in one grey that shows its name; a large one is as detailed as anatomy."""
        if self._large:
            noise = self._random.normal(0, 70, (800, 1200, 3)).astype(np.float32)
            pixels = np.clip(110 + cv2.GaussianBlur(noise, (0, 0), 1.5) * 3, 0, 255).astype(np.uint8)
        else:
            pixels = np.full((80, 120, 3), 40 * attempt + len(name.removesuffix(".JPG")), np.uint8)
        text = f"{name.removesuffix('.JPG')} {attempt}"
        cv2.putText(pixels, text, (4, 40), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255))
        return self.put(cv2.imencode(".jpg", pixels)[1].tobytes(), kind, "image/jpeg", name)

    def calibrate(self, *, bounded: bool) -> None:
        """Open the robot, and record its calibration; `bounded`: with the uncertainty of its residual."""
        identity = {
            "kind": "robot",
            "model": "UR10e",
            "serial": "20231",
            "firmware": "5.12",
            "driver": "ur",
            "driver_version": "1",
        }
        self.add(DeviceOpened(device="robot", report={"identity": identity, "clock_offset_s": 1.25}))
        data = json.dumps(calibration()).encode()
        ref = self.put(data, "calibration", "application/json", "calibration.json")
        self.add(StepStarted(step="calibration", attempt=1))
        known = {"rms_px": Uncertainty(sigma=0.003, lower=0.023, upper=0.037)} if bounded else {}
        self.measure("calibration", 1, {"rms_px": 0.03}, calibration(), (ref,), known)
        self.add(StepPassed(step="calibration", attempt=1))

    def capture_twice(self, photographs: int) -> None:
        """A capture in which a viewpoint fails, and its repetition with this number of photographs."""
        self.add(StepStarted(step="capture", attempt=1))
        self.capture(1, "v001")
        self.add(DeviceTrouble(device="camera", error="TransportError", message="the camera does not answer"))
        self.add(
            ViewpointFailed(
                step="capture",
                attempt=1,
                viewpoint="v002",
                error="CameraError",
                message="no file arrived",
                skipped=True,
            )
        )
        self.measure("capture", 1, {"viewpoints_captured": 1.0, "optics_departures": 0.0}, {})
        self.act("redo", step="capture", reason="the cable was loose")
        self.add(StepStarted(step="capture", attempt=2))
        for viewpoint in (f"v{number:03d}" for number in range(1, photographs + 1)):
            self.capture(2, viewpoint)
        self.measure("capture", 2, {"viewpoints_captured": 2.0, "optics_departures": 0.0}, {})
        correction = RecordCorrected(
            of_seq=8, field="environment.light_lux", old=0.0, new=800.0, reason="the meter was covered"
        )
        self.add(correction, actor=self._person)
        self.add(StepPassed(step="capture", attempt=2))

    def open_camera(self, serial: str) -> None:
        camera = {"kind": "camera", "model": "ILCE-7RM5", "serial": serial, "firmware": "3.00"}
        self.add(
            DeviceOpened(device="camera", report={"identity": camera, "clock": "utc", "clock_offset_s": -1279.0})
        )

    def evaluate(self, error_mm: float, bounds_mm: tuple[float, float] | None, *, overlays: int) -> tuple[str, bool]:
        """Record the evaluation; returns the hash of its judgement, and whether the gate has passed."""
        self.add(StepStarted(step="evaluation", attempt=1))
        known: dict[str, Uncertainty] = {}
        if bounds_mm is not None:
            lower, upper = bounds_mm
            known = {_ERROR: Uncertainty(sigma=(upper - lower) / 4.65, lower=lower, upper=upper)}
        pictures = tuple(self.photograph(f"overlay_{k}.jpg", "overlay") for k in range(overlays))
        judged = self.measure("evaluation", 1, {_ERROR: error_mm}, evaluation(error_mm), pictures, known)
        largest_mm = error_mm if bounds_mm is None else max(error_mm, bounds_mm[1])
        return judged, largest_mm <= 0.35

    def capture(self, attempt: int, viewpoint: str) -> None:
        ref = self.photograph(f"{viewpoint}.JPG", "image", attempt)
        payload = ViewpointCaptured(
            step="capture",
            attempt=attempt,
            viewpoint=viewpoint,
            station="station_1",
            artefacts=(ref,),
            T_base_flange=_STRETCHED,
            pose_sigma_m=2e-6,
            pose_sigma_rad=1e-6,
            joints_rad=_JOINTS_RAD,
            pose_samples=10,
            trigger_monotonic_s=1.0,
            arrival_monotonic_s=2.0,
            controller_time_s=3.0,
            clock_offset_s=1.25 + 0.001 * attempt,
            camera={"lens": "FE 50mm", "aperture_f": 22, "focus_mode": "Manual", **self._stated},
            environment={"light_lux": 800.0, "temperature_c": 21.5},
            verdicts={"still": True},
        )
        self.add(payload, artefacts=(NewArtefact(ref, "camera", "capture", attempt, viewpoint),))

    def register(self) -> None:
        """Record the scan of a tetrahedron, and the camera poses in its frame."""
        buffer = io.BytesIO()
        vertices_m = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        body = trimesh.creation.icosphere(subdivisions=6, radius=0.05) if self._large else None
        mesh_m, triangles = (vertices_m, faces) if body is None else (body.vertices, body.faces)
        np.savez(buffer, vertices_m=mesh_m, faces=triangles)
        mesh = self.put(buffer.getvalue(), "scan_mesh", "application/x-npz", "scan.npz")
        self.add(StepStarted(step="scan", attempt=1))
        self.measure("scan", 1, {}, {"spheres_m": vertices_m.tolist()}, (mesh,))
        self.add(StepPassed(step="scan", attempt=1), StepStarted(step="registration", attempt=1))
        cameras = {"v001": [list(row) for row in EYE], "v002": T_SCAN_CAMERA}
        result = registration_record("colmap", T_scan_camera=cameras)
        self.measure("registration", 1, {}, {"registrations": {"colmap": result}})
        self.add(StepPassed(step="registration", attempt=1))

    def measure(
        self,
        step: str,
        attempt: int,
        measures: dict[str, float],
        result: dict[str, Any],
        artefacts: tuple[ArtefactRef, ...] = (),
        known: Mapping[str, Uncertainty] | None = None,
    ) -> str:
        """Append StepMeasured and its gates; returns the hash of the latter."""
        measured = StepMeasured(
            step=step,
            attempt=attempt,
            measures=measures,
            artefacts=artefacts,
            result=result,
            uncertainties=dict(known or {}),
        )
        rows = tuple(NewArtefact(ref, "worker", step, attempt) for ref in artefacts)
        self.add(measured, artefacts=rows)
        return self.add(evaluate_gates(self._protocol.step(step), attempt, measures, (), known))


def calibration() -> dict[str, Any]:
    """The result of a calibration step, as written by intrinsics_record and hand_eye_record."""
    counts = [[5 * row + column for column in range(12)] for row in range(8)]
    intrinsics = {
        "coverage": {"share": 0.95, "corners": counts},
        "residuals": {"corners": counts, "mean_px": [[[0.01, -0.02]] * 12] * 8},
        "uncertainty": {
            "distance_m": 0.7, "centre_px": 0.01, "worst_px": 0.05, "centre_mm": 0.004, "worst_mm": 0.02,
            "sigma_px": [[0.01 + 0.0025 * row for _ in range(24)] for row in range(16)],
            "sigma_mm": [[0.004 + 0.001 * row for _ in range(24)] for row in range(16)],
        },
        "cross_validation": {"folds": 5, "five_fold_rms_px": 0.03},
        "rms_px": 0.028,
        "sigma": {"fx": 0.06, "fy": 0.06, "cx": 0.08, "cy": 0.06},
        "excluded": [{"image": "b010", "reason": "no board"}],
        "warnings": ["13 views; 60 or more average the errors"],
    }  # fmt: skip
    held_out_mm = {"b001": 0.03, "b002": 0.05, "b003": 0.04}
    return {
        "camera": {"fx": 2033.77, "fy": 2034.06, "cx": 714.3, "cy": 484.2, "width": 1440, "height": 960},
        "T_flange_camera": [list(row) for row in EYE],
        "hand_eye": {
            "T_flange_camera": [list(row) for row in EYE],
            "method": "weighted",
            "residuals": {"held_out_mm": held_out_mm, "held_out_deg": dict.fromkeys(held_out_mm, 0.002)},
            "sigma": {
                "mm": 0.033,
                "deg": 0.002,
                "covariance": [[1e-10 * (i == j) for j in range(6)] for i in range(6)],
            },
            "arm_correction": None,
        },
        "details": {"intrinsics": intrinsics},
    }


def evaluation(error_mm: float) -> dict[str, Any]:
    """The result of an evaluation step with one source of poses."""
    row = {
        "poses": "colmap", "source": "colmap", "resolution": "1920 × 1280", "images": 6, "predicted_error_mm": 0.04,
        "control_error_mm": 0.05, "control_normalised_chi2": 1.1, "mean_radial_error_mm": error_mm,
        "mean_reprojection_error_px": 2.25, "evaluated_on": "control spheres", "control_outlines": 18,
    }  # fmt: skip
    contributions = [
        {"name": "poses", "sigma_mm": 0.03, "how": "covariance of the camera poses", "counted": True},
        {"name": "ct", "sigma_mm": 0.02, "how": "counts only where the CT is used", "counted": False},
    ]
    observed = {
        "name": "camera ↔ scan", "how": "10 sphere centres", "n": 10, "normalised_chi2": 0.9, "observed_mm": 0.01,
        "predicted_mm": 0.011, "verdict": "as predicted",
    }  # fmt: skip
    budget = {"contributions": contributions, "observations": [observed], "total_mm": 0.061}
    return {"table": [row], "budgets": {"colmap": budget}}
