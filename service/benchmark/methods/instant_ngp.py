"""Instant-NGP: a radiance field, and the surface of its density by marching cubes."""

from __future__ import annotations

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at, from_unit_box

STEPS, RESOLUTION, THRESHOLD = 35_000, 512, 2.5
MESH = "mesh.ply"


def commands(place: Workplace) -> tuple[Command, ...]:
    """Training and marching cubes in one call of its script."""
    return (
        (
            place.python,
            str(place.checkout / "scripts" / "run.py"),
            *("--scene", str(place.data), "--n_steps", str(STEPS), "--save_mesh", str(place.work / MESH)),
            *("--marching_cubes_res", str(RESOLUTION), "--marching_cubes_density_thresh", str(THRESHOLD)),
        ),
    )


KIND = Method(
    "instant-ngp",
    "Instant-NGP",
    "github.com/NVlabs/instant-ngp, version 2.0 with its Python module built, and a CUDA GPU",
    "instant-ngp",
    commands,
    at(MESH),
    from_unit_box,
    variable="ORTHOCAPTURE_INSTANT_NGP",
)
