"""The KUKA LBR iiwa 14 R820."""

from __future__ import annotations

from service.core.arms.lbr import lbr

# Source: KUKA, specifications "LBR iiwa 7 R800, LBR iiwa 14 R820" and "LBR Med": dimensions, axis ranges and speeds.
ARM = lbr(
    "LBR iiwa 14",
    offsets_m=(0.360, 0.420, 0.400, 0.126),
    limits_deg=(170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0),
    speeds_deg_s=(85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0),
    payload_kg=14.0,
)
