"""Zivid cameras: single views that Zivid Studio saves as PLY, one point for each pixel, not measured ones as NaN."""

from drivers.scan_profiles.profile import ScanProfile

PROFILE = ScanProfile(
    scanner="Zivid One+, Two, Two+ or 2+",
    software="Zivid Studio",
    units={".ply": "mm"},
    advice="In Zivid Studio, save as PLY, ordered, without a transformation",
    # One+, Two, 2+, and each of them subsampled by 2 and by 4.
    views=(
        *((1920, 1200), (960, 600), (480, 300)),
        *((1944, 1200), (972, 600), (486, 300)),
        *((2448, 2048), (1224, 1024), (612, 512)),
    ),
)
