"""Dense stereo on an exported folder, as a separate program, so that it sees only images and poses.

Run: python -m service.benchmark.programs.stereo DATA MESH
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

from service.benchmark.programs.colmap import views_of
from service.compute.stereo.reconstruct import reconstruct
from service.compute.surfaces.surface import write_ply
from service.core.errors import OrthocaptureError
from service.machine.executors import computing_as_environment_says
from service.machine.resources import keep_freed_memory

_USAGE = "usage: python -m service.benchmark.programs.stereo DATA MESH"


def main() -> None:
    """Reconstruct the folder that the command line names."""
    if len(sys.argv) != 3:
        raise SystemExit(_USAGE)
    keep_freed_memory()
    cv2.setNumThreads(0)
    try:
        with computing_as_environment_says():
            found = reconstruct(views_of(Path(sys.argv[1])), _tell)
    except OrthocaptureError as error:
        raise SystemExit(str(error)) from error
    write_ply(Path(sys.argv[2]), found, 1.0, {}, ["metres, in the frame of the poses"])


def _tell(what: str, done: int, total: int) -> None:
    sys.stdout.write(f"{what} {done}/{total}\n" if total else f"{what}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
