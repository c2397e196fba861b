"""The UR16e."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR16e",
    a_m=(-0.4784, -0.36),
    d_m=(0.1807, 0.17415, 0.11985, 0.11655),
    speeds_deg_s=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    payload_kg=16.0,
)
