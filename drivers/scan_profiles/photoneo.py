"""Photoneo PhoXi and MotionCam: single views saved by PhoXi Control as PLY; points not measured are (0, 0, 0)."""

from drivers.scan_profiles.profile import ScanProfile

PROFILE = ScanProfile(
    scanner="Photoneo PhoXi 3D Scanner or MotionCam-3D",
    software="PhoXi Control",
    units={".ply": "mm"},
    advice="In PhoXi Control, save as PLY in millimetres, not as unorganized, in the coordinates of the sensor",
    # PhoXi in high and low resolution, MotionCam as a scanner and as a camera.
    views=((2064, 1544), (1032, 772), (1680, 1200), (1120, 800)),
)
