"""Shared by all commands: consoles, options, exit statuses for errors, and a progress bar."""

from __future__ import annotations

import json as json_module
import re
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from typer.models import OptionInfo

from service.core.errors import ConfigurationError, OrthocaptureError, PersonNeededError

# The run waits for a decision of a person, and this command had nobody to ask: EX_TEMPFAIL of sysexits.h.
WAITS_FOR_A_PERSON = 75
PROGRESS_AFTER_S = 2.0
_NUMBER = re.compile(r"[-+−±]?\d[\d.,:+−± e%-]*|more|–|-|")

# Results go to stdout, everything else to stderr. The streams are looked up at each print, so redirection works.
console = Console(highlight=False, soft_wrap=True)
error_console = Console(stderr=True, highlight=False, soft_wrap=True)

data_option: OptionInfo = typer.Option(
    "--data",
    envvar="ORTHOCAPTURE_DATA",
    metavar="DIR",
    help="Folder that holds the recorded runs.",
    file_okay=False,
)
json_option: OptionInfo = typer.Option("--json", help="Print the result as JSON, for other programs.")

strict_option: OptionInfo = typer.Option(
    "--strict", help="Refuse unusable files (copies, other sizes, images without a pose) instead of skipping them."
)

DataOption = Annotated[Path, data_option]
JsonOption = Annotated[bool, json_option]
StrictOption = Annotated[bool, strict_option]
DEFAULT_DATA = Path("runs")


def print_table(table: Table, to: Console | None = None) -> None:
    """Print a table. Words wrap at the terminal's edge; numbers are never cut or broken.

    If the numbers alone are wider than the terminal, so is the table.
    """
    least = 1
    for column in table.columns:
        cells = [str(cell) for cell in column.cells]
        numeric = bool(cells) and all(not cell or _NUMBER.fullmatch(cell) for cell in cells)
        width = max((cell_len(cell) for cell in (*cells, str(column.header))), default=0) if numeric else 8
        column.no_wrap, column.overflow = numeric, "fold"
        column.min_width = width if numeric else min(8, max((cell_len(cell) for cell in cells), default=1))
        least += width + 3
    shown = to or console
    # Output to a file or another program is not wrapped, so that `grep` finds the text of a cell.
    whole = 0 if shown.is_terminal else Measurement.get(shown, shown.options.update(max_width=10_000), table).maximum
    if max(least, whole) > shown.width:
        table.width = max(least, whole)
    shown.print(table, soft_wrap=False, crop=False)


def print_json(value: Any) -> None:
    """Write one line of JSON to standard output, undecorated."""
    typer.echo(json_module.dumps(value, ensure_ascii=False, allow_nan=False))


def exit_status(error: OrthocaptureError) -> int:
    """With which status a command ends that met this error."""
    return WAITS_FOR_A_PERSON if isinstance(error, PersonNeededError) else 1


def error_record(error: OrthocaptureError) -> dict[str, str]:
    """An error as plain data, for JSON output."""
    return {"kind": type(error).__name__, "what": error.what, "where": error.where, "remedy": error.remedy}


def fail(error: OrthocaptureError, *, json: bool = False) -> typer.Exit:
    """Print an error and return the exit to raise, as in `raise fail(error)`, with `exit_status`."""
    status = exit_status(error)
    if json:
        print_json({"error": error_record(error), **({"exit_status": status} if status != 1 else {})})
    else:
        error_console.print(f"[bold red]Error:[/] {escape(error.what)}")
        if error.where:
            error_console.print(f"  where: {escape(error.where)}")
        if error.remedy:
            error_console.print(f"  what to do: {escape(error.remedy)}")
    return typer.Exit(status)


@contextmanager
def reporting_errors(json: bool = False) -> Generator[None]:
    """Wrap a command's body: an OrthocaptureError is printed and ends it with its status; others pass."""
    try:
        yield
    except OrthocaptureError as error:
        raise fail(error, json=json) from error


def tell_left_out(left_out: Mapping[str, str]) -> None:
    """Print the files that were left out, each with the reason."""
    for name, reason in left_out.items():
        error_console.print(f"[yellow]left out[/] {escape(name)}: {escape(reason)}")


def tell_doubt(file: Path, doubtful: float) -> None:
    """Print that polygons of a mesh have no inside to speak of, if there are any."""
    from drivers.meshes.polygons import in_doubt  # noqa: PLC0415 - NumPy, for those who read a mesh

    if words := in_doubt(int(doubtful)):
        error_console.print(f"[yellow]{escape(file.name)}[/]: {words}")


def require_writable(file: Path) -> None:
    """Raise ConfigurationError unless the file can be written; called before a long computation."""
    if file.is_dir():
        raise ConfigurationError("this is a folder, not a file", where=str(file), remedy="Name the file to write")
    if not file.parent.is_dir():
        raise ConfigurationError(
            "the folder of the file to write does not exist",
            where=str(file),
            remedy="Create the folder, or name another one",
        )
    there = file.exists()
    try:
        with file.open("ab"):
            pass
    except OSError as error:
        raise _unwritable(file, error) from error
    if not there:
        file.unlink()


def require_writable_folder(folder: Path) -> None:
    """Create the folder if need be, and raise ConfigurationError unless files can be written into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from error


def _unwritable(path: Path, error: OSError) -> ConfigurationError:
    return ConfigurationError(
        f"this cannot be written: {error.strerror}", where=str(path), remedy="Check the path and its permissions"
    )


@contextmanager
def progress_bar(*, quiet: bool = False) -> Generator[Callable[[str, int, int], None]]:
    """A progress bar on stderr, shown after PROGRESS_AFTER_S seconds. Yields report(what, done, total)."""
    from rich.progress import (  # noqa: PLC0415 - most commands have none
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    started = time.monotonic()
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=error_console,
        transient=True,
    )
    task = bar.add_task("", total=None)
    shown = False

    def report(what: str, done: int, total: int) -> None:
        nonlocal shown
        bar.update(task, description=what, completed=done, total=total)
        if not quiet and not shown and time.monotonic() - started > PROGRESS_AFTER_S:
            bar.start()
            shown = True

    try:
        yield report
    finally:
        if shown:
            bar.stop()
