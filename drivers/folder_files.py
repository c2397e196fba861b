"""The files of a folder that people or other programs fill, in all its subfolders and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from drivers.errors import DeviceUnavailableError


def files_below(folder: Path, belongs: Callable[[Path], bool] = lambda _path: True) -> list[Path]:
    """The files in a folder and its subfolders, sorted, without links that lead out of it.

    Args:
        folder: an existing folder.
        belongs: whether a file is wanted, judged by its path alone.

    Raises:
        DeviceUnavailableError: the folder does not exist or cannot be read.
    """
    try:
        root = folder.resolve(strict=True)
        return [
            path
            for path in sorted(folder.rglob("*"))
            if belongs(path) and path.is_file() and path.resolve().is_relative_to(root)
        ]
    except OSError as error:
        raise DeviceUnavailableError(
            f"the folder cannot be read ({error.strerror})",
            where=str(folder),
            remedy="Check the path, and that the share is mounted",
        ) from error
