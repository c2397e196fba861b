"""The UR10."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR10",
    a_m=(-0.612, -0.5723),
    d_m=(0.1273, 0.163941, 0.1157, 0.0922),
    speeds_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    payload_kg=10.0,
)
