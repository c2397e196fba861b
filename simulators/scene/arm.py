"""The simulated arms as they are built: where the flange really is when the controller believes it somewhere else."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np

from simulators.geometry import Array, Json
from simulators.scene.factory_calibrations import draw_departures
from simulators.ur_controller.kinematics import MODELS, Model, forward
from simulators.ur_controller.kinematics import inverse as solve_joints

ARM_MODEL = MODELS["UR10e"]
_ALPHA_RAD = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
_ELBOW_UP = np.array([1.4, -1.6, 1.9, -1.9, -1.57, 0.0])


class SimulatedArm(Protocol):
    """An arm with errors that its controller does not know."""

    @property
    def name(self) -> str:
        """The manufacturer's name of the model."""
        ...

    @property
    def simulator(self) -> str:
        """The simulator of its controller, as `orthocapture simulate` names it."""
        ...

    @property
    def repeatability_m(self) -> float:
        """How far it comes to rest from the same place each time, rms."""
        ...

    def reported(self, q: Array) -> Array:
        """Return T_base_flange as the controller computes it from joints q, in radians."""
        ...

    def true(self, q: Array) -> Array:
        """Return the true T_base_flange (4, 4) at joints q, as the controller reads them."""
        ...

    def joints_for(self, T_base_flange: Array) -> Array | None:
        """Return joints of a usual posture that reach a pose, or None."""
        ...

    def truth(self) -> Json:
        """Return its errors as JSON data."""
        ...


#: What a controller does not know of its arm: how it was built (its factory calibration is lost, and it computes with
#: the published dimensions), what remains beside a calibration (above all the gears' errors), or both.
ArmErrorKind = Literal["factory", "gears", "both"]
ARM_ERRORS: tuple[ArmErrorKind, ...] = get_args(ArmErrorKind)
ARM_ERRORS_USUAL: ArmErrorKind = "both"


@dataclass(frozen=True, slots=True)
class ArmErrors:
    """Errors of a real arm of six axes that its controller does not know."""

    dh_deltas: Array  # (6, 5) added to a, d (metres), alpha, theta, beta (radians): as-built minus nominal
    wave_rad: Array  # (6,) amplitude of each gear's transmission error, which is periodic in the joint angle
    wave_number: Array  # (6,) periods per revolution
    wave_phase_rad: Array  # (6,)

    def scaled(self, dh: float, wave: float) -> ArmErrors:
        """Return these errors with the DH errors and the gear errors scaled."""
        return dataclasses.replace(self, dh_deltas=self.dh_deltas * dh, wave_rad=self.wave_rad * wave)

    @classmethod
    def draw(cls, rng: np.random.Generator) -> ArmErrors:
        """As-built geometry (0.5 mm rms at the flange over the work space) plus gear errors (another 0.5 mm rms).

        Hand-eye and base calibration absorb most of the former. The latter changes from viewpoint to viewpoint, so
        poses of such an arm are good to about half a millimetre after any hand-eye calibration.
        """
        sigma = np.array([0.10e-3, 0.10e-3, np.radians(0.006), np.radians(0.022)])
        deltas = np.zeros((6, 5))
        deltas[:, :4] = rng.standard_normal((6, 4)) * sigma
        drawn = cls(
            dh_deltas=deltas,
            wave_rad=np.radians(0.02) * rng.uniform(0.6, 1.0, 6),
            wave_number=rng.integers(3, 9, 6).astype(np.float64),
            wave_phase_rad=rng.uniform(0.0, 2 * np.pi, 6),
        )
        # Normalised, because a random draw could be a perfect or a broken arm.
        geometry, gears = drawn.scaled(1.0, 0.0), drawn.scaled(0.0, 1.0)
        return drawn.scaled(0.5e-3 / _rms_error_m(geometry), 0.5e-3 / _rms_error_m(gears))

    def of_kind(self, kind: ArmErrorKind, rng: np.random.Generator) -> ArmErrors:
        """Return these errors, or those of an arm whose factory calibration its controller lacks, or both."""
        if kind == "gears":
            return self
        departures = draw_departures(rng)
        if kind == "factory":
            return dataclasses.replace(self.scaled(0.0, 0.0), dh_deltas=departures)
        return dataclasses.replace(self, dh_deltas=self.dh_deltas + departures)


@dataclass(frozen=True, slots=True)
class UniversalRobot:
    """An UR10e."""

    errors: ArmErrors
    model: Model = ARM_MODEL
    simulator: str = "ur"
    repeatability_m: float = 0.02e-3

    @property
    def name(self) -> str:
        """The manufacturer's name of the model."""
        return self.model.name

    def reported(self, q: Array) -> Array:
        """Return T_base_flange as the controller computes it."""
        return forward(self.model, q)

    def true(self, q: Array) -> Array:
        """Return the true T_base_flange."""
        return perturbed_forward(q, self.errors)

    def joints_for(self, T_base_flange: Array) -> Array | None:
        """Return joints with the elbow up."""
        return solve_joints(self.model, T_base_flange, _ELBOW_UP)

    def truth(self) -> Json:
        """Return the errors of its geometry."""
        return {"dh_deltas": self.errors.dh_deltas.tolist()}


def perturbed_forward(q: Array, errors: ArmErrors) -> Array:
    """Return the true T_base_flange (4, 4) at joints q (6,) in radians, as the controller reads them."""
    T_base_link = np.eye(4)
    true_q = q + errors.wave_rad * np.sin(errors.wave_number * q + errors.wave_phase_rad)
    nominal = np.stack([ARM_MODEL.a_m, ARM_MODEL.d_m, _ALPHA_RAD, true_q, np.zeros(6)], axis=1)
    for a, d, alpha, theta, beta in nominal + errors.dh_deltas:
        ct, st, ca, sa, cb, sb = (f(v) for v in (theta, alpha, beta) for f in (np.cos, np.sin))
        turn = np.array([[cb, sb * sa, sb * ca], [0.0, ca, -sa], [-sb, cb * sa, cb * ca]])
        link = np.eye(4)
        link[:3, :3] = np.array([[ct, -st, 0.0], [st, ct, 0.0], [0.0, 0.0, 1.0]]) @ turn
        link[:3, 3] = a * ct, a * st, d
        T_base_link = T_base_link @ link
    return T_base_link


def _rms_error_m(errors: ArmErrors) -> float:
    """RMS displacement of the flange over the work space of a capture, in metres."""
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (60, 6)) * [0.5, 0.35, 0.35, 0.4, 0.4, 1.0]
    q += [1.57, -1.5, 1.9, -2.0, -1.57, 0.0]
    shift = [perturbed_forward(row, errors)[:3, 3] - forward(ARM_MODEL, row)[:3, 3] for row in q]
    return float(np.sqrt(np.mean(np.sum(np.square(shift), axis=1))))
