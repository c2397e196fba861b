"""Signing with Ed25519: who signs a site, checkpoints over the ends of sound chains, the key and its replacement."""

from __future__ import annotations

import base64
import os
import secrets
import socket
from dataclasses import dataclass, replace
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pydantic import ValidationError
from sqlalchemy import Connection, bindparam, select

from service.core.errors import IntegrityError, StoreError
from service.core.records.events import KeyChanged, Payload, RunSigned, SignaturesWrittenAgain, SignerNamed
from service.store.data_folder import file_mode, open_new
from service.store.database.database import is_postgres
from service.store.database.tables import event_index, events, runs
from service.store.durable_effects import utc_text
from service.store.events import ROOT, read_head, to_event
from service.store.records import SITE, Checkpoint, SigningKeyError, SignsElsewhereError, UnknownRunError
from service.store.signatures.checkpoints import (
    KeyFolder,
    artefacts_digest,
    insert_checkpoint,
    key_fingerprint,
    last_checkpoint,
    public_bytes,
    read_checkpoints,
    read_key_changes,
    signed_by,
    statement,
)
from service.store.signatures.log import SeenSignatures
from service.store.store import Store
from service.store.verification.chain_checks import Fault, chain_fault

# Which data folder signs a site: of the folders that share one database, the one that the site's chain names.
#
# The key and the log of signatures are files of one folder. A second folder that signed would have a log of its
# own, and each would find the other's signatures missing. In SQLite the database is the folder's own, and nothing
# is named.


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


# Put together once: every signature asks them several times.
_ONE = select(events).where(events.c.run_id == bindparam("run"), events.c.seq == bindparam("last"))
_AFTER = (
    select(events).where(events.c.run_id == bindparam("run"), events.c.seq > bindparam("last")).order_by(events.c.seq)
)


def require_sound(store: Store, connection: Connection, run_id: str) -> None:
    """Raise IntegrityError unless the chain, its earlier signatures and the log of signatures agree.

    Events that this process has verified before are not read again; only the last of them must still be there.

    Args:
        store: remembers how far each chain was verified, and what its last look at the signatures found.
        connection: a connection within a transaction.
        run_id: the chain's run, or SITE.
    """
    found = _chain(store, connection, run_id)
    fault = found if isinstance(found, Fault) else store.seen_signatures.fault(run_id)
    if fault is None and not isinstance(found, Fault):
        store.sound_until[run_id] = found
        return
    store.seen_signatures.forget()  # it may be put right
    raise IntegrityError(
        f"nothing is signed, because the record does not verify: {fault}",
        where=str(store.database_path),
        remedy="Run `orthocapture audit verify`; keep the data folder as it is",
    )


def _chain(store: Store, connection: Connection, run_id: str) -> Fault | tuple[int, str]:
    end = store.sound_until.get(run_id, (0, ROOT))
    place = {"run": run_id, "last": end[0]}
    if end[0]:
        before = connection.execute(_ONE, place).mappings().one_or_none()
        if before is None or before["sha256"] != end[1]:
            return Fault(run_id, end[0], "", "this event is not the one that was here before")
    return chain_fault(run_id, connection.execute(_AFTER, place).mappings(), end)


_ACTOR = "service"  # actor of the first key and of run_signed, which the software makes itself


@dataclass(frozen=True, slots=True)
class PublicKey:
    """A key in the history of the site's chain."""

    key_id: str
    public_key: bytes
    seq: int  # number of its KeyChanged event
    replaced_seq: int | None  # seq of its successor's KeyChanged; None for the key in use
    reason: str
    introduced: bool  # true if its predecessor signed its KeyChanged; never for the first key


def checkpoint(store: Store, run_id: str) -> Checkpoint:
    """Sign the end of a run's chain (or the site's, SITE) unless it is already signed; durable on return.

    The first signature in a data folder makes the key and records it in the site's chain. Before signing, the chain,
    its earlier signatures and the log of signatures are verified. The signature of a run is recorded in the site's
    chain, which is then signed too; the log gets every signature.

    Raises:
        UnknownRunError: there is no such run.
        IntegrityError: the chain does not verify, or does not end where the last append left it; nothing is signed.
        SigningKeyError: the private key is missing or cannot be used.
        StoreError: the log of signatures cannot be written.
    """
    log, seen = store.signature_log, store.seen_signatures
    require_signs_here(store)
    if run_id not in store.sound_until:
        _look(store, run_id)  # the first time takes long, and keeps nobody waiting
    with log.alone():
        signed = _look(store, run_id)
        if seen.missing:
            _write_missing_lines(store)
        elif signed is not None:
            return signed
        if not seen.there:
            log.begin()
        with store.database.writing() as connection:
            for chain in dict.fromkeys((run_id, SITE)):
                require_sound(store, connection, chain)
            key = _present_key(store, connection)
            signed = _signed_end(connection, run_id)
            if signed is None:
                signed = _sign(store, connection, run_id, key)
                if run_id != SITE:
                    entry = RunSigned(run=run_id, seq=signed.seq, sha256=signed.sha256)
                    store.append_site(connection, [entry], actor=_ACTOR)
            _sign(store, connection, SITE, key)
            made = seen.made_since(connection)
        log.add(seen.end, made, key)
    return signed


