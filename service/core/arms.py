"""Arms as they are declared: dimensions, limits, bodies, usual errors; which are known, and where the flange is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from typing import Literal

import numpy as np

from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform
from service.core.loading import plug_ins

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
    found: dict[str, ArmModel] = {**KUKA, **UNIVERSAL_ROBOTS}
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


_ALLOWED = frozenset(
    {
        # Neighbouring links touch by design, and the mount holds the camera beside the last two joints. Shoulder and
        # base do not move relative to the table, so it is not checked against them.
        ("base", "shoulder"), ("base", "upper arm"), ("shoulder", "upper arm"), ("upper arm", "forearm"),
        ("forearm", "wrist 1"), ("forearm", "wrist 2"), ("wrist 1", "wrist 2"), ("wrist 1", "wrist 3"),
        ("wrist 2", "wrist 3"), ("wrist 1", "camera"), ("wrist 2", "camera"), ("wrist 3", "camera"),
        ("base", "table"), ("shoulder", "table"), ("upper arm", "table"),
        ("base", "specimen"), ("base", "spheres"), ("base", "surroundings"),
    }
)  # fmt: skip
# The client library takes no more than this (ur_rtde: UR_JOINT_VELOCITY_MAX, UR_JOINT_ACCELERATION_MAX). Data sheets
# state no acceleration, and for some joints a little more speed: 180°/s, or 360°/s.
_SPEED_RAD_S, _ACCELERATION_RAD_S2 = 3.14, 40.0
_BRAKING_RAD_S2 = 4.0  # of a program that was ended; assumed: measure it on the arm (docs/howto/your_hardware.md)
# Spread of thirteen published factory calibrations, for a controller that has none, and 0.1 mm for what these do
# not show; the zeros of the joints are right in all of them. Between forearm and wrist 1 the axes are turned by up to
# 0.76°. Offsets 2 and 3 are along the same direction as 4, which stands for all three.
_TOLERANCES = ArmTolerances(
    dh=(0.2e-3, 0.3e-3, float(np.radians(0.05)), float(np.radians(0.04))),
    lengths_m=((1.6e-4, 2.0e-4), (3.3e-4, 1e-4), (2.5e-4, 1e-4), (1.1e-4, 6.5e-4), (1.3e-4, 1.3e-4), (1e-4, 6e-4)),
    twists_rad=tuple(float(v) for v in np.radians([0.05, 0.08, 0.34, 0.06, 0.05, 0.05])),
    parallel_rad=float(np.radians(0.08)),
    weight=8.0,
)
_BASE_DEPTH_M = 0.10  # pedestal top below the base frame


def universal_robot(
    name: str,
    *,
    a_m: tuple[float, float],
    d_m: tuple[float, float, float, float],
    speeds_deg_s: tuple[float, ...],
    payload_kg: float,
    elbow_deg: float = 360.0,
) -> ArmModel:
    """Return the model of an arm of Universal Robots.

    The capsules are sized for the UR10e, and scaled by the wrist's offset for others.

    Args:
        name: the arm's name as the controller gives it.
        a_m: lengths of upper arm and forearm, negative.
        d_m: the offsets 1, 4, 5 and 6.
        speeds_deg_s: (6,) largest speeds of the joints, as the data sheet gives them.
        payload_kg: the largest load on the flange.
        elbow_deg: the range of the elbow to each side; all others turn by 360°.
    """
    half = np.pi / 2
    limits_deg = np.array([360.0, 360.0, elbow_deg, 360.0, 360.0, 360.0])
    return ArmModel(
        name=name,
        family="universal_robot",
        a_m=np.array([0, *a_m, 0, 0, 0]),
        d_m=np.array([d_m[0], 0, 0, *d_m[1:]]),
        alpha_rad=np.array([half, 0, 0, half, -half, 0]),
        limits_rad=np.radians(limits_deg),
        speeds_rad_s=np.minimum(np.radians(speeds_deg_s), _SPEED_RAD_S),
        acceleration_rad_s2=_ACCELERATION_RAD_S2,
        braking_rad_s2=_BRAKING_RAD_S2,
        links=_links(*a_m, *d_m[1:]),
        allowed=_ALLOWED,
        usual_rad=np.array([np.pi, -1.6, 1.9, -1.9, -1.57, 0.0]),  # at 0 the arm lies along -x
        payload_kg=payload_kg,
        tolerances=_TOLERANCES,
    )


def _links(a2: float, a3: float, d4: float, d5: float, d6: float) -> tuple[Link, ...]:
    scale = d4 / 0.17415
    # The long links lie beside the plane of the DH model, along the second axis.
    upper, fore = 1.012 * d4, 0.226 * d4
    return (
        Link("base", 0, (0, 0, -_BASE_DEPTH_M), (0, 0, 0.05), 0.095 * scale),
        Link("shoulder", 1, (0, 0, 0), (0, 0, upper), 0.095 * scale),
        Link("upper arm", 2, (-a2, 0, upper), (0, 0, upper), 0.075 * scale),
        Link("forearm", 3, (-a3, 0, fore), (0, 0, fore), 0.065 * scale),
        Link("wrist 1", 3, (0, 0, fore), (0, 0, d4), 0.055 * scale),
        Link("wrist 2", 4, (0, 0, 0), (0, 0, d5), 0.055 * scale),
        Link("wrist 3", 5, (0, 0, 0), (0, 0, d6), 0.05 * scale),
    )


#: By the name of a row. Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics"
#: (support article), and the data sheets.
UNIVERSAL_ROBOTS: Mapping[str, ArmModel] = {
    "ur10": universal_robot(
        "UR10",
        a_m=(-0.612, -0.5723),
        d_m=(0.1273, 0.163941, 0.1157, 0.0922),
        speeds_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
        payload_kg=10.0,
    ),
    "ur10e": universal_robot(
        "UR10e",
        a_m=(-0.6127, -0.57155),
        d_m=(0.1807, 0.17415, 0.11985, 0.11655),
        speeds_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
        payload_kg=12.5,
    ),
    "ur16e": universal_robot(
        "UR16e",
        a_m=(-0.4784, -0.36),
        d_m=(0.1807, 0.17415, 0.11985, 0.11655),
        speeds_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
        payload_kg=16.0,
    ),
    "ur20": universal_robot(
        "UR20",
        a_m=(-0.8620, -0.7287),
        d_m=(0.2363, 0.2010, 0.1593, 0.1543),
        speeds_deg_s=(120.0, 120.0, 150.0, 210.0, 210.0, 210.0),
        payload_kg=20.0,
    ),
    "ur3": universal_robot(
        "UR3",
        a_m=(-0.24365, -0.21325),
        d_m=(0.1519, 0.11235, 0.08535, 0.0819),
        speeds_deg_s=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
        payload_kg=3.0,
    ),
    "ur30": universal_robot(
        "UR30",
        a_m=(-0.6370, -0.5037),
        d_m=(0.2363, 0.2010, 0.1593, 0.1543),
        speeds_deg_s=(120.0, 120.0, 150.0, 210.0, 210.0, 210.0),
        payload_kg=30.0,
    ),
    "ur3e": universal_robot(
        "UR3e",
        a_m=(-0.24355, -0.2132),
        d_m=(0.15185, 0.13105, 0.08535, 0.0921),
        speeds_deg_s=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
        payload_kg=3.0,
    ),
    "ur5": universal_robot(
        "UR5",
        a_m=(-0.425, -0.39225),
        d_m=(0.089159, 0.10915, 0.09465, 0.0823),
        speeds_deg_s=(180.0, 180.0, 180.0, 180.0, 180.0, 180.0),
        payload_kg=5.0,
    ),
    "ur5e": universal_robot(
        "UR5e",
        a_m=(-0.425, -0.3922),
        d_m=(0.1625, 0.1333, 0.0997, 0.0996),
        speeds_deg_s=(180.0, 180.0, 180.0, 180.0, 180.0, 180.0),
        payload_kg=5.0,
        elbow_deg=180.0,
    ),
}


_LBR_ALLOWED = frozenset(
    {
        ("base", "shoulder"), ("base", "upper arm"), ("shoulder", "upper arm"), ("upper arm", "forearm"),
        ("forearm", "hand"), ("hand", "camera"),
        ("base", "table"), ("shoulder", "table"),
        ("base", "specimen"), ("base", "spheres"), ("base", "surroundings"),
    }
)  # fmt: skip
# KUKA publishes no acceleration; the Sunrise application takes this one for the largest (Lbr14.java).
_LBR_ACCELERATION_RAD_S2 = 15.0


def lbr(
    name: str,
    *,
    offsets_m: tuple[float, float, float, float],
    limits_deg: tuple[float, ...],
    speeds_deg_s: tuple[float, ...],
    payload_kg: float,
) -> ArmModel:
    """Return the model of an LBR.

    Args:
        name: the arm's name as the controller gives it.
        offsets_m: the distances base to shoulder, shoulder to elbow, elbow to wrist, wrist to flange.
        limits_deg: (7,) range of each joint to each side.
        speeds_deg_s: (7,) largest speeds of the joints.
        payload_kg: the largest load on the flange.
    """
    base, upper, fore, hand = offsets_m
    return ArmModel(
        name=name,
        family="seven_axes",
        a_m=np.zeros(7),
        d_m=np.array([base, 0, upper, 0, fore, 0, hand]),
        alpha_rad=np.radians([-90.0, 90.0, 90.0, -90.0, -90.0, 90.0, 0.0]),
        limits_rad=np.radians(limits_deg),
        speeds_rad_s=np.radians(speeds_deg_s),
        acceleration_rad_s2=_LBR_ACCELERATION_RAD_S2,
        braking_rad_s2=_BRAKING_RAD_S2,
        links=(
            Link("base", 0, (0, 0, -_BASE_DEPTH_M), (0, 0, 0.16), 0.10),
            Link("shoulder", 0, (0, 0, 0.16), (0, 0, base), 0.09),
            Link("upper arm", 2, (0, 0, 0), (0, 0, upper), 0.085),
            Link("forearm", 4, (0, 0, 0), (0, 0, fore - 0.08), 0.075),  # what is beyond turns with the hand
            Link("hand", 6, (0, 0, 0), (0, 0, hand), 0.065),
        ),
        allowed=_LBR_ALLOWED,
        usual_rad=np.array([0.0, 0.5, 0.0, -1.4, 0.0, 1.2, -1.57]),
        payload_kg=payload_kg,
        # Its joints have no link lengths to get wrong, but springs: the torque sensors yield under load.
        tolerances=ArmTolerances(dh=(0.2e-3, 0.2e-3, float(np.radians(0.02)), float(np.radians(0.05)))),
    )


#: By the name of a row. Both have a reach of 820 mm and the same dimensions, axis ranges and speeds; one is made for
#: industry, the other for medical devices. Source: KUKA, specifications "LBR iiwa 7 R800, LBR iiwa 14 R820" and
#: "LBR Med".
KUKA: Mapping[str, ArmModel] = {
    row: lbr(
        name,
        offsets_m=(0.360, 0.420, 0.400, 0.126),
        limits_deg=(170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0),
        speeds_deg_s=(85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0),
        payload_kg=14.0,
    )
    for row, name in {"lbr_iiwa_14": "LBR iiwa 14", "lbr_med_14": "LBR Med 14"}.items()
}
