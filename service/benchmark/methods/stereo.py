"""Our own dense stereo, which needs no GPU: semi-global matching of rectified pairs, fused in a distance field."""

from __future__ import annotations

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at

MESH = "mesh.ply"


def commands(place: Workplace) -> tuple[Command, ...]:
    """A process of its own, so that its time and memory are measured as those of the others."""
    return ((place.python, "-m", "service.benchmark.programs.stereo", str(place.data), str(place.work / MESH)),)


KIND = Method("stereo", "Stereo (CPU)", "nothing else", "colmap-pinhole", commands, at(MESH))
