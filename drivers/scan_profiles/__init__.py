"""What each scanner's software exports: a row for each, and the entry points of other packages."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Literal

from drivers.meshes.mesh_file import MESH_SUFFIXES
from drivers.scan_profiles.profile import ScanProfile
from service.core.loading import plug_ins

GROUP = "orthocapture.scan_profiles"
_MESHES: Mapping[str, Literal["mm"]] = dict.fromkeys(MESH_SUFFIXES, "mm")
PROFILES: Mapping[str, ScanProfile] = {
    # Artec Leo: meshes that Artec Studio exports after fusion.
    "artec_leo": ScanProfile(
        scanner="Artec Leo",
        software="Artec Studio",
        units=_MESHES,
        advice="Copy the project from the Leo, set the export units to millimetres, and export the fused model",
    ),
    # Artec Space Spider: meshes that Artec Studio exports after fusion.
    "artec_space_spider": ScanProfile(
        scanner="Artec Space Spider",
        software="Artec Studio",
        units=_MESHES,
        advice="In Artec Studio, set the export units to millimetres "
        "and export the fused model with File, Export meshes",
    ),
    # Photoneo PhoXi and MotionCam: single views saved by PhoXi Control as PLY; points not measured are (0, 0, 0).
    "photoneo": ScanProfile(
        scanner="Photoneo PhoXi 3D Scanner or MotionCam-3D",
        software="PhoXi Control",
        units={".ply": "mm"},
        advice="In PhoXi Control, save as PLY in millimetres, not as unorganized, in the coordinates of the sensor",
        # PhoXi in high and low resolution, MotionCam as a scanner and as a camera.
        views=((2064, 1544), (1032, 772), (1680, 1200), (1120, 800)),
    ),
    # Shining 3D (EinScan, FreeScan): meshes that EXScan and its relatives save.
    "shining3d": ScanProfile(
        scanner="Shining 3D EinScan or FreeScan",
        software="EXScan",
        units=_MESHES,
        advice="Mesh the points first, then save as STL, OBJ or PLY with a scale of 100 %; ASC has only points",
    ),
    # Structured light in general: meshes in millimetres, or E57 (in metres) with the views' rows and columns.
    "structured_light": ScanProfile(
        scanner="structured-light scanner",
        software="its own program",
        units={**_MESHES, ".e57": "m"},
        advice="Export a triangle mesh in millimetres, or E57 as structured scans (with rows and columns)",
    ),
    # Zivid cameras: single views that Zivid Studio saves as PLY, one point for each pixel, not measured ones as NaN.
    "zivid": ScanProfile(
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
    ),
}


@cache
def profile_names() -> tuple[str, ...]:
    """The names of the profiles, sorted: ours, and those that other packages install."""
    return tuple(sorted({*PROFILES, *(point.name for point in plug_ins(GROUP))}))


def profile_named(name: str) -> ScanProfile:
    """The profile of this name. Raises ValueError, which lists the known ones, if there is none."""
    if name in PROFILES:
        return PROFILES[name]
    for point in (point for point in plug_ins(GROUP) if point.name == name):
        profile = point.load()
        if isinstance(profile, ScanProfile):
            return profile
    raise ValueError(f"there is no scan profile {name!r}; installed are {', '.join(profile_names())}")
