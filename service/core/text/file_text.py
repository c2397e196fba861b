"""Read whole text files; errors name the file and say what to do."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from service.core.errors import DataError


def file_text(path: Path) -> str:
    """The text of a UTF-8 file, with or without a byte order mark. Raises DataError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise DataError("the file is not UTF-8 text", where=str(path), remedy="Save it as UTF-8") from None
    except (OSError, ValueError) as error:  # ValueError: an impossible path, such as one with a null byte
        why = getattr(error, "strerror", None) or error
        raise DataError(f"the file cannot be read ({why})", where=str(path), remedy="Check the path") from error


def csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, cells) for each row of a CSV file. Raises DataError with file:line."""
    rows = csv.reader(file_text(path).splitlines())
    while True:
        try:
            row = next(rows)
        except StopIteration:
            return
        except csv.Error as error:
            raise DataError(
                f"not a valid CSV row ({error})", where=f"{path}:{rows.line_num}", remedy="Correct the line"
            ) from error
        yield rows.line_num, row
