"""Features triangulated with the given poses: the workspace that COLMAP's and OpenMVS's dense steps begin with.

Run: python -m service.benchmark.programs.triangulated DATA DENSE
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import pycolmap

_USAGE = "usage: python -m service.benchmark.programs.triangulated DATA DENSE"


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


def main() -> None:
    """Make the workspace that the command line names."""
    if len(sys.argv) != 3:
        raise SystemExit(_USAGE)
    sys.stdout.write(triangulate(Path(sys.argv[1]), Path(sys.argv[2])).summary() + "\n")


if __name__ == "__main__":
    main()
