"""The UR5e."""

from __future__ import annotations

from service.core.arms.universal_robots.family import universal_robot

# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article); data sheet.
ARM = universal_robot(
    "UR5e",
    a_m=(-0.425, -0.3922),
    d_m=(0.1625, 0.1333, 0.0997, 0.0996),
    speeds_deg_s=(180.0, 180.0, 180.0, 180.0, 180.0, 180.0),
    payload_kg=5.0,
    elbow_deg=180.0,
)
