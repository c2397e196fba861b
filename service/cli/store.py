"""`orthocapture store` and `accounts`: maintain the folder of the evidence, its object store and its accounts."""

from __future__ import annotations

import os
import signal
from dataclasses import asdict
from functools import partial
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
from service.cli.ending import ExitStatus
from service.cli.options import OperatorOption, PasswordOption, acting_name, acting_person
from service.core.errors import ConfigurationError
from service.core.units import gigabytes
from service.core.words import counted
from service.logs import file_log
from service.machine.resources import compute_in_background
from service.people.person import plain_name
from service.people.sessions import People
from service.store.backup import BackupOptions, BackupReport, back_up
from service.store.data_folder import SITE_FILE, kept_to
from service.store.database.postgres import prepare
from service.store.disk_space import USUAL_AGE_S, leftovers, remove_leftovers
from service.store.moving import MoveReport, copy_record, move_run
from service.store.objects.anchors import AnchorWriter, LockedObjects
from service.store.objects.opening import open_objects
from service.store.objects.s3 import S3Objects
from service.store.objects.spool import SpoolFile, Waiting, free_spool, read_waiting, spool_files, write_trouble
from service.store.objects.upload import Uploader, alone
from service.store.records import SITE
from service.store.restoring import RebuildReport, RestoreReport, rebuild, restore
from service.store.signatures.signing import checkpoint_here
from service.store.site import SiteFile, load_site
from service.store.store import Store

# --- `store upload` and `store gc --spool`: upload files to the site's object store, and free the spool -----------


