"""Guides a hand-held camera: the wanted places, and the text that leads from the current one to them.

The level frame is in the middle of the scene: z up, y in the direction in which the first image's top pointed, so
that the person stood at −y. A camera's attitude is `turn` about z, `lean` of its right side down and `tilt` of its
axis down from the horizon: R = Rz(turn) Ry(lean) Rx(−tilt) C0, where C0 looks along y with its top up. This is
singular only if the camera's side points up, not if it looks straight down.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from service.core.geometry import Array, Transform, inverse, transform
from service.core.units import deg

_FORWARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # C0: columns are x, y, z of the camera
_COARSE_FROM_M = 0.10  # distances above are given in steps of five centimetres, below in steps of one
_ANGLE_STEP_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Attitude:
    """A camera's orientation in the level frame, radians; see the module's docstring."""

    turn_rad: float
    lean_rad: float
    tilt_rad: float

    @classmethod
    def of(cls, R_level_camera: Array) -> Attitude:
        """Return the attitude of a rotation matrix R_level_camera (3, 3)."""
        x, z = R_level_camera[:, 0], R_level_camera[:, 2]
        turn, lean = float(np.arctan2(x[1], x[0])), float(np.arcsin(np.clip(-x[2], -1.0, 1.0)))
        ahead = (Rotation.from_euler("z", turn) * Rotation.from_euler("y", lean)).inv().apply(z)
        return cls(turn, lean, float(np.arctan2(-ahead[2], ahead[1])))

    def matrix(self) -> Array:
        """Return (3, 3) R_level_camera."""
        turned = Rotation.from_euler("z", self.turn_rad) * Rotation.from_euler("y", self.lean_rad)
        return np.asarray((turned * Rotation.from_euler("x", -self.tilt_rad)).as_matrix() @ _FORWARD)


@dataclass(frozen=True, slots=True)
class WantedView:
    """A wanted view: the camera pose in the level frame."""

    name: str
    T_level_camera: Transform
    aim_m: Array  # (3,) point that the camera looks at


def level_frame(centre_m: Array, up: Array, top: Array) -> Transform:
    """Return T_scene_level: origin at `centre_m` (3,), z along `up` (3,), y along the level part of `top` (3,)."""
    z = up / np.linalg.norm(up)
    y = top - z * (top @ z)
    if np.linalg.norm(y) < 1e-6:
        y = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    y = y / np.linalg.norm(y)
    return transform(np.column_stack([np.cross(y, z), y, z]), np.asarray(centre_m, dtype=np.float64))


def away_from_plane(spheres_m: Array, eye_m: Array) -> Array:
    """Return the normal (3,) of the best plane through the spheres (M, 3), towards the camera at `eye_m` (3,)."""
    middle = spheres_m.mean(axis=0)
    normal = np.linalg.svd(spheres_m - middle)[2][2]
    return np.asarray(normal if (eye_m - middle) @ normal > 0 else -normal, dtype=np.float64)


def place_at(
    name: str, *, tilt_deg: float, azimuth_deg: float, distance_m: float, walk_round: bool, aim_m: Sequence[float]
) -> WantedView:
    """Compute a place on the hemisphere around the scene.

    Args:
        tilt_deg: angle of the line of sight from the vertical.
        azimuth_deg: 0 is the person's side, positive to the person's right.
        distance_m: distance from `aim_m`.
        walk_round: true if the person walks round the scene and the top of the image points away from the person;
            otherwise it stays as in the first image.
        aim_m: (3,) point that the camera looks at, level frame.
    """
    tilt, azimuth = np.deg2rad(tilt_deg), np.deg2rad(azimuth_deg)
    aim, out = np.asarray(aim_m, dtype=np.float64), np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    axis = -(np.cos(tilt) * np.array([0.0, 0.0, 1.0]) + np.sin(tilt) * out)
    top = -out if walk_round else np.array([0.0, 1.0, 0.0])
    right = np.cross(axis, top)
    right /= np.linalg.norm(right)
    return WantedView(
        name, transform(np.column_stack([right, np.cross(axis, right), axis]), aim - distance_m * axis), aim
    )


def words(T_level_here: Transform, T_level_there: Transform) -> str:
    """Return a text such as `20 cm to the left, 10 cm lower, tilt 15° down` from one camera pose (4, 4) to another.

    Both poses are in the level frame. Left, right, forward and back are those of a holder who looks in the direction
    of the image's top; the camera is first moved, then turned. Empty if there is nothing to change.
    """
    here, there = Attitude.of(T_level_here[:3, :3]), Attitude.of(T_level_there[:3, :3])
    moved = Rotation.from_euler("z", -here.turn_rad).apply(T_level_there[:3, 3] - T_level_here[:3, 3])
    parts = [
        _distance(float(moved[0]), "to the right", "to the left"),
        _distance(float(moved[1]), "forward", "back"),
        _distance(float(moved[2]), "higher", "lower"),
        _angle(there.turn_rad - here.turn_rad, "turn", "to the left", "to the right"),
        _angle(there.tilt_rad - here.tilt_rad, "tilt", "down", "up"),
        _angle(there.lean_rad - here.lean_rad, "lean", "to the right", "to the left"),
    ]
    return ", ".join(part for part in parts if part)


def _distance(metres: float, positive: str, negative: str) -> str:
    step_cm = 5 if abs(metres) >= _COARSE_FROM_M else 1
    centimetres = step_cm * round(100 * abs(metres) / step_cm)
    return f"{centimetres} cm {positive if metres > 0 else negative}" if centimetres else ""


def _angle(radians: float, verb: str, positive: str, negative: str) -> str:
    degrees = deg((radians + np.pi) % (2 * np.pi) - np.pi)
    told = int(_ANGLE_STEP_DEG * round(abs(degrees) / _ANGLE_STEP_DEG))
    return f"{verb} {told}° {positive if degrees > 0 else negative}" if told else ""


def covered(places: Iterable[WantedView], T_level_cameras: Sequence[Transform], within_deg: float) -> set[str]:
    """Return the names of the places that an image covers: position and axis agree within `within_deg`."""
    limit = np.cos(np.deg2rad(within_deg))
    done: set[str] = set()
    for place in places:
        from_aim = place.T_level_camera[:3, 3] - place.aim_m
        for T in T_level_cameras:
            away = T[:3, 3] - place.aim_m
            cosine = (from_aim @ away) / (np.linalg.norm(from_aim) * np.linalg.norm(away))
            if min(cosine, place.T_level_camera[:3, 2] @ T[:3, 2]) >= limit:
                done.add(place.name)
                break
    return done


def nearest(places: Iterable[WantedView], T_level_here: Transform) -> WantedView:
    """Return the place nearest to here, a radian of rotation counting as 40 cm. `places` is not empty."""

    def way(place: WantedView) -> float:
        moved = float(np.linalg.norm(place.T_level_camera[:3, 3] - T_level_here[:3, 3]))
        turned = Rotation.from_matrix(T_level_here[:3, :3].T @ place.T_level_camera[:3, :3]).magnitude()
        return moved + 0.4 * float(turned)

    return min(places, key=lambda place: (round(way(place), 3), place.name))


def same_view(T_a: Transform, T_b: Transform, apart_m: float, apart_rad: float) -> bool:
    """Return whether two camera poses in one frame are so near that the second image adds nothing."""
    T = inverse(T_a) @ T_b
    return bool(np.linalg.norm(T[:3, 3]) < apart_m and Rotation.from_matrix(T[:3, :3]).magnitude() < apart_rad)
