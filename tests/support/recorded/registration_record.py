"""A registration as a job `register` answers it, for runs that compute none."""

from __future__ import annotations

from typing import Any

import numpy as np

CAMERA = {
    "width": 1280, "height": 853, "fx": 1000.0, "fy": 1000.0, "cx": 640.0, "cy": 426.0,
    "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
}  # fmt: skip

SPHERES: dict[str, Any] = {
    "spheres_m": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]],
    "sphere_covariance_m2": [(1e-10 * np.eye(3)).tolist()] * 4,
    "radius_m": 0.015,
}  # as the arguments of a registration's jobs have them


def registration_record(poses: str, **more: Any) -> dict[str, Any]:
    """One with the identity for every transform; `more` replaces or adds fields."""
    record: dict[str, Any] = {
        "poses": poses,
        "camera": CAMERA,
        "outlines": "0" * 64,
        "full_camera": None,
        "T_world_scan": np.eye(4).tolist(),
        "scale": 1.0,
        "rms_px": 0.1,
        "T_world_station": {},
        "T_scan_camera": {},
        "excluded": [],
        "covariance": (1e-9 * np.eye(6)).tolist(),
        "components": {},
        "leave_one_out": None,
    }
    return record | more
