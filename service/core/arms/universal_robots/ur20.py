"""The UR20."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR20",
    a_m=(-0.8620, -0.7287),
    d_m=(0.2363, 0.2010, 0.1593, 0.1543),
    speeds_deg_s=(120.0, 120.0, 150.0, 210.0, 210.0, 210.0),
    payload_kg=20.0,
)
