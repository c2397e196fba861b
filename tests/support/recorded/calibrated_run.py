"""A run that has calibrated camera and hand-eye from noisy board corners, computed as the worker does."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

import cv2
import numpy as np

from service.computations.calibration.compute import calibrate_camera
from service.computations.conversion import hand_eye_record
from service.compute.calibration.board import BoardView
from service.compute.calibration.board_search import UsableViews
from service.compute.calibration.hand_eye import HandEyeViews, calibrate_hand_eye
from service.core.gates import evaluate_gates
from service.core.protocol import parse_protocol
from service.core.records.base import ArtefactRef
from service.core.records.run_events import (
    DeviceOpened,
    FurtherExposure,
    StepMeasured,
    StepPassed,
    StepStarted,
    Uncertainty,
    ViewpointCaptured,
)
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.records import NewArtefact
from service.store.signatures.signing import checkpoint
from tests.support.boards.board_sessions import BOARD, Session, noisy_session
from tests.support.pages.web import WebSite

RIG = """\
name: small
simulated: true
devices: {robot: {driver: ur, host: 127.0.0.1}}
stations:
  station_1: {robot: robot, scene_centre_m: [0.5, 0.1, 0.0], approach_azimuth_deg: 180}
T_flange_camera_nominal: [[1, 0, 0, 0], [0, 1, 0, -0.06], [0, 0, 1, 0.09], [0, 0, 0, 1]]
"""
PROTOCOL = f"""\
id: calibrated
version: "1"
title: A calibration and what comes after it
spheres: {{radius_mm: 15, registration: 10}}
board: {{columns: {BOARD.columns}, rows: {BOARD.rows}, square_mm: {1000 * BOARD.square_m:g}}}
camera: {{aperture_f: 22, exposure_s: 1/50, iso: 100}}
steps:
  - id: calibration
    kind: calibration
    title: Calibrate camera and hand-eye
    confirm: false
    params:
      solve: [intrinsics, hand_eye]
      viewpoints:
        - station: station_1
          prefix: b
          arcs: [{{tilt_deg: 20, azimuth_from_deg: -60, azimuth_to_deg: 60, count: 10, distance_m: 0.7}}]
    gates:
      - {{measure: rms_px, max: 0.5, unit: px}}
      - {{measure: hand_eye_held_out_mm, max: 5, unit: mm}}
  - id: capture
    kind: viewpoint_capture
    title: Capture
    confirm: false
    params:
      purpose: dataset
      viewpoints:
        - station: station_1
          prefix: v1_
          arcs: [{{tilt_deg: 20, azimuth_from_deg: -50, azimuth_to_deg: 50, count: 4, distance_m: 0.6}}]
"""
VIEWS = 10
_NAMES = [f"b{i:03d}" for i in range(VIEWS)]


def begin_calibrated_run(site: WebSite, known: Mapping[str, Uncertainty] | None = None, rig_text: str = RIG) -> str:
    """Begin a run that is calibrated and in its next step, with no image yet; returns its id.

    `known` has the uncertainties of the calibration's measures.
    """
    rig = site.folder / "small.yaml"
    rig.write_text(rig_text)
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="calibrated.yaml")
    store = site.store
    run_id = start_run(store, loaded, load_rig(rig), operator="grace", auto_confirm=False)
    identity = {"kind": "robot", "model": "Bench arm", "serial": "20231"}
    store.record(run_id, [DeviceOpened(device="robot", report={"identity": identity})], actor="runner")
    store.record(run_id, [StepStarted(step="calibration", attempt=1)], actor="runner")
    session, result, measures = _calibrated()
    for i, name in enumerate(_NAMES):
        capture(site, run_id, "calibration", name, session.T_base_flange[i].tolist(), kind="board_image", shade=i)
    ref = _put(site, json.dumps(result).encode(), "calibration", "application/json", "calibration.json")
    measured = StepMeasured(
        step="calibration",
        attempt=1,
        measures=measures,
        artefacts=(ref,),
        result=result,
        uncertainties=dict(known or {}),
    )
    store.record(run_id, [measured], actor="runner", artefacts=[NewArtefact(ref, "worker", "calibration", 1)])
    gates = evaluate_gates(loaded.protocol.step("calibration"), 1, measures, (), known)
    store.record(run_id, [gates, StepPassed(step="calibration", attempt=1)], actor="runner")
    checkpoint(store, run_id)
    store.record(run_id, [StepStarted(step="capture", attempt=1)], actor="runner")
    return run_id


@cache
def _calibrated() -> tuple[Session, dict[str, Any], dict[str, float]]:
    """The board views, and the step's result and measures."""
    session = noisy_session(VIEWS, 0.05, 0.01, 3)
    every = np.arange(len(session.corners.points_m))
    views = [BoardView(every, pixels) for pixels in session.corners.corners_px]
    camera = session.corners.camera
    usable = UsableViews((camera.width, camera.height), tuple(range(len(views))), tuple(views), {})
    calibrated = calibrate_camera(usable, BOARD)
    hands = calibrate_hand_eye(
        HandEyeViews(session.T_base_flange, session.T_camera_board, corners=session.corners), bootstrap=10
    )
    hand_eye = hand_eye_record(hands, _NAMES).plain()
    result: dict[str, Any] = {
        "camera": calibrated.result.camera.record(),
        "T_flange_camera": hand_eye["T_flange_camera"],
        "T_base_board": hand_eye["T_base_board"],
        "hand_eye": hand_eye,
        "robots": ["robot"],
        "details": {"intrinsics": calibrated.record(_NAMES).plain()},
    }
    measures = {"rms_px": calibrated.result.rms_px, "hand_eye_held_out_mm": float(np.median(hands.held_out_mm))}
    return session, result, measures


