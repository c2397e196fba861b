"""COLMAP's multi-view stereo: PatchMatch depth maps, fused, and a Poisson mesh."""

from __future__ import annotations

import subprocess

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at, triangulation

DENSE, FUSED, MESH = "dense", "fused.ply", "mesh.ply"
_HELP_S = 120.0


def commands(place: Workplace) -> tuple[Command, ...]:
    """Features are triangulated with the given poses, as COLMAP's FAQ describes, since PatchMatch needs points."""
    dense = str(place.work / DENSE)
    workspace = ("--workspace_path", dense, "--workspace_format", "COLMAP")
    fused, mesh = str(place.work / FUSED), str(place.work / MESH)
    return (
        triangulation(place, place.work / DENSE),
        ("colmap", "patch_match_stereo", *workspace, "--PatchMatchStereo.geom_consistency", "true"),
        ("colmap", "stereo_fusion", *workspace, "--input_type", "geometric", "--output_path", fused),
        ("colmap", "poisson_mesher", "--input_path", fused, "--output_path", mesh),
    )


def lacking() -> str:
    """COLMAP's help says how it was built; PatchMatch needs CUDA, which Debian's package is built without."""
    try:
        told = subprocess.run(("colmap", "-h"), capture_output=True, text=True, timeout=_HELP_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"colmap -h does not answer: {error}"
    return "colmap is built without CUDA" if "without CUDA" in told.stdout + told.stderr else ""


KIND = Method(
    "colmap",
    "COLMAP",
    "COLMAP 3.8 or later, built with CUDA (colmap -h says so), and a CUDA GPU",
    "colmap-pinhole",
    commands,
    at(MESH),
    programs=("colmap",),
    lacking=lacking,
)
