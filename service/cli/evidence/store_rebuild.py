"""`orthocapture store rebuild`: make the database again from its journal, or the journal from the database."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import DEFAULT_DATA, DataOption, JsonOption, console, print_json, reporting_errors
from service.cli.run.person import OperatorOption, PasswordOption, acting_person
from service.core.text.words import counted
from service.store.journal.rebuild import RebuildReport, rebuild
from service.store.store import Store


def rebuild_command(
    data: DataOption = DEFAULT_DATA,
    journal: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A copy of the journal kept elsewhere, to make the database from it.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Restore a database that was overwritten, cut or lost from its journal; or the journal from the database.

    Stop every process of the data folder first. The old files are kept beside the new ones, and the record says what
    was done. The exit status is 1 if anything could not be restored.
    """

    def actor(folder: Path) -> str:
        with Store.open(folder, create=False) as store:
            return acting_person(store, operator, password_stdin=password_stdin).name

    with reporting_errors(json):
        made = rebuild(data, actor=actor, journal=journal)
    if json:
        print_json(asdict(made))
    else:
        _print(made)
    if made.lost:
        raise typer.Exit(1)


def _print(made: RebuildReport) -> None:
    if not made.made:
        console.print("Database and journal agree: there is nothing to rebuild.")
        return
    console.print(f"Found: {made.why}.")
    console.print(
        f"The {made.made} was made again: {counted(made.events, 'event')}, {made.restored_events} of them restored."
    )
    for name in made.kept:
        console.print(f"  kept: {name}")
    for line in made.lost:
        console.tell("  ", ("not restored:", "red"), f" {line}")
    if made.unsigned:
        console.tell("  ", ("The record of this is not signed:", "yellow"), f" {made.unsigned}")
    console.print("  Run: orthocapture audit verify all")
