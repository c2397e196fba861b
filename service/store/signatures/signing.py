"""Ed25519 checkpoints over the chains: the key of a data folder, signing the end of a chain, changing the key."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from sqlalchemy import Connection, select

from service.core.records.events import KeyChanged, RunSigned
from service.store.database.tables import runs
from service.store.durable_effects import utc_text
from service.store.errors import SigningKeyError, UnknownRunError
from service.store.events import read_head
from service.store.records import SITE, Checkpoint
from service.store.signatures.checkpoints import (
    artefacts_digest,
    insert_checkpoint,
    key_fingerprint,
    last_checkpoint,
    read_checkpoints,
    read_every_checkpoint,
    read_key_changes,
    signed_by,
    statement,
)
from service.store.signatures.keys import KeyFolder, public_bytes
from service.store.signatures.log import SignatureLog, unlogged
from service.store.store import Store
from service.store.verification.soundness import require_sound

_ACTOR = "service"  # the first key is made by the software itself, when it first signs


@dataclass(frozen=True, slots=True)
class PublicKey:
    """A key of the site's chain."""

    key_id: str
    public_key: bytes
    seq: int  # of its KeyChanged
    replaced_seq: int | None  # of its successor's; None: the present one
    reason: str
    introduced: bool  # by a signature of its predecessor; the first key never is


def checkpoint(store: Store, run_id: str) -> Checkpoint:
    """Sign the end of a run's chain (or the site's, SITE) unless it is signed already; durable on return.

    The first signature of a data folder makes the key and records it in the site's chain.

    What is signed is verified first: the chain, the earlier signatures, and what the log of signatures says of them.
    The signature of a run goes into the site's chain, which is signed too, and all of them into the log.

    Raises:
        UnknownRunError: there is no such run.
        IntegrityError: the chain does not verify, or does not end where it was left; nothing is signed.
        SigningKeyError: the private key is missing or cannot be used.
        StoreError: the log of signatures cannot be written.
    """
    log = _log_of(store)
    with store.database.writing() as connection:
        if run_id != SITE:
            _require_run(connection, run_id, store)
        lines = log.lines()
        require_sound(store, connection, run_id, lines)
        if lines is None:
            log.begin()
            lines = []
        every = read_every_checkpoint(connection)
        signed = _signed_end(connection, run_id)
        if signed is not None and not unlogged(every, lines):
            return signed
        key = _present_key(store, connection)
        if signed is None:
            signed = _sign(store, connection, run_id, key)
            if run_id != SITE:
                require_sound(store, connection, SITE, lines)
                entry = RunSigned(run=run_id, seq=signed.seq, sha256=signed.sha256)
                store.append_site(connection, [entry], actor=_ACTOR)
                _sign(store, connection, SITE, key)
            every = read_every_checkpoint(connection)  # also those whose lines a power cut or a full disk kept out
    log.add(every, key)
    return signed


def rotate_key(store: Store, *, reason: str, actor: str, lost: bool = False) -> PublicKey:
    """Replace the signing key. The old one signs the new one's KeyChanged as its last act, and is destroyed.

    Args:
        store: the data folder.
        reason: why, for the record.
        actor: who.
        lost: the old private key is gone: the new one is recorded without its predecessor's signature,
            which every later verification tells.

    Raises:
        SigningKeyError: the old key cannot be used and `lost` is not given; or it can, and `lost` is.
    """
    folder = KeyFolder(store.database_path.parent, store.files)
    log = _log_of(store)
    with store.database.writing() as connection:
        lines = log.lines()
        require_sound(store, connection, SITE, lines)
        if lines is None:
            log.begin()
        if lost:
            _require_lost(connection, folder)
        old = None if lost else _present_key(store, connection)
        changes = read_key_changes(connection)
        if old is not None:
            _sign(store, connection, SITE, old)
        new = folder.make()
        _record_key(store, connection, new, previous=changes[-1][1]["key_id"], reason=reason, actor=actor)
        _sign(store, connection, SITE, old or new)
        every = read_every_checkpoint(connection)
    log.add(every, old or new)
    with store.database.writing() as connection:  # again under the lock: nobody else makes a key meanwhile
        folder.destroy_all_but(read_key_changes(connection)[-1][1]["key_id"])
    return public_keys(store)[-1]


def sign(store: Store, message: bytes) -> tuple[str, str]:
    """Fingerprint of the key in use, and its signature over a message in base64. Raises SigningKeyError.

    The message begins with what it is for, so that no signature can be taken for one of another kind.
    """
    with store.database.writing() as connection:
        key = _present_key(store, connection)
    return key_fingerprint(public_bytes(key)), base64.b64encode(key.sign(message)).decode()


def public_keys(store: Store) -> list[PublicKey]:
    """Every key that ever signed here, oldest first; the last one is in use."""
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


def _log_of(store: Store) -> SignatureLog:
    return SignatureLog(store.database_path.parent, store.files)


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
    """The key in use; made, recorded and signed by itself when there is none yet."""
    folder = KeyFolder(store.database_path.parent, store.files)
    changes = read_key_changes(connection)
    if changes:
        key_id = changes[-1][1]["key_id"]
        key = folder.load(key_id)
        folder.destroy_all_but(key_id)  # what a crash while changing the key has left
        return key
    # A file without its event is what a crash before the commit leaves: it is taken, not left lying about.
    left = folder.present()
    key = folder.load(left[0]) if left else folder.make()
    _record_key(store, connection, key, previous="", reason="first signature", actor=_ACTOR)
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
    """The checkpoint of the last event; None when that one is not signed."""
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
