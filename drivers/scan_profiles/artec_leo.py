"""Artec Leo: meshes that Artec Studio exports after fusion."""

from drivers.meshes.mesh_file import MESH_SUFFIXES
from drivers.scan_profiles.profile import ScanProfile

PROFILE = ScanProfile(
    scanner="Artec Leo",
    software="Artec Studio",
    units=dict.fromkeys(MESH_SUFFIXES, "mm"),
    advice="Copy the project from the Leo, set the export units to millimetres, and export the fused model",
)
