"""Gaussian splatting by gsplat from PyPI; its depth maps are fused as those of the stereo method are."""

from __future__ import annotations

import importlib
import importlib.util

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at

MESH = "mesh.ply"


def commands(place: Workplace) -> tuple[Command, ...]:
    """A process of its own, which alone loads torch."""
    return ((place.python, "-m", "service.benchmark.programs.gaussians", str(place.data), str(place.work / MESH)),)


def lacking() -> str:
    """Packages first: torch takes seconds to load."""
    lacks = [name for name in ("torch", "gsplat") if importlib.util.find_spec(name) is None]
    if lacks:
        return f"{', '.join(lacks)} not installed"
    return "" if importlib.import_module("torch").cuda.is_available() else "torch finds no CUDA GPU"


KIND = Method(
    "gsplat",
    "Gaussian splatting (gsplat)",
    "gsplat 1.5 and torch 2 with CUDA from PyPI in this program's environment, and a CUDA GPU",
    "sugar",
    commands,
    at(MESH),
    lacking=lacking,
)
