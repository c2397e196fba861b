"""Shared by all commands: consoles, options, errors as they are shown, a progress bar, and the shipped protocols."""

from __future__ import annotations

import json as json_module
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.cells import cell_len
from rich.measure import Measurement
from rich.table import Table
from typer.models import OptionInfo

from service.cli.ending import ExitStatus, exit_status
from service.cli.terminal_output import Terminal, bar_of_shares
from service.core.errors import ConfigurationError, OrthocaptureError, ProtocolError
from service.core.words import shown, shown_json, shown_lines
from service.store.data_folder import data_folder

PROGRESS_AFTER_S = 2.0
_NUMBER = re.compile(r"[-+−±]?\d[\d.,:+−± e%-]*|more|–|-|")

# Results go to stdout, everything else to stderr. The streams are looked up at each print, so redirection works.
console = Terminal()
error_console = Terminal(stderr=True)


def _data_folder(named: Path | None) -> Path | None:
    """Return the folder that `--data` stands for: a site.yaml stands for its folder, another file is refused."""
    if named is None:
        return None
    folder = data_folder(named)
    if os.path.isfile(folder):
        raise typer.BadParameter(f"{named} is a file: name the data folder, or its site.yaml")
    return folder


data_option: OptionInfo = typer.Option(
    "--data",
    envvar="ORTHOCAPTURE_DATA",
    metavar="DIR",
    help="Folder that holds the recorded runs, or its site.yaml.",
    callback=_data_folder,
)
json_option: OptionInfo = typer.Option("--json", help="Print the result as JSON, for other programs.")

strict_option: OptionInfo = typer.Option(
    "--strict", help="Refuse unusable files (copies, other sizes, images without a pose) instead of skipping them."
)

RUN_HELP = "Name of the run, its first characters, or `latest`."

RunArgument = Annotated[str, typer.Argument(help=RUN_HELP)]
RunOption = Annotated[str, typer.Option("--run", help=RUN_HELP)]
DataOption = Annotated[Path, data_option]
JsonOption = Annotated[bool, json_option]
StrictOption = Annotated[bool, strict_option]
DEFAULT_DATA = Path("runs")


def print_table(table: Table, to: Terminal | None = None) -> None:
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
    shown_on = to or console
    # Output to a file or another program is not wrapped, so that `grep` finds the text of a cell.
    options = shown_on.options.update(max_width=10_000)
    whole = 0 if shown_on.is_terminal else Measurement.get(shown_on, options, table).maximum
    if max(least, whole) > shown_on.width:
        table.width = max(least, whole)
    shown_on.print(table, soft_wrap=False, crop=False)


def print_json(value: Any) -> None:
    """Write one line of JSON to standard output, undecorated."""
    sys.stdout.write(shown_json(json_module.dumps(value, ensure_ascii=False, allow_nan=False)) + "\n")
    sys.stdout.flush()


def print_document(text: str) -> None:
    """Write a document of lines to standard output, undecorated."""
    sys.stdout.write(shown_lines(text))
    sys.stdout.flush()


def error_record(error: OrthocaptureError) -> dict[str, str]:
    """Return an error as plain data, for JSON output."""
    return {"kind": type(error).__name__, "what": error.what, "where": error.where, "remedy": error.remedy}


def fail(error: OrthocaptureError, *, json: bool = False) -> typer.Exit:
    """Print an error and return the exit to raise, as in `raise fail(error)`, with `exit_status`."""
    status = exit_status(error)
    if json:
        special = {} if status is ExitStatus.FAILED else {"exit_status": status}
        print_json({"error": error_record(error), **special})
    else:
        error_console.tell(("Error:", "bold red"), f" {error.what}")
        if error.where:
            error_console.print(f"  where: {error.where}")
        if error.remedy:
            error_console.print(f"  what to do: {error.remedy}")
    return typer.Exit(status)


@contextmanager
def reporting_errors(json: bool = False) -> Generator[None]:
    """Wrap a command's body: an OrthocaptureError is printed and ends it with its status; others are bugs and pass.

    With `json` a bug is printed as JSON too, so that the program that reads it learns of it.
    """
    try:
        yield
    except OrthocaptureError as error:
        raise fail(error, json=json) from error
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except Exception as error:
        if not json:
            raise
        print_json({"error": _bug_record(error)})
        raise typer.Exit(ExitStatus.FAILED) from error


