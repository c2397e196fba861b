"""Artec Space Spider: meshes that Artec Studio exports after fusion."""

from drivers.meshes.mesh_file import MESH_SUFFIXES
from drivers.scan_profiles.profile import ScanProfile

PROFILE = ScanProfile(
    scanner="Artec Space Spider",
    software="Artec Studio",
    units=dict.fromkeys(MESH_SUFFIXES, "mm"),
    advice="In Artec Studio, set the export units to millimetres and export the fused model with File, Export meshes",
)
