"""Further cameras of the simulated laboratory: on a stand in the room, or beside the first one on its mount."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array, from_euler, look_at
from simulators.scene.intrinsics import Intrinsics
from simulators.scene.world import SCENE_CENTRE_M, Scene

PLACES = ("fixed", "stereo")
_STAND_M = np.array([0.44, -0.36, 0.84])  # a metre from the scene, between the stations
_BASELINE_M = 0.11
_TOE_IN_RAD = 0.15  # both look at the scene, 0.7 m away


@dataclass(frozen=True)
class FurtherCamera:
    """The true pose, lens and clock of a further camera.

    Attributes:
        place: one of PLACES.
        T_outer_camera: (4, 4) in the world if fixed, otherwise in the first camera's frame.
        lens: the lens at full resolution.
        clock_ahead_s: how far its clock is ahead of the first camera's.
    """

    place: str
    T_outer_camera: Array
    lens: Intrinsics
    clock_ahead_s: float

    @property
    def fixed(self) -> bool:
        """Return whether it stands in the room; otherwise it moves with the first camera."""
        return self.place == "fixed"

    @classmethod
    def put(cls, scene: Scene, place: str, number: int) -> FurtherCamera:
        """One further camera of this scene; seed and number decide how far it is from its nominal place."""
        rng = np.random.default_rng([scene.seed, 0x2CA3, *([number] if number else [])])
        turn, shift = np.radians(0.8) * rng.uniform(-1.0, 1.0, 3), 0.004 * rng.uniform(-1.0, 1.0, 3)
        if place == "fixed":
            nominal = look_at(_STAND_M, SCENE_CENTRE_M, np.array([0.0, 0.0, 1.0]))
        else:
            nominal = from_euler(np.array([0.0, -_TOE_IN_RAD, 0.0]), np.array([_BASELINE_M, 0.0, 0.0]))
        scale = float(rng.uniform(0.97, 1.03))
        lens = dataclasses.replace(
            scene.lens,
            fx=scene.lens.fx * scale,
            fy=scene.lens.fy * scale,
            cx=scene.lens.cx + float(rng.uniform(-30.0, 30.0)),
            cy=scene.lens.cy + float(rng.uniform(-30.0, 30.0)),
            k1=scene.lens.k1 + float(rng.uniform(-0.01, 0.01)),
        )
        return cls(place, nominal @ from_euler(turn, shift), lens, round(float(rng.uniform(0.4, 2.0)), 3))

    def pose(self, T_world_first: Array) -> Array:
        """T_world_camera (4, 4) while the first camera is at this pose."""
        return self.T_outer_camera if self.fixed else T_world_first @ self.T_outer_camera


def further_cameras(scene: Scene, places: Sequence[str]) -> dict[str, FurtherCamera]:
    """The further cameras at these places, named camera_2, camera_3 and so on."""
    return {f"camera_{k + 2}": FurtherCamera.put(scene, place, k) for k, place in enumerate(places)}
