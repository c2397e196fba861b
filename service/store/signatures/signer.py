"""Which data folder signs a site: of the folders that share one database, the one that the site's chain names.

The key and the log of signatures are files of one folder. A second folder that signed would have a log of its own,
and each would find the other's signatures missing. In SQLite the database is the folder's own, and nothing is named.
"""

from __future__ import annotations

import os
import secrets
import socket
from pathlib import Path

from pydantic import ValidationError
from sqlalchemy import Connection, select

from service.core.errors import IntegrityError, StoreError
from service.core.records.events import SignerNamed
from service.store.data_folder import file_mode, open_new
from service.store.database.database import is_postgres
from service.store.database.tables import event_index, events
from service.store.records import SITE, SignsElsewhereError

FILE = "signer"  # within the data folder: a random name of the folder, which no copy of its keys has
_NAMED = (
    select(events.c.payload)
    .join(event_index, (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq))
    .where(event_index.c.run_id == SITE, event_index.c.kind == "signer_named")
    .order_by(event_index.c.seq.desc())
    .limit(1)
)


def named_signer(connection: Connection) -> SignerNamed | None:
    """Return the folder that signs, as the site's chain names it; None for SQLite, or if none was named yet.

    Raises IntegrityError if its event was altered.
    """
    payload = connection.execute(_NAMED).scalar() if is_postgres(connection) else None
    try:
        return None if payload is None else SignerNamed.model_validate_json(payload)
    except ValidationError as error:
        raise IntegrityError(
            "the event that names the folder that signs cannot be read",
            where=SITE,
            remedy="Run `orthocapture audit verify all`; nothing is signed",
        ) from error


def signer_elsewhere(connection: Connection, data_dir: Path) -> SignerNamed | None:
    """Return the folder that signs if it is not this one."""
    named = named_signer(connection)
    return None if named is None or named.signer == _name_of(data_dir) else named


def in_another_place(named: SignerNamed, data_dir: Path) -> bool:
    """Return whether a folder on another host, or another folder of this one, was named as the signer."""
    return (named.host, named.folder) != (socket.gethostname(), str(data_dir.resolve()))


def require_signer(connection: Connection, data_dir: Path) -> None:
    """Raise SignsElsewhereError if another folder signs this site."""
    named = signer_elsewhere(connection, data_dir)
    if named is not None:
        raise SignsElsewhereError(
            f"another data folder signs this site: {named.folder} on {named.host}",
            where=str(data_dir),
            remedy="Start runs there; a worker and a further server need no key. To let this folder sign instead, "
            "move keys/ and signatures.jsonl here, then: orthocapture audit sign-here",
        )


def this_signer(data_dir: Path, key_id: str) -> SignerNamed:
    """Return the event that names this folder as the signer; its random name is written if it has none.

    Raises StoreError.
    """
    name = _name_of(data_dir) or _write_name(data_dir)
    return SignerNamed(signer=name, key_id=key_id, host=socket.gethostname(), folder=str(data_dir.resolve()))


def _name_of(data_dir: Path) -> str:
    try:
        return (data_dir / FILE).read_text("ascii").strip()
    except (FileNotFoundError, UnicodeDecodeError):
        return ""
    except OSError as error:
        raise _unreadable(data_dir, error) from error


def _write_name(data_dir: Path) -> str:
    name = secrets.token_hex(16)
    try:
        with os.fdopen(open_new(data_dir / FILE, os.O_WRONLY, file_mode(data_dir)), "w", encoding="ascii") as file:
            file.write(name)
    except OSError as error:
        raise _unreadable(data_dir, error) from error
    return _name_of(data_dir)


def _unreadable(data_dir: Path, error: OSError) -> StoreError:
    return StoreError(
        f"the name by which this folder signs cannot be used: {error.strerror or error}",
        where=str(data_dir / FILE),
        remedy="Look at the permissions of the data folder",
    )
