"""What the folders of scanner and CT hold in a case."""

from __future__ import annotations

from pathlib import Path


def scan_folder(folder: Path) -> None:
    """An export of ten spheres."""
    raise NotImplementedError


def ct_folder(folder: Path) -> None:
    """A series of three spheres."""
    raise NotImplementedError
