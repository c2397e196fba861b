"""Reads what a data set says of itself in Croissant, by the library of the format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mlcroissant


def read_croissant(folder: Path) -> mlcroissant.Dataset:
    """Read `croissant.json` of a folder. Raises an error of the library where it is not valid."""
    import mlcroissant  # noqa: PLC0415 - loads pandas, and every process of the tests collects every file

    return mlcroissant.Dataset(jsonld=folder / "croissant.json")
