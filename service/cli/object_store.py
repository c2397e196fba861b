"""`orthocapture store upload` and `store gc --spool`: upload files to the site's object store, and free the spool."""

from __future__ import annotations

import os
import signal
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.common import DEFAULT_DATA, DataOption, JsonOption, console, print_json, reporting_errors
from service.cli.exit_status import ExitStatus
from service.core.errors import ConfigurationError
from service.core.units import gigabytes
from service.core.words import counted
from service.logs import file_log
from service.machine.resources import compute_in_background
from service.store.data_folder import SITE_FILE, kept_to
from service.store.objects.anchors import AnchorWriter, LockedObjects
from service.store.objects.opening import open_objects
from service.store.objects.s3 import S3Objects
from service.store.objects.spool import SpoolFile, Waiting, free_spool, read_waiting, spool_files, write_trouble
from service.store.objects.upload import Uploader, alone
from service.store.site import SiteFile, load_site
from service.store.store import Store


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
