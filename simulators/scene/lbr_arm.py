"""A KUKA LBR as it is built: every link a little displaced, gears that err, joints that yield under their load."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array, Json, from_euler
from simulators.kuka_controller.kinematics import MODELS, Model, forward, frames
from simulators.kuka_controller.kinematics import inverse as solve_joints

_USUAL = np.array([0.0, 0.5, 0.0, -1.4, 0.0, 1.2, -1.57])
_STARTS = 12  # turns of the base joint from which joints are sought
_GRAVITY_M_S2 = 9.81
# Masses (kg) where the chain carries them: the frame of each, and how far along that frame's z (metres).
_MASSES = ((4.0, 2, 0.10), (4.5, 2, 0.32), (3.5, 4, 0.10), (3.0, 4, 0.30), (2.2, 6, 0.03), (1.6, 7, 0.08))


@dataclass(frozen=True, slots=True)
class LbrErrors:
    """Errors of an LBR that its controller does not know; they are not of the form of Denavit–Hartenberg deltas."""

    link_turn_rad: Array  # (8, 3) rotation of each link's end, base and flange included
    link_shift_m: Array  # (8, 3) displacement there
    wave_rad: Array  # (7, 2) amplitudes of each gear's errors
    wave_number: Array  # (7, 2) periods per revolution, no whole numbers
    wave_phase_rad: Array  # (7, 2)
    compliance_rad_nm: Array  # (7,) turn of each joint by the torque of gravity

    def scaled(self, geometry: float, wave: float, compliance: float) -> LbrErrors:
        """Return these errors with the three kinds scaled."""
        return dataclasses.replace(
            self,
            link_turn_rad=self.link_turn_rad * geometry,
            link_shift_m=self.link_shift_m * geometry,
            wave_rad=self.wave_rad * wave,
            compliance_rad_nm=self.compliance_rad_nm * compliance,
        )

    @classmethod
    def draw(cls, rng: np.random.Generator) -> LbrErrors:
        """Geometry and gears of 0.5 mm rms each at the flange over the work space, and 0.3 mm of compliance.

        Normalised, because a random draw could be a perfect or a broken arm.
        """
        drawn = cls(
            link_turn_rad=np.radians(0.01) * rng.standard_normal((8, 3)),
            link_shift_m=0.1e-3 * rng.standard_normal((8, 3)),
            wave_rad=np.radians(0.015) * rng.uniform(0.5, 1.0, (7, 2)),
            wave_number=rng.uniform(1.5, 7.5, (7, 2)),
            wave_phase_rad=rng.uniform(0.0, 2 * np.pi, (7, 2)),
            compliance_rad_nm=rng.uniform(0.7, 1.3, 7) * 5e-6,
        )
        alone = np.eye(3)
        geometry, gears, load = (_rms_error_m(drawn.scaled(*(float(v) for v in row))) for row in alone)
        return drawn.scaled(0.5e-3 / geometry, 0.5e-3 / gears, 0.3e-3 / load)


@dataclass(frozen=True, slots=True)
class Lbr:
    """An LBR Med 14 or LBR iiwa 14.

    Its repeatability, ±0.15 mm by ISO 9283, is the mean distance plus three of its standard deviations: 2.1 times the
    rms distance.
    """

    errors: LbrErrors
    model: Model
    simulator: str = "kuka"
    repeatability_m: float = 0.15e-3 / 2.08

    @property
    def name(self) -> str:
        """The manufacturer's name of the model."""
        return self.model.name

    def reported(self, q: Array) -> Array:
        """Return T_base_flange as the controller computes it."""
        return forward(self.model, q)

    def true(self, q: Array) -> Array:
        """Return the true T_base_flange."""
        return as_built(self.model, q, self.errors)

    def joints_for(self, T_base_flange: Array) -> Array | None:
        """Return joints with the elbow up."""
        return _usual_joints(self.model, T_base_flange)

    def truth(self) -> Json:
        """Return the errors of its geometry."""
        return {
            "link_turn_rad": self.errors.link_turn_rad.tolist(),
            "link_shift_m": self.errors.link_shift_m.tolist(),
            "compliance_rad_nm": self.errors.compliance_rad_nm.tolist(),
        }


LBR_MODELS = MODELS


def as_built(model: Model, q: Array, errors: LbrErrors) -> Array:
    """Return the true T_base_flange (4, 4) at joints q (7,) in radians, as the controller reads them."""
    true_q = q + np.sum(errors.wave_rad * np.sin(errors.wave_number * q[:, None] + errors.wave_phase_rad), axis=1)
    true_q = true_q + errors.compliance_rad_nm * gravity_torques_nm(model, q)
    ends = [from_euler(turn, shift) for turn, shift in zip(errors.link_turn_rad, errors.link_shift_m, strict=True)]
    T_base_link = ends[0]
    chain = frames(model, true_q)
    for before, after, end in zip(chain[:-1], chain[1:], ends[1:], strict=True):
        T_base_link = T_base_link @ np.linalg.solve(before, after) @ end
    return T_base_link


def gravity_torques_nm(model: Model, q: Array) -> Array:
    """Return the torque (7,) with which gravity turns each joint."""
    chain = frames(model, q)
    torques = np.zeros(7)
    for mass_kg, frame, along_m in _MASSES:
        place = chain[frame][:3, 3] + along_m * chain[frame][:3, 2]
        force = np.array([0.0, 0.0, -mass_kg * _GRAVITY_M_S2])
        for joint in range(frame):
            axis, origin = chain[joint][:3, 2], chain[joint][:3, 3]
            torques[joint] += float(axis @ np.cross(place - origin, force))
    return torques


def _usual_joints(model: Model, T_base_flange: Array) -> Array | None:
    """Return joints that reach a pose, sought from the usual posture turned towards it, and then all round."""
    towards = np.arctan2(T_base_flange[1, 3], T_base_flange[0, 3])
    for turn in towards + np.linspace(0, 2 * np.pi, _STARTS, endpoint=False):
        start = _USUAL.copy()
        start[0] = np.arctan2(np.sin(turn), np.cos(turn))
        q = solve_joints(model, T_base_flange, start)
        if q is not None:
            return q
    return None


def _rms_error_m(errors: LbrErrors) -> float:
    """RMS displacement of the flange over the work space of a capture, in metres."""
    model = MODELS["LBR Med 14"]
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (60, 7)) * [0.6, 0.35, 0.6, 0.4, 0.6, 0.4, 1.0] + _USUAL
    shift = [as_built(model, row, errors)[:3, 3] - forward(model, row)[:3, 3] for row in q]
    return float(np.sqrt(np.mean(np.sum(np.square(shift), axis=1))))