def checkpoint_here(store: Store, run_id: str) -> Checkpoint | None:
    """Do as `checkpoint` if this data folder signs; otherwise do nothing and return None: the one that does will."""
    try:
        return checkpoint(store, run_id)
    except SignsElsewhereError:
        return None


def require_signs_here(store: Store) -> None:
    """Raise SignsElsewhereError if another data folder of the site signs."""
    with store.database.reading() as connection:
        require_signer(connection, store.database_path.parent)


def sign_here(store: Store, *, actor: str) -> Checkpoint:
    """Let this data folder sign the site from now on; it must have the key in use and the whole log of signatures.

    Raises:
        IntegrityError: the site's chain or the log does not verify.
        SigningKeyError: the key is not here, or the log is not that of the last signature.
    """
    data_dir = store.database_path.parent
    log, seen = store.signature_log, store.seen_signatures
    with log.alone(), store.database.writing() as connection:
        if not is_postgres(connection):
            raise SigningKeyError("this folder's record is its own, and so is its signing key", where=str(data_dir))
        seen.look(connection)
        require_sound(store, connection, SITE)
        if not seen.key_id:
            raise SigningKeyError("nothing was signed yet: whoever signs first will sign", where=str(data_dir))
        KeyFolder(data_dir, store.files).load(seen.key_id)
        if seen.missing:
            raise SigningKeyError(
                f"the log of signatures here misses {len(seen.missing)} of them",
                where=str(log.path),
                remedy="End the processes of the folder that signs now, then copy its signatures.jsonl here",
            )
        store.append_site(connection, [this_signer(data_dir, seen.key_id)], actor=actor)
    return checkpoint(store, SITE)


def rotate_key(store: Store, *, reason: str, actor: str, lost: bool = False) -> PublicKey:
    """Replace the signing key. The old key finally signs the KeyChanged of the new one and is then destroyed.

    Args:
        store: the data folder.
        reason: the reason of the person, for the record.
        actor: the person who replaces it.
        lost: the old private key is gone. The new one is recorded without its predecessor's signature, and every
            later verification says so.

    Raises:
        SigningKeyError: the old key cannot be used and `lost` is false, or it can be used and `lost` is true.
    """
    folder = KeyFolder(store.database_path.parent, store.files)
    log, seen = store.signature_log, store.seen_signatures
    require_signs_here(store)
    with log.alone():
        with store.database.reading() as connection:
            seen.look(connection)
            require_sound(store, connection, SITE)
        if seen.missing and not lost:
            _write_missing_lines(store)
        if not seen.there:
            log.begin()
        with store.database.writing() as connection:
            require_sound(store, connection, SITE)
            if lost:
                _require_lost(connection, folder)
            old = None if lost else _present_key(store, connection)
            changes = read_key_changes(connection)
            if old is not None:
                _sign(store, connection, SITE, old)
            if seen.missing and lost:
                store.append_site(connection, [_written_again(seen)], actor=_ACTOR)
            new = folder.make()
            _record_key(store, connection, new, previous=changes[-1][1]["key_id"], reason=reason, actor=actor)
            _sign(store, connection, SITE, old or new)
            made = seen.made_since(connection)
        log.add(seen.end, [*seen.missing, *made], old or new)
    with store.database.writing() as connection:  # under the lock again, because another process may make a key
        folder.destroy_all_but(read_key_changes(connection)[-1][1]["key_id"])
    return public_keys(store)[-1]


def sign(store: Store, message: bytes) -> tuple[str, str]:
    """Return the fingerprint of the key in use, and its signature over a message in base64. Raises SigningKeyError.

    The message must begin with its purpose, so that the signature cannot be used for anything else.
    """
    with store.database.writing() as connection:
        key = _present_key(store, connection)
    return key_fingerprint(public_bytes(key)), base64.b64encode(key.sign(message)).decode()


def public_keys(store: Store) -> list[PublicKey]:
    """Return every key that has signed in this data folder, oldest first; the last one is in use."""
    with store.database.reading() as connection:
        changes = read_key_changes(connection)
        signed = {item.seq: item for item in read_checkpoints(connection, SITE)}
    keys: list[PublicKey] = []
    for index, (seq, payload) in enumerate(changes):
        before, vouched = (keys[-1] if keys else None), signed.get(seq)
        introduced = before is not None and vouched is not None and signed_by(vouched, before.public_key)
        after = changes[index + 1][0] if index + 1 < len(changes) else None
        raw = base64.b64decode(payload["public_key"])
        keys.append(PublicKey(payload["key_id"], raw, seq, after, payload["reason"], introduced))
    return keys


def _look(store: Store, run_id: str) -> Checkpoint | None:
    """Look at what is new and require that it is sound. Returns the signature of the chain's end, if it has one."""
    with store.database.reading() as connection:
        if run_id != SITE:
            _require_run(connection, run_id, store)
        store.seen_signatures.look(connection)
        require_sound(store, connection, run_id)
        return _signed_end(connection, run_id)


