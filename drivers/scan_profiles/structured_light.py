"""Structured light in general: meshes in millimetres, or E57 (in metres) with the views' rows and columns."""

from drivers.meshes.mesh_file import MESH_SUFFIXES
from drivers.scan_profiles.profile import ScanProfile

PROFILE = ScanProfile(
    scanner="structured-light scanner",
    software="its own program",
    units={**dict.fromkeys(MESH_SUFFIXES, "mm"), ".e57": "m"},
    advice="Export a triangle mesh in millimetres, or E57 as structured scans (with rows and columns)",
)
