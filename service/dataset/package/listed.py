"""A file of an exported folder with its hash."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file.

    Attributes:
        path: relative to the folder, with `/`.
        sha256: of its content.
        size_bytes: of its content.
    """

    path: str
    sha256: str
    size_bytes: int