def _write_missing_lines(store: Store) -> None:
    """Write the lines that the log misses before anything new is signed; the site's chain says how many they are.

    An interrupted signature leaves lines missing, and so does somebody who cuts the log. Raises StoreError.
    """
    log, seen = store.signature_log, store.seen_signatures
    again = _written_again(seen)
    with store.database.writing() as connection:
        require_sound(store, connection, SITE)
        key = _present_key(store, connection)
        if _last_written_again(connection) != again:  # else that failed before, or was interrupted
            store.append_site(connection, [again], actor=_ACTOR)
    log.add(seen.end, seen.missing, key)
    with store.database.reading() as connection:
        seen.look(connection)


def _written_again(seen: SeenSignatures) -> SignaturesWrittenAgain:
    return SignaturesWrittenAgain(
        lines=len(seen.missing),
        runs=tuple(dict.fromkeys(item.run_id for item in seen.missing)),
        since_utc=seen.missing[0].at_utc,
        explained=seen.explained,
    )


def _last_written_again(connection: Connection) -> Payload | None:
    of_kind = select(event_index.c.seq).where(
        event_index.c.run_id == SITE, event_index.c.kind == "signatures_written_again"
    )
    seq = connection.execute(of_kind.order_by(event_index.c.seq.desc()).limit(1)).scalar()
    if seq is None:
        return None
    row = connection.execute(select(events).where(events.c.run_id == SITE, events.c.seq == seq)).one()
    return to_event(row).payload


def _require_run(connection: Connection, run_id: str, store: Store) -> None:
    if connection.execute(select(runs.c.run_id).where(runs.c.run_id == run_id)).first() is None:
        raise UnknownRunError(f"there is no run {run_id!r}", where=str(store.database_path))


def _require_lost(connection: Connection, folder: KeyFolder) -> None:
    changes = read_key_changes(connection)
    try:
        if changes:
            folder.load(changes[-1][1]["key_id"])
    except SigningKeyError:
        return
    raise SigningKeyError(
        "the signing key is not lost" if changes else "there is no signing key yet",
        remedy="Leave --lost out, so that the old key vouches for the new one",
    )


def _present_key(store: Store, connection: Connection) -> Ed25519PrivateKey:
    """Return the key in use; if there is none yet, one is made and recorded, and signs its own KeyChanged."""
    data_dir = store.database_path.parent
    folder = KeyFolder(data_dir, store.files)
    require_signer(connection, data_dir)  # another folder may have taken over since the look
    key_id = store.seen_signatures.key_in_use(connection)
    if key_id:
        key = folder.load(key_id)
        folder.destroy_all_but(key_id)  # keys left by a crash during a replacement
        if is_postgres(connection) and named_signer(connection) is None:  # an earlier version signed
            store.append_site(connection, [this_signer(data_dir, key_id)], actor=_ACTOR)
        return key
    # A crash before the commit leaves a key file without its event; use that key.
    left = folder.present()
    key = folder.load(left[0]) if left else folder.make()
    _record_key(store, connection, key, previous="", reason="first signature", actor=_ACTOR)
    if is_postgres(connection):
        named = this_signer(data_dir, key_fingerprint(public_bytes(key)))
        store.append_site(connection, [named], actor=_ACTOR)
    _sign(store, connection, SITE, key)
    return key


def _record_key(
    store: Store, connection: Connection, key: Ed25519PrivateKey, *, previous: str, reason: str, actor: str
) -> None:
    raw = public_bytes(key)
    change = KeyChanged(
        key_id=key_fingerprint(raw),
        public_key=base64.b64encode(raw).decode(),
        previous_key_id=previous,
        reason=reason,
    )
    store.append_site(connection, [change], actor=actor)


def _signed_end(connection: Connection, run_id: str) -> Checkpoint | None:
    """Return the checkpoint of a chain's last event; None if that event is not signed."""
    last = last_checkpoint(connection, run_id)
    return last if last is not None and (last.seq, last.sha256) == read_head(connection, run_id) else None


def _sign(store: Store, connection: Connection, run_id: str, key: Ed25519PrivateKey) -> Checkpoint:
    signed = _signed_end(connection, run_id)
    if signed is not None:
        return signed
    seq, sha256 = read_head(connection, run_id)
    site_seq, site_sha256 = read_head(connection, SITE)
    unsigned = Checkpoint(
        run_id=run_id,
        seq=seq,
        sha256=sha256,
        artefacts_sha256=artefacts_digest(connection, run_id),
        site_seq=site_seq,
        site_sha256=site_sha256,
        at_utc=utc_text(store.clock.utc_now()),
        key_id=key_fingerprint(public_bytes(key)),
        signature="",
    )
    checkpoint = replace(unsigned, signature=base64.b64encode(key.sign(statement(unsigned))).decode())
    insert_checkpoint(connection, checkpoint)
    return checkpoint
