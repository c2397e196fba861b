"""The UR3e."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR3e",
    a_m=(-0.24355, -0.2132),
    d_m=(0.15185, 0.13105, 0.08535, 0.0921),
    speeds_deg_s=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
    payload_kg=3.0,
)
