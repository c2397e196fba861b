"""What is declared of an arm: Denavit–Hartenberg parameters, limits, capsules, and tolerances of its geometry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from service.core.geometry import Array

#: Which closed form gives the joints for a pose: Universal Robots' six axes, or a spherical shoulder and wrist.
Family = Literal["universal_robot", "seven_axes"]
_PARALLEL = 1e-9  # sine of the angle between two axes


@dataclass(frozen=True, slots=True)
class Link:
    """A capsule around a part of the arm: all points within `radius_m` of a segment fixed to one of the DH frames.

    Attributes:
        name: of the part, as technicians know it.
        frame: 0 is the base, k the frame after joint k.
        start_m: (3,) one end of the segment in that frame.
        end_m: (3,) the other end.
        radius_m: of the capsule.
    """

    name: str
    frame: int
    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True, slots=True)
class ArmTolerances:
    """Usual errors of an arm's geometry, one standard deviation; a calibration estimates a scale of each kind.

    Attributes:
        dh: of a, d (metres), α, θ (radians) of each joint.
        lengths_m: of a and d, joint by joint; empty: those of `dh` for all.
        twists_rad: of α, joint by joint; empty: that of `dh` for all.
        parallel_rad: of β, by which an axis departs from the parallel one before it (`ArmModel.parallel`).
        weight: of how many parameters their common scale is known to be about 1, because they were measured on such
            arms; 0: they are assumed, and the images alone tell the scale.
        gear_rad: amplitude of each harmonic of a gear's error.
        harmonics: periods per revolution that are estimated are 1 … this number.
    """

    dh: tuple[float, float, float, float] = (0.2e-3, 0.2e-3, float(np.radians(0.015)), float(np.radians(0.04)))
    lengths_m: tuple[tuple[float, float], ...] = ()
    twists_rad: tuple[float, ...] = ()
    parallel_rad: float = float(np.radians(0.015))
    weight: float = 0.0
    gear_rad: float = float(np.radians(0.01))
    harmonics: int = 10  # tens of poses cannot tell faster ones from noise


@dataclass(frozen=True, slots=True, eq=False)
class ArmModel:
    """An arm of N axes with its nominal DH parameters in the classic convention.

    T_(i-1)_i = Rz(θ_i) Tz(d_i) Tx(a_i) Rx(α_i).

    Attributes:
        name: the manufacturer's, as the controller states it.
        family: which closed form solves it.
        a_m: (N,) link lengths.
        d_m: (N,) link offsets.
        alpha_rad: (N,) link twists.
        limits_rad: (N,) largest absolute angle of each joint.
        speeds_rad_s: (N,) largest speed of each joint.
        acceleration_rad_s2: largest that its controller takes for a joint motion.
        braking_rad_s2: with which the controller brakes the fastest joint when it ends a motion by itself.
        links: capsules from the base to the flange; the camera comes from the rig file.
        allowed: pairs of parts that touch by design, or cannot touch: links, `camera`, `table`, `specimen`,
            `spheres`, `surroundings`; the first of a pair is the one nearer to the base.
        usual_rad: (N,) joints of a posture with the camera above a scene that lies in the direction of the base's x.
        payload_kg: largest load on the flange.
        tolerances: of its geometry.
    """

    name: str
    family: Family
    a_m: Array
    d_m: Array
    alpha_rad: Array
    limits_rad: Array
    speeds_rad_s: Array
    acceleration_rad_s2: float
    braking_rad_s2: float
    links: tuple[Link, ...] = field(repr=False)
    allowed: frozenset[tuple[str, str]] = field(repr=False)
    usual_rad: Array = field(repr=False)
    payload_kg: float
    tolerances: ArmTolerances = ArmTolerances()

    @property
    def axes(self) -> int:
        """Number of joints."""
        return len(self.d_m)

    @property
    def parallel(self) -> tuple[int, ...]:
        """Joints whose next axis is parallel to theirs, from 0.

        Two axes that are nearly parallel need an angle β about y beside α (Hayati and Mirmirani, 1985): without it
        the smallest departure would take an endless d.
        """
        return tuple(int(i) for i in np.flatnonzero((np.abs(np.sin(self.alpha_rad)) < _PARALLEL) & (self.a_m != 0)))

    def joint_values(self, joints_rad: Array) -> Array:
        """(K, N, 4) nominal a, d, α, θ for joints (K, N)."""
        rest = np.stack([self.a_m, self.d_m, self.alpha_rad], axis=1)
        return np.concatenate(
            [np.broadcast_to(rest, (len(joints_rad), self.axes, 3)), joints_rad[:, :, None]], axis=2
        )
