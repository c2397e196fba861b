"""Keeps what libraries raise while they read a stranger's file from going any further."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from drivers.errors import UnreadableFileError
from service.core.errors import OrthocaptureError


@contextmanager
def reading(path: Path, what: str, remedy: str) -> Generator[None]:
    """Whatever is raised within becomes an error that names the file.

    A damaged file makes a library raise anything, the error of another library that it would like to have included.

    Args:
        path: the file that is read.
        what: the thing that is read, such as "a PLY mesh".
        remedy: the advice for people.

    Raises:
        UnreadableFileError: it replaces the library's error.
        OrthocaptureError: one that was raised within.
        OSError: one that was raised within, if the system cannot open or read the file.
    """
    try:
        yield
    except OrthocaptureError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        words = str(error) if isinstance(error, ValueError) and str(error) else f"{type(error).__name__}: {error}"
        raise UnreadableFileError(
            f"the file cannot be parsed as {what} ({words})", where=str(path), remedy=remedy
        ) from error


def check_name(path: Path) -> None:
    """Check that the name of a file can be written down: on the disk it may be any bytes.

    Raises UnreadableFileError.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UnreadableFileError(
            "the name of the file is not UTF-8 text", where=str(path), remedy="Rename the file, or its folder"
        ) from None
