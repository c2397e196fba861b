"""Reads text files, JSON and delimited text from outside, as foreign programs write them; errors name the line."""

from __future__ import annotations

import codecs
import csv
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from service.core.errors import DataError

# Reads delimited text as foreign programs write it: any separator, decimal commas, UTF-8 or UTF-16.
#
# What one reading alone explains is read; what two explain is refused, and the message says which two.


_BYTE_ORDER_MARKS = (  # UTF-32 first: its mark begins with that of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_EXPONENT = r"(?:[eE][+-]?\d+)?"
_PLAIN = re.compile(rf"[+-]?(?:\d+\.?\d*|\.\d+){_EXPONENT}", re.ASCII)
_POINT = re.compile(rf"[+-]?\d*\.\d*{_EXPONENT}", re.ASCII)
_COMMA = re.compile(rf"[+-]?(?:\d+,\d*|,\d+){_EXPONENT}", re.ASCII)
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}", re.ASCII)  # 1,234: could be a thousand
_BOTH = re.compile(r"[+-]?\d+(?:\.\d{3})+,\d+|[+-]?\d+(?:,\d{3})+\.\d+|[+-]?\d+(?:,\d{3}){2,}", re.ASCII)
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)
_ENDS_IN_NUMBER = re.compile(r"\d[.,;\s]*$")
_SEPARATOR_LINE = re.compile(r"sep=(.)", re.IGNORECASE)  # Excel writes it first
_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "spaces"}


@dataclass(frozen=True, slots=True)
class TextDialect:
    """The way in which a file writes its fields.

    Attributes:
        separator: the character between fields: "," or ";" or a tab, or " " for any run of spaces and tabs.
        decimal: the decimal mark: "." or ",".
    """

    separator: str
    decimal: str


@dataclass(frozen=True, slots=True)
class TextRow:
    """One line of a table: its number from 1, and its fields without blanks around them."""

    line: int
    cells: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TextTable:
    """The fields of a file.

    Attributes:
        rows: the rows without empty lines and comments; numbers have a decimal point, however the file writes them.
        comments: lines that begin with #, without it; programs write their header so.
        dialect: the file's way of writing fields.
    """

    rows: tuple[TextRow, ...]
    comments: tuple[str, ...]
    dialect: TextDialect


def decoded(data: bytes, where: str, *, numbers_only: bool = False) -> str:
    """Return the text of UTF-8 or UTF-16, with or without a byte order mark.

    Args:
        data: the whole file.
        where: names the file in errors.
        numbers_only: other encodings are read too, since digits are the same in all of them: for files whose words
            do not matter.

    Raises:
        DataError: another encoding; the message names the line.
    """
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if data.startswith(mark)), None) or _unmarked(data)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        if numbers_only and encoding == "utf-8":
            return data.decode("latin-1")
        line = data.count(b"\n", 0, error.start) + 1
        raise DataError(
            "the file is not UTF-8 text"
            if encoding.startswith("utf-8")
            else f"the file is not whole {encoding} text",
            where=f"{where}:{line}",
            remedy="Save it as UTF-8",
        ) from None


def _unmarked(data: bytes) -> str:
    """UTF-16 without a mark has a zero byte beside every letter and digit."""
    sample = data[:4096]
    half = len(sample) // 2
    if half and sample[1::2].count(0) > 0.8 * half and not sample[::2].count(0):
        return "utf-16-le"
    if half and sample[::2].count(0) > 0.8 * half and not sample[1::2].count(0):
        return "utf-16-be"
    return "utf-8"


def is_number(cell: str) -> bool:
    """Return whether a field is a number with a decimal point or none."""
    return _PLAIN.fullmatch(cell) is not None


def read_table(data: bytes, where: str, *, numbers_only: bool = False) -> TextTable:
    """Return the fields of a file of delimited text.

    Raises:
        DataError: another encoding, a quote that is not closed, or a format that can be read in two ways; `where` has
            the line if it is one line's fault.
    """
    lines: list[tuple[int, str]] = []
    comments: list[str] = []
    given = ""
    text = decoded(data, where, numbers_only=numbers_only).replace("\N{MINUS SIGN}", "-")
    for number, line in enumerate(re.split(r"\r\n|\r|\n", text), start=1):
        stripped = line.strip(" \r\n\x1a\0")
        if not stripped.strip():
            continue
        if stripped.startswith("#"):
            comments.append(stripped.lstrip("#").strip())
        elif not lines and (named := _SEPARATOR_LINE.fullmatch(stripped)):
            given = named[1]
        else:
            lines.append((number, line.strip("\r\n\x1a\0")))
    dialect = dialect_of([line for _, line in lines], where, separator=given)
    split = splitter(dialect)
    rows: list[TextRow] = []
    for number, line in lines:
        try:
            rows.append(TextRow(number, split(line)))
        except csv.Error as error:
            raise DataError(
                f"not a valid CSV row ({error})", where=f"{where}:{number}", remedy="Correct the line"
            ) from error
    # Spreadsheets end each line with the separators of empty columns.
    empty = min((_empty_at_end(row.cells) for row in rows), default=0)
    return TextTable(
        tuple(TextRow(row.line, row.cells[: len(row.cells) - empty]) for row in rows if any(row.cells)),
        tuple(comments),
        dialect,
    )