def _bug_record(error: Exception) -> dict[str, str | list[str]]:
    """Return a fault of this program as plain data, with what a developer needs to find it."""
    frames = traceback.extract_tb(error.__traceback__)
    return {
        "kind": type(error).__name__,
        "what": str(error) or "no message",
        "where": f"{Path(frames[-1].filename).name}:{frames[-1].lineno}",
        "remedy": "This is a fault of the program; report it with `trace`",
        "trace": [f"{Path(frame.filename).name}:{frame.lineno} {frame.name}" for frame in frames],
    }


def tell_left_out(left_out: Mapping[str, str]) -> None:
    """Print the files that were left out, each with the reason."""
    for name, reason in left_out.items():
        error_console.tell(("left out", "yellow"), f" {name}: {reason}")


def tell_doubt(file: Path, doubtful: float) -> None:
    """Print that polygons of a mesh have no inside to speak of, if there are any."""
    from drivers.meshes.polygons import in_doubt  # noqa: PLC0415 - NumPy, for those who read a mesh

    if words := in_doubt(int(doubtful)):
        error_console.tell((file.name, "yellow"), f": {words}")


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
    there = file.exists() or file.is_symlink()
    try:
        with file.open("ab"):
            pass
    except OSError as error:
        raise _unwritable(file, error) from error
    if not there:
        file.unlink()


def require_writable_folder(folder: Path) -> None:
    """Raise ConfigurationError unless files can be written into the folder, or it can be made where it is named.

    Nothing is made. A folder around it that does not exist is rather a slip of the keyboard than meant.
    """
    if folder.exists() and not folder.is_dir():
        raise ConfigurationError("this is a file, not a folder", where=str(folder), remedy="Name a folder")
    around = folder.absolute().parent
    if not folder.exists() and not around.is_dir():
        raise ConfigurationError(
            "the folder around the one to write does not exist",
            where=str(folder),
            remedy="Create it, or name another one",
        )
    try:
        with tempfile.TemporaryFile(dir=folder if folder.exists() else around):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from error


def write_whole(file: Path, content: str | bytes) -> None:
    """Write a file as a whole or not at all; what was there before stays until then. Raises ConfigurationError."""
    data = content.encode() if isinstance(content, str) else content
    target = file.resolve()
    try:
        if target.exists() and not target.is_file():  # such as /dev/stdout, which has no other name to write to first
            target.write_bytes(data)
            return
        part = target.with_name(f".{target.name}.{os.getpid()}.part")
        try:
            part.write_bytes(data)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(file, error) from error


def _unwritable(path: Path, error: OSError) -> ConfigurationError:
    return ConfigurationError(
        f"this cannot be written: {error.strerror}", where=str(path), remedy="Check the path and its permissions"
    )


@contextmanager
def progress_bar(*, quiet: bool = False) -> Generator[Callable[[str, int, int], None]]:
    """Show a progress bar on stderr after PROGRESS_AFTER_S seconds. Yields report(what, done, total)."""
    started = time.monotonic()
    bar = bar_of_shares(error_console)
    task = bar.add_task("", total=None)
    on_screen = False

    def report(what: str, done: int, total: int) -> None:
        nonlocal on_screen
        bar.update(task, description=shown(what), completed=done, total=total)
        if not quiet and not on_screen and time.monotonic() - started > PROGRESS_AFTER_S:
            bar.start()
            on_screen = True

    try:
        yield report
    finally:
        if on_screen:
            bar.stop()


_FOLDER = "protocols"
PROTOCOL_HELP = "The protocol file, or the name of a shipped one, such as exvivo_spine."


def shipped_protocols() -> Path:
    """Return the folder of the protocols that come with orthocapture."""
    return Path(str(files(_FOLDER)))


def protocol_file(named: Path) -> Path:
    """Return the protocol file of this path, or the shipped one of this name if there is no such file.

    `exvivo_spine`, `exvivo_spine.yaml` and `protocols/exvivo_spine.yaml` name the same one, wherever the command is
    given. Raises ProtocolError, which lists the names, if there is neither.
    """
    if named.is_file() or named.parent.as_posix() not in (".", _FOLDER):
        return named
    shipped = {path.name: path for path in sorted(shipped_protocols().glob("*.yaml"))}
    found = shipped.get(named.name) or shipped.get(f"{named.name}.yaml")
    if found is None:
        raise ProtocolError(
            "there is no such file, and no protocol of this name comes with orthocapture",
            where=str(named),
            remedy=f"Check the path, or name one of {', '.join(path.stem for path in shipped.values())}",
        )
    return found


def only_here(host: str) -> bool:
    """Return whether an address to listen on is reached from this machine alone."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
