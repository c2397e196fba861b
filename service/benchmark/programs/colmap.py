"""COLMAP's steps on an exported data set with pycolmap: reading its views, triangulation, and dense reconstruction.

Run: python -m service.benchmark.programs.colmap triangulate DATA DENSE, which makes the workspace that COLMAP's and
OpenMVS's dense steps begin with, or patch_match DENSE FUSED MESH, for which pycolmap must be built with CUDA.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import pycolmap

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_grey
from service.compute.poses.pose_files import HALF_PIXEL
from service.compute.stereo.matching import StereoView
from service.core.errors import ComputeError, DataError, OrthocaptureError
from service.core.geometry import transform


def views_of(data: Path) -> tuple[StereoView, ...]:
    """Return the images of an export in the format `colmap-pinhole`.

    Raises:
        DataError: a camera is not a pinhole, or an image cannot be read.
    """
    model = pycolmap.Reconstruction(str(data / "sparse" / "0"))
    views: list[StereoView] = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        if camera.model.name != "PINHOLE":
            raise DataError("a camera has distortion", where=image.name, remedy="Export as colmap-pinhole")
        fx, fy, cx, cy = (float(x) for x in camera.params)
        pinhole = CameraModel(camera.width, camera.height, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)
        pose = image.cam_from_world().inverse().matrix()
        views.append(StereoView(read_grey(data / "images" / image.name), pinhole, transform(pose[:, :3], pose[:, 3])))
    return tuple(views)


# Features triangulated with the given poses: the workspace that COLMAP's and OpenMVS's dense steps begin with.
#
# Run: python -m service.benchmark.programs.colmap DATA DENSE


def triangulate(data: Path, dense: Path) -> pycolmap.Reconstruction:
    """Extract, match and triangulate features of the exported images with pycolmap, poses and camera held.

    Args:
        data: an export in the format `colmap-pinhole`.
        dense: a new folder: `images/`, `sparse/` and `stereo/` as `colmap image_undistorter` makes them.
    """
    given = pycolmap.Reconstruction(str(data / "sparse" / "0"))
    first = next(iter(given.cameras.values()))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = ", ".join(map(repr, first.params.tolist()))
    with tempfile.TemporaryDirectory(dir=dense.parent) as folder:
        database = Path(folder) / "database.db"
        mode = pycolmap.CameraMode.SINGLE if len(given.cameras) == 1 else pycolmap.CameraMode.PER_IMAGE
        # Images get their numbers in the order of their names, as in the export, before threads extract features.
        pycolmap.Database.open(database).close()
        pycolmap.import_images(database, data / "images", camera_mode=mode, options=reader)
        pycolmap.extract_features(database, data / "images", camera_mode=mode, reader_options=reader)
        pycolmap.match_exhaustive(database)
        model = pycolmap.triangulate_points(given, database, data / "images", Path(folder) / "model")
        pycolmap.undistort_images(dense, Path(folder) / "model", data / "images")
    return model


# COLMAP's PatchMatch depth maps, their fusion and a Poisson mesh with pycolmap, which must be built with CUDA.
#
# Run: python -m service.benchmark.programs.colmap DENSE FUSED MESH


_USAGE = "usage: python -m service.benchmark.programs.colmap triangulate DATA DENSE | patch_match DENSE FUSED MESH"


def reconstruct(dense: Path, fused: Path, mesh: Path, meshing: pycolmap.PoissonMeshingOptions | None = None) -> None:
    """Run the steps of the program `colmap` with its own default options.

    Args:
        dense: COLMAP's workspace, as `triangulate` makes it.
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
    """Make the workspace, or reconstruct the one, that the command line names."""
    match sys.argv[1:]:
        case ["triangulate", data, dense]:
            sys.stdout.write(triangulate(Path(data), Path(dense)).summary() + "\n")
        case ["patch_match", dense, fused, mesh]:
            try:
                reconstruct(Path(dense), Path(fused), Path(mesh))
            except OrthocaptureError as error:
                raise SystemExit(str(error)) from error
        case _:
            raise SystemExit(_USAGE)


if __name__ == "__main__":
    main()