def _empty_at_end(cells: Sequence[str]) -> int:
    filled = next((k for k, cell in enumerate(reversed(cells)) if cell), len(cells))
    return filled if any(cells) else len(cells)


def splitter(dialect: TextDialect) -> Callable[[str], tuple[str, ...]]:
    """Return what splits a line into its fields and gives their numbers a decimal point. It raises csv.Error."""

    def split(line: str) -> tuple[str, ...]:
        cells = [cell.strip() for cell in _cells(line, dialect.separator)]
        if dialect.decimal == ",":
            cells = [cell.replace(",", ".") if _COMMA.fullmatch(cell) else cell for cell in cells]
        return tuple(cells)

    return split


def _cells(line: str, separator: str) -> list[str]:
    if separator == " " and '"' not in line:
        return line.split()
    if separator == " ":
        return next(csv.reader([line.replace("\t", " ").strip()], delimiter=" ", skipinitialspace=True, strict=True))
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True), [])


def dialect_of(lines: Sequence[str], where: str, *, separator: str = "") -> TextDialect:
    """Return how these lines, or the first of many, write their fields. `separator`: the one that the file gives.

    Raises:
        DataError: decimal commas cannot be distinguished from separators or from marks of thousands.
    """
    found = separator or _separator(lines)
    rows = [[cell.strip() for cell in _lenient(line, found)] for line in lines]
    if found == ",":
        _refuse_doubled(rows, where)
    return TextDialect(found, _decimal(rows, found, where))


def _lenient(line: str, separator: str) -> list[str]:
    try:
        return _cells(line, separator)
    except csv.Error:  # reported with its line when the rows are read
        return []


def _separator(lines: Iterable[str]) -> str:
    """Return the separator that each line has; a comma before a semicolon or a space can be a decimal comma."""
    bare = [re.sub(r'"[^"]*"', '""', line) for line in lines]
    bare = [line for line in bare if _ENDS_IN_NUMBER.search(line)] or bare  # not the titles above a table
    for candidate in (";", "\t"):
        if bare and all(candidate in line.strip(" ") for line in bare):
            return candidate
    commas = [line for line in bare if "," in line]
    if not commas:
        return " " if bare and all(len(line.split()) > 1 for line in bare) else ","
    words = [word for line in bare for word in line.split()]
    spaced = all(len(line.split()) > 1 for line in bare)
    # "8,2028 -4,5805": each comma stands inside a number, and spaces are between the numbers.
    return " " if spaced and all("," not in word or _COMMA.fullmatch(word) for word in words) else ","


def _decimal(rows: Iterable[Sequence[str]], separator: str, where: str) -> str:
    cells = [cell for row in rows for cell in row]
    if mixed := next((cell for cell in cells if _BOTH.fullmatch(cell)), None):
        raise DataError(
            f"{mixed} has marks between its thousands", where=where, remedy="Write numbers without such marks"
        )
    commas = [cell for cell in cells if _COMMA.fullmatch(cell)]
    if not commas:
        return "."
    fields = f"the fields are separated by {_NAMES.get(separator, separator)}, and "
    if point := next((cell for cell in cells if _POINT.fullmatch(cell) and len(cell) > 1), None):
        raise DataError(
            f"{fields}numbers have both a decimal comma ({commas[0]}) and a decimal point ({point})",
            where=where,
            remedy="Write all numbers with a decimal point",
        )
    if all(_GROUPED.fullmatch(cell) for cell in commas) and any(_WHOLE.fullmatch(cell) for cell in cells):
        raise DataError(
            f"{fields}{commas[0]} can be a thousand or have a decimal comma",
            where=where,
            remedy="Write numbers with a decimal point and without marks between thousands",
        )
    return ","


def _refuse_doubled(rows: Sequence[Sequence[str]], where: str) -> None:
    """Raise if commas separate the fields and, by their count or format, also whole numbers from decimals."""
    numbers = [row for row in rows if row and _WHOLE.fullmatch(row[-1])]
    if not numbers or len({len(row) for row in numbers}) > 1:
        return
    if any(is_number(cell) and not _WHOLE.fullmatch(cell) for row in numbers for cell in row):
        return
    width = len(numbers[0])
    names = 0 if all(_WHOLE.fullmatch(row[0]) for row in numbers) else 1
    header = next((row for row in rows if row and not _WHOLE.fullmatch(row[-1])), None)
    decimals = [cell for row in numbers for cell in row[names + 1 :: 2]]
    pairs = (width - names) % 2 == 0 and width - names >= 4 and all(cell.isdigit() for cell in decimals)
    if header is not None:
        doubled = pairs and width - names == 2 * (len(header) - names)
    else:  # decimals are written with as many digits everywhere, or begin with a zero
        alike = len({len(cell) for cell in decimals}) == 1 and len(decimals[0]) > 1
        doubled = pairs and (alike or any(len(cell) > 1 and cell.startswith("0") for cell in decimals))
    if doubled:
        example = ",".join(numbers[0][names : names + 2])
        raise DataError(
            f"commas separate the fields, and {example} looks like one number with a decimal comma",
            where=where,
            remedy="Write numbers with a decimal point, or separate the fields by semicolons",
        )


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

    The separator and the decimal mark are found as in `read_table`; numbers come with a decimal point.
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
