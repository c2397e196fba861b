"""The UR3."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR3",
    a_m=(-0.24365, -0.21325),
    d_m=(0.1519, 0.11235, 0.08535, 0.0819),
    speeds_deg_s=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
    payload_kg=3.0,
)
