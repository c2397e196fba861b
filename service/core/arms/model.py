"""What is declared of an arm, which arms are known by it, and the flange's pose that follows from joint angles."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from typing import Literal

import numpy as np

from service.core.declared_kinds import plug_ins
from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform

#: Which closed form gives the joints for a pose: Universal Robots' six axes, or a spherical shoulder and wrist.
Family = Literal["universal_robot", "seven_axes"]
_PARALLEL = 1e-9  # sine of the angle between two axes


@dataclass(frozen=True, slots=True)
class Link:
    """A capsule around a part of the arm: all points within `radius_m` of a segment fixed to one of the DH frames.

    Attributes:
        name: the part's name, as technicians know it.
        frame: the frame's number: 0 is the base, k the frame after joint k.
        start_m: (3,) one end of the segment in that frame.
        end_m: (3,) the other end.
        radius_m: the capsule's radius.
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
        dh: standard deviations of each joint's a, d (metres), α and θ (radians).
        lengths_m: those of a and d, joint by joint; empty: those of `dh` for all joints.
        twists_rad: that of α, joint by joint; empty: that of `dh` for all joints.
        parallel_rad: that of β, by which an axis departs from the parallel one before it (`ArmModel.parallel`).
        weight: the number of parameters whose measurement on such arms says that their common scale is about 1; 0:
            they are assumed, and the scale is estimated from the images alone.
        gear_rad: amplitude of each harmonic of a gear's error.
        harmonics: the estimated numbers of periods per revolution are 1 … this one.
    """

    dh: tuple[float, float, float, float] = (0.2e-3, 0.2e-3, float(np.radians(0.015)), float(np.radians(0.04)))
    lengths_m: tuple[tuple[float, float], ...] = ()
    twists_rad: tuple[float, ...] = ()
    parallel_rad: float = float(np.radians(0.015))
    weight: float = 0.0
    gear_rad: float = float(np.radians(0.01))
    harmonics: int = 10  # tens of poses cannot distinguish faster ones from noise


@dataclass(frozen=True, slots=True, eq=False)
class ArmModel:
    """An arm of N axes with its nominal DH parameters in the classic convention.

    T_(i-1)_i = Rz(θ_i) Tz(d_i) Tx(a_i) Rx(α_i).

    Attributes:
        name: the manufacturer's name for it, as the controller gives it.
        family: the closed form that solves it.
        a_m: (N,) link lengths.
        d_m: (N,) link offsets.
        alpha_rad: (N,) link twists.
        limits_rad: (N,) largest absolute angle of each joint.
        speeds_rad_s: (N,) largest speed of each joint.
        acceleration_rad_s2: the largest that its controller accepts for a joint motion.
        braking_rad_s2: the deceleration of the fastest joint when the controller ends a motion by itself.
        links: capsules from the base to the flange; the camera comes from the rig file.
        allowed: pairs of parts that touch by design, or cannot touch: links, `camera`, `table`, `specimen`,
            `spheres`, `surroundings`; the first of a pair is the one nearer to the base.
        usual_rad: (N,) joints of a posture with the camera above a scene that lies in the direction of the base's x.
        payload_kg: largest load on the flange.
        tolerances: the usual errors of its geometry.
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
        """Return (K, N, 4) nominal a, d, α, θ for joints (K, N)."""
        rest = np.stack([self.a_m, self.d_m, self.alpha_rad], axis=1)
        return np.concatenate(
            [np.broadcast_to(rest, (len(joints_rad), self.axes, 3)), joints_rad[:, :, None]], axis=2
        )


#: How far a reported flange may be from the nominal forward kinematics of its joints. A controller computes with the
#: arm's own factory calibration, which is not published: of the published ones, none differs by 6 mm.
FITS_M = 0.010
FITS_RAD = math.radians(2.0)


def flange_pose(arm: ArmModel, joints_rad: Array) -> Transform:
    """Return T_base_flange (4, 4) at joints (N,) with the nominal parameters.

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
    """Return the distance (m) and the angle (rad) between two poses (4, 4)."""
    turn = T_a[:3, :3].T @ T_b[:3, :3]
    w = (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    angle_rad = math.atan2(math.hypot(*w), float(np.trace(turn)) - 1.0)
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), angle_rad


def fits(gap: tuple[float, float]) -> bool:
    """Return whether a flange may be where it is reported, this far (m, rad) from where its joints put it."""
    return gap[0] <= FITS_M and gap[1] <= FITS_RAD


GROUP = "orthocapture.arms"


@cache
def known_arms() -> tuple[ArmModel, ...]:
    """Return all arms, by name of their row: those of the two tables, and those of other packages' entry points."""
    from service.core.arms import kuka, universal_robots  # noqa: PLC0415 - their rows are models

    found: dict[str, ArmModel] = {**kuka.ARMS, **universal_robots.ARMS}
    for point in plug_ins(GROUP):
        arm: object = point.load()
        if not isinstance(arm, ArmModel):
            raise ConfigurationError(
                f"the entry point {point.name} of {GROUP} is not an ArmModel",
                where=point.value,
                remedy="Let it name an ArmModel, or remove the package that has it",
            )
        found[point.name] = arm
    return tuple(found[name] for name in sorted(found))


def arm_model(name: str) -> ArmModel:
    """Return the arm of this name, in upper or lower case.

    Raises:
        ConfigurationError: the name is unknown.
    """
    by_name = {arm.name.lower(): arm for arm in known_arms()}
    if name.lower() in by_name:
        return by_name[name.lower()]
    near = get_close_matches(name.lower(), by_name, n=1)
    hint = f"did you mean {by_name[near[0]].name}? " if near else ""
    known = ", ".join(arm.name for arm in by_name.values())
    raise ConfigurationError(f"no kinematics are known for an arm {name!r}", remedy=f"{hint}known are {known}")


def known_arm(name: str) -> ArmModel | None:
    """Return the arm of this name, or None if it is not known."""
    return next((arm for arm in known_arms() if arm.name.lower() == name.lower()), None)
