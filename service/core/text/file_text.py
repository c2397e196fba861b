"""Read whole text files; errors name the file and say what to do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from service.core.delimited_text import decoded, read_table
from service.core.errors import DataError


def file_text(path: Path) -> str:
    """The text of a UTF-8 or UTF-16 file, with or without a mark. Raises DataError if it cannot be read."""
    return decoded(file_bytes(path), str(path))


def file_bytes(path: Path) -> bytes:
    """The content of a file. Raises DataError if it cannot be read."""
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: an impossible path, such as one with a null byte
        why = getattr(error, "strerror", None) or error
        raise DataError(f"the file cannot be read ({why})", where=str(path), remedy="Check the path") from error


def csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, cells) for each row of a file of delimited text that is not empty or a comment.

    The separator and the decimal mark are found by `service.core.delimited_text`; numbers come with a decimal point.
    Raises DataError with file:line.
    """
    for row in read_table(file_bytes(path), str(path)).rows:
        yield row.line, list(row.cells)
