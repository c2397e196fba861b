"""`orthocapture store backup` and `restore`: back up a data folder elsewhere, and restore it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable_folder,
)
from service.cli.run.person import OperatorOption, PasswordOption, acting_person
from service.core.text.words import counted
from service.core.units import gigabytes
from service.store.backup.backup import BackupOptions, BackupReport, back_up
from service.store.backup.restore import RestoreReport, restore
from service.store.store import Store


def backup_command(
    destination: Annotated[
        Path, typer.Argument(metavar="BACKUP", help="Folder of backups: new, empty, or with earlier backups.")
    ],
    data: DataOption = DEFAULT_DATA,
    with_keys: Annotated[
        bool, typer.Option("--with-keys", help="Copy the private signing key too; anybody who reads it can sign.")
    ] = False,
    read_all: Annotated[
        bool, typer.Option("--read-all", help="Read all files of earlier backups again, and repair damaged ones.")
    ] = False,
    keep: Annotated[int | None, typer.Option("--keep", help="Keep this many states; default: all.", min=1)] = None,
    json: JsonOption = False,
) -> None:
    """Back up the data folder, also during a run; after the first time only new files are copied.

    After an interruption, repeat the command and it will continue. The exit status is 1 if no backup was made, or if
    the copied data does not verify.
    """
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        require_writable_folder(destination)
        made = back_up(data, destination, BackupOptions(with_keys, read_all, keep), progress=progress)
    if json:
        print_json(_backup_json(made))
    else:
        _print_backup(made)
    if made.state.faults:
        raise typer.Exit(1)


def restore_command(
    backup: Annotated[Path, typer.Argument(metavar="BACKUP", help="The folder of backups.")],
    destination: Annotated[Path, typer.Argument(metavar="DIR", help="The new data folder: empty or not existing.")],
    state: Annotated[str, typer.Option("--state", help="The backup to restore; default: the newest.")] = "",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Restore a data folder as it was when the backup was made, and verify it.

    The name of an account in the backup needs the password that it had then. The exit status is 1 if anything is
    missing or does not verify.
    """

    def actor(folder: Path) -> str:
        with Store.open(folder, create=False) as store:
            return acting_person(store, operator, password_stdin=password_stdin).name

    with reporting_errors(json), progress_bar(quiet=json) as progress:
        require_writable_folder(destination)
        made = restore(backup, destination, name=state, actor=actor, progress=progress)
    if json:
        print_json(_restore_json(made))
    else:
        _print_restore(made)
    if not made.ok:
        raise typer.Exit(1)


def _backup_json(made: BackupReport) -> dict[str, Any]:
    return {
        "ok": not made.state.faults,
        "folder": str(made.folder),
        "name": made.name,
        "copied": made.copied,
        "copied_bytes": made.copied_bytes,
        "present": made.present,
        "state": made.state.model_dump(mode="json"),
    }


def _restore_json(made: RestoreReport) -> dict[str, Any]:
    return {
        "ok": made.ok,
        "folder": str(made.folder),
        "name": made.name,
        "lost": list(made.lost),
        "faults": [str(fault) for fault in made.audit.faults],
        "state": made.state.model_dump(mode="json"),
    }


def _print_backup(made: BackupReport) -> None:
    state = made.state
    console.print(
        f"Backup {made.name} is in {made.folder!s}: {counted(len(state.heads), 'chain')}, "
        f"{counted(state.artefacts, 'file')}, {gigabytes(state.artefact_bytes):.2f} GB."
    )
    console.print(
        f"  Copied this time and read again: {counted(made.copied, 'file')}, {gigabytes(made.copied_bytes):.2f} GB; "
        f"{made.present} were there."
    )
    if not state.with_keys:
        console.print(
            "  It does not hold the signing key: keep the folder keys/ elsewhere (see docs/howto/operating.md)."
        )
    if state.faults:
        console.tell(("What was copied does not verify.", "bold red"), f" First fault: {state.faults[0]}")
        console.print("  Older backups are kept. Run: orthocapture audit verify all")


def _print_restore(made: RestoreReport) -> None:
    state = made.state
    console.print(f"{made.folder!s} is as {state.data_folder} was at {state.at_utc}.")
    if not state.with_keys:
        console.print(
            "  The signing key was not in the backup: restore the folder keys/, or declare the key lost with"
        )
        console.print("  orthocapture audit rotate-key --lost --reason ...")
    for line in made.lost:
        console.tell("  ", (line, "red"))
    if made.ok:
        console.tell(("Verified:", "bold green"), " everything is as it was recorded.")
    elif made.audit.first_fault is not None:
        console.tell(("NOT verified.", "bold red"), f" First fault: {made.audit.first_fault}")
        if state.faults:
            console.print(f"  The data folder had a fault when it was copied: {state.faults[0]}")