def capture(
    site: WebSite,
    run_id: str,
    step: str,
    viewpoint: str,
    T_base_flange: Any,
    *,
    kind: str = "image",
    shade: int = 0,
    name: str = "DSC00001.JPG",
    further: Mapping[str, bool] | None = None,
    attempt: int = 1,
) -> str:
    """Record one exposure; returns the photograph's hash.

    `further`: further cameras that expose as well, by name; whether with the settings that they should have.
    """
    pixels = np.full((600, 900, 3), 40 + 5 * shade, np.uint8)
    cv2.putText(pixels, viewpoint, (40, 300), cv2.FONT_HERSHEY_SIMPLEX, 4, (255, 255, 255), 8)
    ref = _put(site, cv2.imencode(".jpg", pixels)[1].tobytes(), kind, "image/jpeg", name)
    payload = ViewpointCaptured(
        step=step,
        attempt=attempt,
        viewpoint=viewpoint,
        station="station_1",
        artefacts=(ref,),
        T_base_flange=tuple(map(tuple, T_base_flange)),
        pose_sigma_m=2e-6,
        pose_sigma_rad=1e-6,
        joints_rad=(0.0,) * 6,
        pose_samples=10,
        trigger_monotonic_s=1.0,
        arrival_monotonic_s=2.0,
        controller_time_s=3.0,
        clock_offset_s=0.0,
        camera={"lens": "FE 50mm", "aperture_f": 22.0, "exposure_s": 0.02, "iso": 100, "width": 900, "height": 600,
                "focus_mode": "Manual", "focal_length_mm": 50.0, "focus_distance_m": 0.7, "lens_serial": "L-17",
                "body_serial": "B-4"},
        environment={"light_lux": 800.0, "temperature_c": 21.5},
        verdicts={"still": True, "settings": True},
    )  # fmt: skip
    rows = [NewArtefact(ref, "camera", step, 1, viewpoint)]
    for device, as_wanted in (further or {}).items():
        exposure, kept = _further(site, device, viewpoint, payload, as_wanted=as_wanted)
        payload = payload.model_copy(update={"further": (*payload.further, exposure)})
        rows += [NewArtefact(one, device, step, 1, viewpoint) for one in kept]
    site.store.record(run_id, [payload], actor="runner", artefacts=rows)
    return ref.sha256


def _further(
    site: WebSite, device: str, viewpoint: str, first: ViewpointCaptured, *, as_wanted: bool
) -> tuple[FurtherExposure, list[ArtefactRef]]:
    """What a further camera exposed, and its files."""
    pixels = np.full((400, 600, 3), 90, np.uint8)
    cv2.putText(pixels, f"{device} {viewpoint}", (20, 200), cv2.FONT_HERSHEY_SIMPLEX, 2, (255, 255, 255), 4)
    image = _put(site, cv2.imencode(".jpg", pixels)[1].tobytes(), "further_image", "image/jpeg", "IMG_0001.JPG")
    lens = b'{"width": 600, "height": 400, "fx": 800, "fy": 800, "cx": 300, "cy": 200}'
    calibration = _put(site, lens, "camera_calibration", "application/json", f"{device}.json")
    exposure = FurtherExposure(
        device=device,
        mounted="fixed",
        artefacts=(image,),
        calibration=calibration,
        camera={**first.camera, "lens": "RF 35mm", "iso": 100 if as_wanted else 400, "width": 600, "height": 400},
        trigger_monotonic_s=2.0,
        arrival_monotonic_s=3.0,
        verdicts={"settings": as_wanted},
    )
    return exposure, [image, calibration]


def _put(site: WebSite, data: bytes, kind: str, media_type: str, name: str) -> ArtefactRef:
    return site.store.put_bytes(data, kind=kind, media_type=media_type, original_name=name)
