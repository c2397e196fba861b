"""COLMAP's multi-view stereo in pycolmap's build for CUDA, for machines without the program `colmap`."""

from __future__ import annotations

import pycolmap

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at, triangulation

DENSE, FUSED, MESH = "dense", "fused.ply", "mesh.ply"


def commands(place: Workplace) -> tuple[Command, ...]:
    """The same steps as those of the program, as a process of their own."""
    dense, fused, mesh = (str(place.work / name) for name in (DENSE, FUSED, MESH))
    return (
        triangulation(place, place.work / DENSE),
        (place.python, "-m", "service.benchmark.programs.patch_match", dense, fused, mesh),
    )


def lacking() -> str:
    """The build that is locked for this program is made for all machines, and has no CUDA."""
    return "" if pycolmap.has_cuda else "pycolmap is built without CUDA"


KIND = Method(
    "pycolmap",
    "COLMAP (pycolmap)",
    "pycolmap-cuda12 from PyPI in the place of pycolmap, in this program's environment, and a CUDA GPU",
    "colmap-pinhole",
    commands,
    at(MESH),
    lacking=lacking,
)
