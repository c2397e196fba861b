"""SuGaR: Gaussians aligned with the surface, and a mesh of them."""

from __future__ import annotations

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import newest

ITERATIONS = 7000


def commands(place: Workplace) -> tuple[Command, ...]:
    """3D Gaussian splatting first, then SuGaR on its result with all images (its default keeps every eighth)."""
    data, first, out = str(place.data), str(place.work / "gaussians"), str(place.work / "sugar")
    splatting = str(place.checkout / "gaussian_splatting" / "train.py")
    return (
        (place.python, splatting, "-s", data, "-m", first, "--iterations", str(ITERATIONS)),
        (
            place.python,
            str(place.checkout / "train.py"),
            *("-s", data, "-c", first, "-i", str(ITERATIONS), "-r", "density", "-o", out, "--eval", "False"),
        ),
    )


KIND = Method(
    "sugar",
    "SuGaR",
    "github.com/Anttwo/SuGaR, commit 25f7ba6 with its submodules built, and a CUDA GPU",
    "sugar",
    commands,
    newest("sugar/**/sugarfine_*.obj"),
    variable="ORTHOCAPTURE_SUGAR",
)
