"""The LBR arms of KUKA, a row each: three joints that meet in the shoulder, the elbow, three in the wrist."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.core.arms.model import ArmModel, ArmTolerances, Link

_ALLOWED = frozenset(
    {
        ("base", "shoulder"), ("base", "upper arm"), ("shoulder", "upper arm"), ("upper arm", "forearm"),
        ("forearm", "hand"), ("hand", "camera"),
        ("base", "table"), ("shoulder", "table"),
        ("base", "specimen"), ("base", "spheres"), ("base", "surroundings"),
    }
)  # fmt: skip
# KUKA publishes no acceleration; the Sunrise application takes this one for the largest (Lbr14.java).
_ACCELERATION_RAD_S2 = 15.0
_BRAKING_RAD_S2 = 4.0  # of a motion that was ended; assumed: measure it on the arm (docs/howto/your_hardware.md)
_BASE_DEPTH_M = 0.10  # pedestal top below the base frame


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
        acceleration_rad_s2=_ACCELERATION_RAD_S2,
        braking_rad_s2=_BRAKING_RAD_S2,
        links=(
            Link("base", 0, (0, 0, -_BASE_DEPTH_M), (0, 0, 0.16), 0.10),
            Link("shoulder", 0, (0, 0, 0.16), (0, 0, base), 0.09),
            Link("upper arm", 2, (0, 0, 0), (0, 0, upper), 0.085),
            Link("forearm", 4, (0, 0, 0), (0, 0, fore - 0.08), 0.075),  # what is beyond turns with the hand
            Link("hand", 6, (0, 0, 0), (0, 0, hand), 0.065),
        ),
        allowed=_ALLOWED,
        usual_rad=np.array([0.0, 0.5, 0.0, -1.4, 0.0, 1.2, -1.57]),
        payload_kg=payload_kg,
        # Its joints have no link lengths to get wrong, but springs: the torque sensors yield under load.
        tolerances=ArmTolerances(dh=(0.2e-3, 0.2e-3, float(np.radians(0.02)), float(np.radians(0.05)))),
    )


#: By the name of a row. Both have a reach of 820 mm and the same dimensions, axis ranges and speeds; one is made for
#: industry, the other for medical devices. Source: KUKA, specifications "LBR iiwa 7 R800, LBR iiwa 14 R820" and
#: "LBR Med".
ARMS: Mapping[str, ArmModel] = {
    row: lbr(
        name,
        offsets_m=(0.360, 0.420, 0.400, 0.126),
        limits_deg=(170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0),
        speeds_deg_s=(85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0),
        payload_kg=14.0,
    )
    for row, name in {"lbr_iiwa_14": "LBR iiwa 14", "lbr_med_14": "LBR Med 14"}.items()
}
