"""What only tests and the demonstration read: the truth of a simulated rig."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from simulators.scene.further_cameras import FurtherCamera
from simulators.scene.world import Scene


def truth_of(scene: Scene, further: Mapping[str, FurtherCamera], image_width: int) -> dict[str, Any]:
    """The truth as JSON data, before any scan or series was delivered."""
    return {
        "scene": scene.seed,
        "T_flange_camera": scene.T_flange_camera.tolist(),
        "T_world_base": {name: T.tolist() for name, T in scene.T_world_base.items()},
        "arm": {"model": scene.arm.name, **scene.arm.truth()},
        **_second_arm(scene),
        "control_m": scene.control_m.tolist(),
        "radius_m": scene.radius_m,
        "intrinsics": scene.camera_intrinsics(image_width).to_json(),
        "scans": [],
        "ct": [],
        "further_cameras": {
            name: {"T_outer_camera": one.T_outer_camera.tolist(), "clock_ahead_s": one.clock_ahead_s}
            for name, one in further.items()
        },
    }


def _second_arm(scene: Scene) -> dict[str, Any]:
    if (second := scene.second) is None:
        return {}
    return {"second_arm": {"T_flange_camera": second.T_flange_camera.tolist(), **second.arm.truth()}}
