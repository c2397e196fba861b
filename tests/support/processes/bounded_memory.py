"""Computes one thing on surfaces under a hard limit of this process's memory: `python -m … NAME LIMIT_MB`.

Blocks are as much smaller than usual as the surfaces are, so that little is computed and the proportions are kept.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.compute.planning import coverage
from service.compute.surfaces import chamfer, fuse, isosurface, overlap
from service.compute.surfaces import surface as surfaces
from service.compute.surfaces.surface import Surface
from service.core.geometry import Array

SMALLER = 20  # times than usual


def wavy(n: int, side_m: float, z_m: float = 0.0) -> Surface:
    """A square of 2 n² faces that is not flat."""
    x, y = np.meshgrid(*[np.linspace(-0.5 * side_m, 0.5 * side_m, n + 1)] * 2, indexing="ij")
    i = np.arange((n + 1) ** 2, dtype=np.int32).reshape(n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    z = z_m + 0.002 * np.sin(80 * x) * np.cos(90 * y)
    return Surface(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), faces.astype(np.int64))


def compared(n: int) -> None:
    """Two surfaces of 800,000 samples."""
    side_m = 0.09 * n / 300
    chamfer.chamfer(wavy(n, side_m), wavy(n, side_m, 1e-3), chamfer.ChamferSettings(to_faces=False))


def fused(n: int) -> None:
    """A CT and a scan of 180,000 faces."""
    ct, scan = wavy(n, 0.1), wavy(n, 0.1, 2e-4)
    settings = fuse.FusionSettings(alignment_covariance=1e-9 * np.eye(6))
    fuse.fuse(ct, scan, np.array([0.0, 0.0, 1.0]), settings)


def covered(n: int) -> None:
    """A surface of 180,000 faces between four spheres."""
    ct = wavy(n, 0.3)
    spheres: Array = np.array([[0.1, 0.1, 0.03], [-0.1, 0.1, 0.03], [-0.1, -0.1, 0.03], [0.1, -0.1, 0.031]])
    x, y, z = ct.vertices_m.T
    coverage.seen = _everything  # embree, which casts the rays, dies of a limit that it does not need
    hill = np.stack([x, y, z + 0.03 * np.exp(-(x**2 + y**2) / 0.003)], axis=1)
    coverage.coverage_surface(hill, ct.faces.astype(np.int32), spheres, 0.015, coverage.CoverageLimits())


def _everything(surface: coverage.CoverageSurface, *_: object) -> NDArray[np.bool_]:
    return np.ones(len(surface.points_m), dtype=np.bool_)


def nearest(n: int) -> None:
    """The distances of a few points to 180,000 faces."""
    surfaces.TriangleTree(wavy(n, 0.1)).nearest(np.zeros((10, 3)), np.full(10, 0.01))


def extracted(n: int) -> None:
    """The surface of a volume with noise at the threshold, in slabs."""
    depth = max(4, n // 5)
    volume = np.random.default_rng(0).integers(-500, -440, (depth, n, n), dtype=np.int16)
    isosurface.surface(volume, 1e-3 * np.diag([1, 1, 1, 1e3]), -450, slab_voxels=depth * n * n // 5)


COMPUTATIONS: dict[str, Callable[[int], None]] = {
    "compared": compared,
    "fused": fused,
    "covered": covered,
    "nearest": nearest,
    "extracted": extracted,
}


def main() -> None:
    """Compute it once small, then in full under the limit; writes how many megabytes that took."""
    compute, limit_mb = COMPUTATIONS[sys.argv[1]], float(sys.argv[2])
    for module, name in (
        (surfaces, "FACES"), (chamfer, "_BLOCK"), (chamfer, "MOST_COMPARED"), (fuse, "_VERTICES"),
        (overlap, "_POINTS"), (overlap, "_FACES"), (fuse, "_FACES"), (surfaces, "_LEAVES"),
        (isosurface, "_FACES"),
    ):  # fmt: skip
        if hasattr(module, name):
            setattr(module, name, getattr(module, name) // SMALLER)
    compute(30)  # loads what is loaded at the first use, and starts the threads of the libraries
    before_mb = _now_mb("VmData")
    if limit_mb:
        bound = int((before_mb + limit_mb) * 1e6)
        resource.setrlimit(resource.RLIMIT_DATA, (bound, bound))
    resident_mb = _now_mb("VmRSS")
    compute(300)
    sys.stdout.write(f"{_now_mb('VmHWM') - resident_mb:.0f}\n")


def _now_mb(name: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{name}:")) * 1.024e-3


if __name__ == "__main__":
    main()