def upload_command(
    data: DataOption = DEFAULT_DATA,
    follow: Annotated[bool, typer.Option("--follow", help="Go on with what is recorded later.")] = False,
    parent: Annotated[
        int, typer.Option("--parent", hidden=True, help="End when this process is not the parent.")
    ] = 0,
    json: JsonOption = False,
) -> None:
    """Upload every recorded file to the object store that site.yaml names, and record what it confirms.

    `orthocapture worker` does so by itself. The exit status is 1 if files still wait: the store is away or refuses.
    """
    stopped = False

    def on_terminate(_signal: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True

    def over() -> bool:
        return stopped or (parent != 0 and os.getppid() != parent)

    signal.signal(signal.SIGTERM, on_terminate)
    with reporting_errors(json), kept_to(data), Store.open(data, create=False) as store:
        site, objects = require_objects(data)
        uploader = Uploader(store, objects, _anchors(store, objects, site))
        if follow:
            compute_in_background()
            with file_log(data, "uploader"):
                uploader.follow(over)
            return
        with alone(data) as mine:
            if not mine:
                raise ConfigurationError(
                    "another process uploads the files of this data folder",
                    where=str(data),
                    remedy="It is a worker's: `orthocapture status` says what waits",
                )
            done = uploader.drain(over)
            write_trouble(data, None)
        waiting = _waiting(store, objects)
    if json:
        print_json({"confirmed": done, "waiting": asdict(waiting), "refused": uploader.refused})
    else:
        console.print(f"{counted(done, 'file')} confirmed by {objects.place}; {waiting.sentence}.")
        for sha256, why in uploader.refused.items():
            console.tell((f"not uploaded: {sha256}", "red"), f": {why}")
    if waiting.files:
        raise typer.Exit(ExitStatus.FAILED)


def require_objects(data: Path) -> tuple[SiteFile, S3Objects]:
    """Return a data folder's site and its object store. Raises ConfigurationError if it names none."""
    site = load_site(data)
    if site is None or site.object_store is None:
        raise ConfigurationError(
            "this data folder names no object store",
            where=str(data / SITE_FILE),
            remedy="Write one as docs/howto/site.md shows",
        )
    return site, open_objects(data, site.object_store)


def _anchors(store: Store, objects: S3Objects, site: SiteFile) -> AnchorWriter | None:
    days = None if site.object_store is None else site.object_store.lock_days
    return None if days is None else AnchorWriter(store, LockedObjects(objects), days)


def _waiting(store: Store, objects: S3Objects) -> Waiting:
    with store.database.reading() as connection:
        return read_waiting(connection, objects.place)


def gc_spool(store: Store, *, remove: bool, json: bool) -> None:
    """List the files of the spool that the object store holds and nobody needs here; with `remove`, free them."""
    site, objects = require_objects(store.database_path.parent)
    found = free_spool(store, objects, site.spool) if remove else spool_files(store, objects.place, site.spool)
    free = [file for file in found if not file.stays]
    if json:
        print_json(
            {"freed" if remove else "may_be_freed": _plain(free), "stay": _plain([o for o in found if o.stays])}
        )
        return
    reasons: dict[str, int] = {}
    for file in found:
        if file.stays:
            reasons[file.stays] = reasons.get(file.stays, 0) + 1
    size_gb = gigabytes(sum(file.size_bytes for file in free))
    done = "freed: the object store holds them" if remove else "can be freed: add --remove"
    console.print(f"{counted(len(free), 'file')} ({size_gb:.2f} GB) {done}")
    for why, count in sorted(reasons.items()):
        console.print(f"{counted(count, 'file')} stay: {why}")


def _plain(files: list[SpoolFile]) -> list[dict[str, Any]]:
    return [asdict(file) for file in files]


# --- `store`: back up, restore, rebuild, remove leftovers ---------------------------------------------------------


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
        raise typer.Exit(ExitStatus.FAILED)


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

    actor = partial(acting_name, operator=operator, permission="read", password_stdin=password_stdin)
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        require_writable_folder(destination)
        made = restore(backup, destination, name=state, actor=actor, progress=progress)
    if json:
        print_json(_restore_json(made))
    else:
        _print_restore(made)
    if not made.ok:
        raise typer.Exit(ExitStatus.FAILED)


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

    actor = partial(acting_name, operator=operator, permission="read", password_stdin=password_stdin)
    with reporting_errors(json):
        made = rebuild(data, actor=actor, journal=journal)
    if json:
        print_json(asdict(made))
    else:
        _print(made)
    if made.lost:
        raise typer.Exit(ExitStatus.FAILED)


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


store_app = typer.Typer(name="store", help="Maintain the folder that holds the evidence.", no_args_is_help=True)


@store_app.callback()
def store() -> None:
    """Maintain the folder that holds the evidence."""


store_app.command("backup")(backup_command)
store_app.command("restore")(restore_command)
store_app.command("rebuild")(rebuild_command)
store_app.command("upload")(upload_command)


@store_app.command("prepare")
def prepare_command(
    owner_url: Annotated[
        str, typer.Argument(metavar="URL", help="postgresql://OWNER@HOST/DATABASE, as the owner of the tables.")
    ],
    role: Annotated[str, typer.Option("--role", help="The role of the program, which may not change evidence.")],
) -> None:
    """Make the tables of a site in an empty PostgreSQL database, or upgrade those of an earlier version.

    The program's role gets the privileges that it needs; it must exist: CREATE ROLE orthocapture LOGIN. The owner is
    used for nothing else. Before an upgrade, end the programs of the site and back up. An interrupted upgrade changes
    nothing: repeat it.
    """
    with reporting_errors():
        done = prepare(owner_url, role)
    if done.before is None:
        console.print(f"The database is prepared for the role {role}. Write its address into a site.yaml:")
        console.print("  database: postgresql://ROLE@HOST/DATABASE", markup=False)
        return
    if done.before == done.revision:
        console.print(f"The database has this version's tables already (revision {done.revision}).")
    else:
        console.print(f"Upgraded from revision {done.before} to {done.revision}.")
        console.print("  Run: orthocapture audit verify all", markup=False)
    for line in done.granted:
        console.print(f"  granted to {role}: {line}", markup=False)


@store_app.command("copy")
def copy_command(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="Data folder to copy; it is only read.")],
    target: Annotated[
        Path, typer.Argument(metavar="TO", help="Data folder to copy to: new, or with nothing but a site.yaml.")
    ],
    run: Annotated[
        str,
        typer.Option("--run", help="Instead, move this run alone: it goes on in TO, which may have others."),
    ] = "",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Copy a whole record with its files, accounts and keys, from SQLite to PostgreSQL or back.

    End every process of the source first: what is recorded there afterwards is not in the copy. The exit status is 1
    if a file of the record was missing or altered. With --run, one run is moved: FROM keeps what was recorded and
    refuses to go on with it. After an interruption, repeat the command and it will continue.
    """

    actor = partial(acting_name, operator=operator, permission="read", password_stdin=password_stdin)
    if run:
        with reporting_errors(json), progress_bar(quiet=json) as progress:
            moved = move_run(source, target, run, actor=actor, progress=progress)
        _print_move(moved, json=json)
        return
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        made = copy_record(source, target, actor=actor, progress=progress)
    if json:
        print_json({**made.recorded.model_dump(mode="json"), "missing": list(made.missing)})
    else:
        done = made.recorded
        console.print(f"Copied: {counted(done.runs, 'run')}, {counted(done.events, 'event')}, {done.files} files.")
        console.print(f"  heads: {done.heads_sha256}")
        for line in made.missing:
            console.tell("  ", ("not copied:", "red"), f" {line}")
        console.print("  Run: orthocapture audit verify all --data TO", markup=False)
    if made.missing:
        raise typer.Exit(ExitStatus.FAILED)


def _print_move(made: MoveReport, *, json: bool) -> None:
    done = made.received
    if json:
        received = None if done is None else done.model_dump(mode="json")
        print_json({"run": made.run_id, "moved": made.moved.model_dump(mode="json"), "received": received})
        return
    said = "an earlier try had copied it" if done is None else f"{counted(done.events, 'event')}, {done.files} files"
    console.print(f"Moved: {made.run_id} ({said}).")
    console.print(f"  head: event {made.moved.seq}, {made.moved.sha256}")
    console.print("  It goes on in TO; FROM refuses to. Run: orthocapture audit verify all --data TO", markup=False)


@store_app.command("gc")
def gc_command(
    data: DataOption = DEFAULT_DATA,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the files instead of listing them.")] = False,
    min_age_min: Annotated[
        float, typer.Option("--min-age-min", min=0, help="Keep files younger than this many minutes.")
    ] = USUAL_AGE_S / 60,
    spool: Annotated[
        bool, typer.Option("--spool", help="Instead, free recorded files that the object store has confirmed.")
    ] = False,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """List files left by crashes, to which no record refers. With --remove, remove them and record the removal.

    Recorded files are never touched, nor are files that a running process may still record. With --spool, the same
    for recorded files of ended runs that the site's object store has confirmed and states at that moment.
    """
    with reporting_errors(json), Store.open(data, create=False) as opened:
        if spool:
            gc_spool(opened, remove=remove, json=json)
            return
        age_s = 60 * min_age_min
        gone = []
        if remove:
            who = acting_person(opened, operator, "read", password_stdin=password_stdin)
            gone = remove_leftovers(opened, actor=who.name, min_age_s=age_s)
            if gone:
                checkpoint_here(opened, SITE)
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


# --- `accounts`: what an administrator can do about accounts without a browser ------------------------------------

accounts_app = typer.Typer(name="accounts", help="Maintain the accounts of a site.", no_args_is_help=True)


@accounts_app.callback()
def accounts() -> None:
    """Maintain the accounts of a site."""


@accounts_app.command("end-wait")
def end_wait_command(
    account: Annotated[str, typer.Argument(help="The account for which wrong passwords were given.")],
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """End all waits after wrong passwords of an account, as its page does. Only an administrator may."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        who = acting_person(store, operator, "administer", password_stdin=password_stdin)
        name = plain_name(account)
        People(store).accounts.end_wait(who.name, name)
        checkpoint_here(store, SITE)
        if json:
            print_json({"account": name, "wait": "ended"})
        else:
            console.print(f"Nobody has to wait any more for wrong passwords of {name}", markup=False)
