"""COLMAP model folders through pycolmap, in a child process, because it takes over signal handlers and may crash."""

from __future__ import annotations

import importlib
import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from math import ceil
from pathlib import Path
from typing import Any, cast

import psutil

from service.core.errors import DataError
from service.core.geometry import Transform
from service.logs.terminal import show_own_words_only

_SPARE_BYTES = 1 << 30  # beyond what the library itself needs
_SPARE_S, _BYTES_PER_S = 3.0, 1e6  # text is read sixty times as fast
_PER_BYTE = 40  # memory per byte of a model's files: an observation takes 24 bytes in a file and about 60 in memory


def read_model(folder: Path) -> dict[str, Transform]:
    """T_world_camera (4, 4) by image name from the model in `folder`.

    Raises:
        DataError: the model cannot be read.
    """
    return cast("dict[str, Transform]", _in_child(_read, folder, str(folder)))


def _in_child(work: Callable[..., Any], folder: Path, *arguments: object) -> object:
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(1, mp_context=context, initializer=_bound, initargs=(str(folder),)) as pool:
            outcome = pool.submit(work, *arguments).result()
    except BrokenProcessPool:
        outcome = "pycolmap crashed on it, or took far longer than a sound model takes"
    except MemoryError:
        outcome = "it announces more than memory can hold"
    if isinstance(outcome, str):
        raise DataError(
            f"the COLMAP model cannot be read: {outcome}",
            where=str(folder),
            remedy="Check that cameras, images and points3D belong together and are complete",
        )
    return outcome


def _bound(folder: str) -> None:
    """Limit this process's memory and processor time to what an intact model of these files needs.

    Counts in a damaged file may request any amount; beyond the limits, the system ends the process.
    """
    show_own_words_only()
    importlib.import_module("pycolmap")
    mapped_bytes = psutil.Process().memory_info().vms
    files_bytes = sum(file.stat().st_size for file in Path(folder).iterdir() if file.is_file())
    limit = mapped_bytes + _SPARE_BYTES + _PER_BYTE * files_bytes
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))
    limit_s = ceil(time.process_time() + _SPARE_S + files_bytes / _BYTES_PER_S)
    _, most_s = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(
        resource.RLIMIT_CPU, (limit_s if most_s == resource.RLIM_INFINITY else min(limit_s, most_s), most_s)
    )


def _read(folder: str) -> dict[str, Transform] | str:
    colmap = importlib.import_module("pycolmap")
    convention = importlib.import_module("service.compute.poses.colmap.convention")
    colmap.logging.minloglevel = colmap.logging.FATAL.value
    try:
        model = colmap.Reconstruction(folder)
        images = sorted((model.image(k) for k in model.reg_image_ids()), key=lambda image: image.name)
        return {image.name: convention.from_colmap_pose(image.cam_from_world()) for image in images}
    except UnicodeDecodeError:
        return "the name of an image is not UTF-8"
    except (RuntimeError, ValueError, IndexError, OSError) as error:  # everything that pycolmap raises
        return (str(error).strip().splitlines() or [type(error).__name__])[-1]
