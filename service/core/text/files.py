"""Reads whole text files and JSON from outside; errors name the file, the line where there is one, and what to do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from service.core.errors import DataError
from service.core.text.delimited_text import decoded, read_table


def file_text(path: Path) -> str:
    """Return the text of a UTF-8 or UTF-16 file, with or without a mark. Raises DataError if it cannot be read."""
    return decoded(file_bytes(path), str(path))


def file_bytes(path: Path) -> bytes:
    """Return the content of a file. Raises DataError if it cannot be read."""
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: an impossible path, such as one with a null byte
        why = getattr(error, "strerror", None) or error
        raise DataError(f"the file cannot be read ({why})", where=str(path), remedy="Check the path") from error


def csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, cells) for each row of a file of delimited text that is not empty or a comment.

    The separator and the decimal mark are found by `service.core.text.delimited_text`; numbers come with a point.
    Raises DataError with file:line.
    """
    for row in read_table(file_bytes(path), str(path)).rows:
        yield row.line, list(row.cells)


MOST_DEEP = 100
_LONGEST_INTEGER = 18  # digits; a longer integer is read as a float, as most JSON readers do


def parse_json(text: str | bytes, *, name: str, remedy: str = "Correct the file") -> Any:
    """Read one JSON document. A number beyond the range of a float becomes infinite.

    Args:
        text: the document; bytes are decoded as UTF-8, with or without a byte order mark.
        name: the file's name in errors.
        remedy: the advice of an error to the reader.

    Raises:
        DataError: not UTF-8, not JSON, a name given twice in an object, or nested more than 100 deep.
    """
    try:
        read = text.decode("utf-8-sig") if isinstance(text, bytes) else text
        document = json.loads(read, object_pairs_hook=_once, parse_int=_integer)
    except UnicodeDecodeError:
        raise DataError("the file is not UTF-8 text", where=name, remedy=remedy) from None
    except json.JSONDecodeError as error:
        raise DataError(f"not valid JSON ({error.msg})", where=f"{name}:{error.lineno}", remedy=remedy) from None
    except _TwiceError as error:
        raise DataError(f"{error.args[0]!r} is given twice", where=name, remedy="Give each name once") from None
    except RecursionError:
        raise _too_deep(name) from None
    if _is_deep(document):
        raise _too_deep(name)
    return document


class _TwiceError(Exception):
    """A name is given twice in one object."""


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        seen: set[str] = set()
        raise _TwiceError(next(name for name, _ in pairs if name in seen or seen.add(name)))
    return data


def _integer(digits: str) -> int | float:
    return int(digits) if len(digits) <= _LONGEST_INTEGER else float(digits)


def _is_deep(document: object) -> bool:
    """Return whether a document is nested deeper than MOST_DEEP; iterative, because recursion could overflow."""
    level: list[object] = [document]
    for _ in range(MOST_DEEP + 1):
        level = [
            item
            for holder in level
            if isinstance(holder, dict | list)
            for item in (
                cast("dict[str, object]", holder).values()
                if isinstance(holder, dict)
                else cast("list[object]", holder)
            )
            if isinstance(item, dict | list)
        ]
        if not level:
            return False
    return True


def _too_deep(name: str) -> DataError:
    return DataError(f"nested more than {MOST_DEEP} deep", where=name, remedy="Look for brackets that are not closed")
