"""The simulated arm's true flange pose: forward kinematics with errors in the DH parameters and the gears."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array
from simulators.ur_controller.kinematics import MODELS

ARM_MODEL = MODELS["UR10e"]
_ALPHA_RAD = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)


@dataclass(frozen=True, slots=True)
class ArmErrors:
    """Errors of the real arm that its controller does not know."""

    dh_deltas: Array  # (6, 4) added to a, d (metres), alpha, theta (radians): as-built minus nominal
    wave_rad: Array  # (6,) amplitude of each gear's transmission error, which is periodic in the joint angle
    wave_number: Array  # (6,) periods per revolution
    wave_phase_rad: Array  # (6,)

    def scaled(self, dh: float, wave: float) -> ArmErrors:
        """Return these errors with the DH errors and the gear errors scaled."""
        return dataclasses.replace(self, dh_deltas=self.dh_deltas * dh, wave_rad=self.wave_rad * wave)


def perturbed_forward(q: Array, errors: ArmErrors) -> Array:
    """Return the true T_base_flange (4, 4) at joints q (6,) in radians, as the controller reads them."""
    T_base_link = np.eye(4)
    true_q = q + errors.wave_rad * np.sin(errors.wave_number * q + errors.wave_phase_rad)
    nominal = np.stack([ARM_MODEL.a_m, ARM_MODEL.d_m, _ALPHA_RAD, true_q], axis=1)
    for a, d, alpha, theta in nominal + errors.dh_deltas:
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T_base_link = T_base_link @ np.array(
            [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
    return T_base_link
