"""Where the simulated machine holds the camera: X turns the specimen about the vertical, Y lifts the camera."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.geometry import Array, from_euler, look_at, transform
from simulators.scene.world import SCENE_CENTRE_M
from simulators.units import metres

# How the camera's mount differs from its drawing: roll, pitch, yaw and shift.
_MOUNT_RAD, _MOUNT_M = np.radians([0.4, -0.3, 0.2]), np.array([0.002, -0.003, 0.001])


class Carrier:
    """The camera on its mount, in front of the scene (towards -y of the world) while X stands at 0.

    The world's frame is the specimen's: what turns in it is the camera. The light turns with the specimen here, which
    it does not in a laboratory.
    """

    def __init__(self, tilt_deg: float, distance_m: float) -> None:
        tilt = np.radians(tilt_deg)
        eye = SCENE_CENTRE_M + distance_m * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
        drawn = look_at(eye, SCENE_CENTRE_M, np.array([0.0, 0.0, 1.0]))
        self._T_room_camera = drawn @ from_euler(_MOUNT_RAD, _MOUNT_M)

    def T_world_camera(self, position: Array) -> Array:
        """The camera (4, 4) at machine coordinates X (degrees) and Y (millimetres)."""
        back = Rotation.from_euler("z", -position[0], degrees=True).as_matrix()
        lifted = transform(np.eye(3), np.array([0.0, 0.0, metres(position[1])]))
        return transform(back, np.zeros(3)) @ lifted @ self._T_room_camera
