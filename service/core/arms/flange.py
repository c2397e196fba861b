"""Whether an arm's flange is reported where its joints put it: forward kinematics of one posture."""

from __future__ import annotations

import math

import numpy as np

from service.core.arms.model import ArmModel
from service.core.geometry import Array, Transform

#: How far a reported flange may be from the nominal forward kinematics of its joints. A controller computes with the
#: arm's own factory calibration, which nobody else is told: of the published ones, none differs by 6 mm.
FITS_M = 0.010
FITS_RAD = math.radians(2.0)


def flange_pose(arm: ArmModel, joints_rad: Array) -> Transform:
    """T_base_flange (4, 4) at joints (N,) with the nominal parameters.

    In plain floats: an arm sends 125 samples a second, and one product of small arrays costs as much as all this.
    """
    r00 = r11 = r22 = 1.0
    r01 = r02 = r10 = r12 = r20 = r21 = x = y = z = 0.0
    rows = zip(joints_rad.tolist(), arm.a_m.tolist(), arm.d_m.tolist(), arm.alpha_rad.tolist(), strict=True)
    for theta, a, d, alpha in rows:
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        # The new x axis, and the one at right angles to it and to the joint's.
        u0, u1, u2 = r00 * ct + r01 * st, r10 * ct + r11 * st, r20 * ct + r21 * st
        v0, v1, v2 = r01 * ct - r00 * st, r11 * ct - r10 * st, r21 * ct - r20 * st
        x, y, z = x + a * u0 + d * r02, y + a * u1 + d * r12, z + a * u2 + d * r22
        r00, r10, r20, r01, r11, r21, r02, r12, r22 = (
            *(u0, u1, u2),
            *(ca * v0 + sa * r02, ca * v1 + sa * r12, ca * v2 + sa * r22),
            *(ca * r02 - sa * v0, ca * r12 - sa * v1, ca * r22 - sa * v2),
        )
    return np.array([[r00, r01, r02, x], [r10, r11, r12, y], [r20, r21, r22, z], [0.0, 0.0, 0.0, 1.0]])


def pose_gap(T_a: Transform, T_b: Transform) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses (4, 4)."""
    turn = T_a[:3, :3].T @ T_b[:3, :3]
    w = (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    angle_rad = math.atan2(math.hypot(*w), float(np.trace(turn)) - 1.0)
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), angle_rad


def fits(gap: tuple[float, float]) -> bool:
    """Whether a flange that is reported so far (m, rad) from where its joints put it may be there all the same."""
    return gap[0] <= FITS_M and gap[1] <= FITS_RAD
