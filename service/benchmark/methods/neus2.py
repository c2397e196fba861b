"""NeuS2: a signed distance field by volume rendering, and its surface by marching cubes."""

from __future__ import annotations

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at, from_unit_box

STEPS = 15_000
NAME = "orthocapture"
MESH = f"output/{NAME}/mesh/{STEPS}.obj"  # relative to the folder that it is run in


def commands(place: Workplace) -> tuple[Command, ...]:
    """Training and marching cubes in one call of its script, which saves the mesh in any case."""
    return (
        (
            place.python,
            str(place.checkout / "scripts" / "run.py"),
            *("--scene", str(place.data / "transform.json"), "--name", NAME),
            *("--network", "dtu.json", "--n_steps", str(STEPS)),
        ),
    )


KIND = Method(
    "neus2",
    "NeuS2",
    "github.com/19reborn/NeuS2, commit 61f9cbf with its Python module built, and a CUDA GPU",
    "neus2",
    commands,
    at(MESH),
    from_unit_box,
    variable="ORTHOCAPTURE_NEUS2",
)
