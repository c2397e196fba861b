"""`orthocapture store`: maintain the folder that holds the evidence."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_json,
    reporting_errors,
)
from service.cli.evidence.store_backup import backup_command, restore_command
from service.cli.evidence.store_rebuild import rebuild_command
from service.cli.run.person import OperatorOption, PasswordOption, acting_person
from service.store.disk_space import USUAL_AGE_S, leftovers, remove_leftovers
from service.store.records import SITE
from service.store.signatures.signing import checkpoint
from service.store.store import Store

store_app = typer.Typer(name="store", help="Maintain the folder that holds the evidence.", no_args_is_help=True)


@store_app.callback()
def store() -> None:
    """Maintain the folder that holds the evidence."""


store_app.command("backup")(backup_command)
store_app.command("restore")(restore_command)
store_app.command("rebuild")(rebuild_command)


@store_app.command("gc")
def gc_command(
    data: DataOption = DEFAULT_DATA,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the files instead of listing them.")] = False,
    min_age_min: Annotated[
        float, typer.Option("--min-age-min", min=0, help="Keep files younger than this many minutes.")
    ] = USUAL_AGE_S / 60,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """List files left by crashes, to which no record refers. With --remove, remove them and record the removal.

    Recorded files are never touched, nor are files that a running process may still record.
    """
    with reporting_errors(json), Store.open(data, create=False) as opened:
        age_s = 60 * min_age_min
        gone = []
        if remove:
            who = acting_person(opened, operator, password_stdin=password_stdin)
            gone = remove_leftovers(opened, actor=who.name, min_age_s=age_s)
            if gone:
                checkpoint(opened, SITE)
        left = leftovers(opened, min_age_s=age_s)
    if json:
        print_json({"removed": [asdict(one) for one in gone], "left": [asdict(one) for one in left]})
        return
    for one in gone:
        console.print(f"removed: {one.path} ({one.size_bytes} bytes, written {one.written_utc})")
    for one in left:
        why = f"stays: {one.stays}" if one.stays else "may be removed"
        console.print(f"{one.path} ({one.size_bytes} bytes, written {one.written_utc}): {why}")
    removable = sum(not one.stays for one in left)
    if not gone and not left:
        console.print("Nothing is left over: a record refers to every file.")
    elif removable:
        console.print(f"{removable} of these can be removed: add --remove. No record refers to them.")
