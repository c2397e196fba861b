"""Shining 3D (EinScan, FreeScan): meshes that EXScan and its relatives save."""

from drivers.meshes.mesh_file import MESH_SUFFIXES
from drivers.scan_profiles.profile import ScanProfile

PROFILE = ScanProfile(
    scanner="Shining 3D EinScan or FreeScan",
    software="EXScan",
    units=dict.fromkeys(MESH_SUFFIXES, "mm"),
    advice="Mesh the points first, then save as STL, OBJ or PLY with a scale of 100 %; ASC has only points",
)
