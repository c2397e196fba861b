"""Where the simulated arm's flange really is: forward kinematics with errors in the DH parameters."""

from __future__ import annotations

import numpy as np

from simulators.geometry import Array
from simulators.ur_controller.kinematics import MODELS

ARM_MODEL = MODELS["UR10e"]
_ALPHA_RAD = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)


def perturbed_forward(q: Array, deltas: Array) -> Array:
    """T_base_flange (4, 4) at joints q (6,); deltas (6, 4) are added to a, d (metres), alpha, theta (radians)."""
    T_base_link = np.eye(4)
    nominal = np.stack([ARM_MODEL.a_m, ARM_MODEL.d_m, _ALPHA_RAD, q], axis=1)
    for a, d, alpha, theta in nominal + deltas:
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T_base_link = T_base_link @ np.array(
            [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
    return T_base_link
