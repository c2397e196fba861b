"""The arms of Universal Robots, a row each, and what they have in common: DH layout, links, and what may touch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.core.arms.model import ArmModel, ArmTolerances, Link

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
ARMS: Mapping[str, ArmModel] = {
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
