"""The UR5."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR5",
    a_m=(-0.425, -0.39225),
    d_m=(0.089159, 0.10915, 0.09465, 0.0823),
    speeds_deg_s=(180.0, 180.0, 180.0, 180.0, 180.0, 180.0),
    payload_kg=5.0,
)
