"""COLMAP's PatchMatch depth maps, their fusion and a Poisson mesh with pycolmap, which must be built with CUDA.

Run: python -m service.benchmark.programs.patch_match DENSE FUSED MESH
"""

from __future__ import annotations

import sys
from pathlib import Path

import pycolmap

from service.core.errors import ComputeError, OrthocaptureError

_USAGE = "usage: python -m service.benchmark.programs.patch_match DENSE FUSED MESH"


def reconstruct(dense: Path, fused: Path, mesh: Path, meshing: pycolmap.PoissonMeshingOptions | None = None) -> None:
    """Run the steps of the program `colmap` with its own default options.

    Args:
        dense: COLMAP's workspace, as `triangulated` makes it.
        fused: PLY file for the fused points.
        mesh: PLY file for the mesh.
        meshing: options of the Poisson mesh; None for COLMAP's, which suit millions of points.

    Raises:
        ComputeError: the depth maps agree nowhere.
    """
    pycolmap.patch_match_stereo(dense)
    points = pycolmap.stereo_fusion(fused, dense, output_type="ply")
    if points.num_points3D() == 0:  # which the mesher would not survive
        raise ComputeError("the depth maps have no point in common", remedy="Use more images, at smaller angles")
    pycolmap.poisson_meshing(fused, mesh, meshing or pycolmap.PoissonMeshingOptions())


def main() -> None:
    """Reconstruct the workspace that the command line names."""
    if len(sys.argv) != 4:
        raise SystemExit(_USAGE)
    try:
        dense, fused, mesh = (Path(name) for name in sys.argv[1:])
        reconstruct(dense, fused, mesh)
    except OrthocaptureError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
