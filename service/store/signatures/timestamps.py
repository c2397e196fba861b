"""Time stamps (RFC 3161): an outside authority confirms when a checkpoint existed. Optional."""

from __future__ import annotations

import base64
import binascii
import hashlib
import http.client
import queue
import threading
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from rfc3161_client import (
    HashAlgorithm,
    TimestampRequestBuilder,
    TimeStampResponse,
    VerificationError,
    VerifierBuilder,
    decode_timestamp_response,
)
from sqlalchemy import insert, select

from service.core.records.events import TimeStampKept
from service.core.records.run_events import DeviceTrouble
from service.store.database.tables import timestamps
from service.store.durable_effects import utc_text
from service.store.events import sha256_text
from service.store.records import SITE, Checkpoint, Timestamp, TimestampError
from service.store.signatures.checkpoints import statement
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.chain_checks import Fault

_DEVICE = "time-stamp authority"
_LARGEST_REPLY = 1 << 20
# Exceptions raised by damaged tokens and certificates.
_UNREADABLE = (ValueError, TypeError, UnsupportedAlgorithm, x509.ExtensionNotFound, x509.DuplicateExtension)
_TYPE, _REPLY_TYPE = "application/timestamp-query", "application/timestamp-reply"


@dataclass(frozen=True, slots=True)
class Authority:
    """A time-stamp authority, with the PEM file of its root and intermediate certificates."""

    url: str
    certificates: Path
    timeout_s: float


def stamped_bytes(checkpoint: Checkpoint) -> bytes:
    """Return the bytes to be stamped: the signed statement and its signature."""
    return statement(checkpoint) + b"\n" + checkpoint.signature.encode()


def timestamp(store: Store, signed: Checkpoint, authority: Authority) -> Timestamp:
    """Have a checkpoint stamped, verify the answer and store it; an existing stamp is returned as it is.

    Raises:
        TimestampError: no answer, or an answer that does not verify; nothing was recorded.
        StoreError: the stamp was stored, but the record of it could not be signed.
    """
    for present in store.timestamps(signed.run_id):
        if (present.seq, present.authority) == (signed.seq, authority.url):
            return present
    asked_utc = utc_text(store.clock.utc_now())
    reply = _request(stamped_bytes(signed), authority)
    found = Timestamp(signed.run_id, signed.seq, authority.url, asked_utc, base64.b64encode(reply).decode())
    _keep(store, found)
    checkpoint(store, SITE)
    return found


def _request(message: bytes, authority: Authority) -> bytes:
    """Return the authority's answer, verified (DER). Raises TimestampError."""
    request = TimestampRequestBuilder().data(message).hash_algorithm(HashAlgorithm.SHA256).build()
    try:
        reply = _post_within(authority, request.as_bytes())
        response = decode_timestamp_response(reply)
        roots, others = _certificates(authority.certificates)
        builder = VerifierBuilder.from_request(request)
        _verify(builder, roots, others, response, message)
    except (OSError, *_UNREADABLE, VerificationError) as error:
        raise TimestampError(
            f"the time-stamp authority gave no valid answer: {error}",
            where=authority.url,
            remedy="Check the network, address and certificates in the rig file; the checkpoint is valid without it",
        ) from error
    return reply


def _keep(store: Store, found: Timestamp) -> None:
    """Store a stamp and record it in the site's chain, unless one of this authority is already there."""
    with store.database.writing() as connection:
        taken = select(timestamps.c.seq).where(
            timestamps.c.run_id == found.run_id,
            timestamps.c.seq == found.seq,
            timestamps.c.authority == found.authority,
        )
        if connection.execute(taken).first() is None:
            connection.execute(
                insert(timestamps).values(
                    run_id=found.run_id,
                    seq=found.seq,
                    authority=found.authority,
                    at_utc=found.at_utc,
                    token=found.token,
                )
            )
            kept = TimeStampKept(
                run=found.run_id,
                seq=found.seq,
                authority=found.authority,
                at_utc=found.at_utc,
                token_sha256=sha256_text(found.token),
            )
            store.append_site(connection, [kept], actor="service")


def stamp_end(store: Store, run_id: str, authority: Authority | None) -> None:
    """Sign the end of a run, and have the signature stamped if an authority is configured.

    If the authority fails, a device_trouble is recorded and signed, and nothing is raised.
    Raises StoreError if the checkpoint itself cannot be made.
    """
    signed = checkpoint(store, run_id)
    if authority is None:
        return
    try:
        timestamp(store, signed, authority)
    except TimestampError as error:
        trouble = DeviceTrouble(device=_DEVICE, error=type(error).__name__, message=str(error))
        store.record(run_id, [trouble], actor="service")
        checkpoint(store, run_id)


def timestamp_findings(
    checkpoints: Sequence[Checkpoint], stamps: Sequence[Timestamp], certificates: Path | None
) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on the time stamps of a run.

    Raises TimestampError if the certificates cannot be read.
    """
    signed = {item.seq: item for item in checkpoints}
    faults: list[Fault] = []
    notes: list[str] = []
    for stamp in stamps:
        try:
            said = _check(signed.get(stamp.seq), stamp, certificates)
        except (*_UNREADABLE, VerificationError) as error:
            faults.append(Fault(stamp.run_id, stamp.seq, "", f"time stamp of {stamp.authority}: {error}"))
        else:
            notes.append(f"{stamp.run_id}: {stamp.authority} says that the checkpoint at event {stamp.seq} {said}")
    return faults, notes


def _check(checkpoint: Checkpoint | None, stamp: Timestamp, certificates: Path | None) -> str:
    if checkpoint is None:
        raise ValueError("it belongs to a checkpoint that is not there")
    try:
        response = decode_timestamp_response(base64.b64decode(stamp.token, validate=True))
    except binascii.Error as error:
        raise ValueError(f"it cannot be read: {error}") from error
    message = stamped_bytes(checkpoint)
    at = f"existed at {utc_text(response.tst_info.gen_time)}"
    if certificates is None:
        if response.tst_info.message_imprint.message != hashlib.sha256(message).digest():
            raise ValueError("it was given for something other than this checkpoint")
        return f"{at} (its signature was not checked: no certificates were given)"
    roots, others = _certificates(certificates)
    _verify(VerifierBuilder(), roots, others, response, message)
    return at


def _verify(
    builder: VerifierBuilder,
    roots: Sequence[x509.Certificate],
    others: Sequence[x509.Certificate],
    response: TimeStampResponse,
    message: bytes,
) -> None:
    for certificate in roots:
        builder = builder.add_root_certificate(certificate)
    for certificate in others:
        builder = builder.add_intermediate_certificate(certificate)
    builder.build().verify_message(response, message)


def _certificates(path: Path) -> tuple[list[x509.Certificate], list[x509.Certificate]]:
    """Return (roots, intermediates) in a PEM file; self-issued certificates are roots. Raises TimestampError."""
    try:
        found = x509.load_pem_x509_certificates(path.read_bytes())
        roots = [certificate for certificate in found if certificate.issuer == certificate.subject]
    except (OSError, *_UNREADABLE) as error:
        raise TimestampError(
            f"the certificates of the time-stamp authority cannot be read: {error}",
            where=str(path),
            remedy="Name a PEM file that holds the authority's root certificate",
        ) from error
    return roots, [certificate for certificate in found if certificate not in roots]


def _post_within(authority: Authority, body: bytes) -> bytes:
    """Return the authority's answer within `timeout_s` in all. Raises OSError, ValueError.

    A socket's timeout limits only single operations, not a name look-up without a network or an answer that trickles
    in. So the request runs in a thread, which is abandoned when the time is up.
    """
    answered: queue.Queue[bytes | OSError | ValueError] = queue.Queue(1)
    too_late = TimeoutError(f"nothing within {authority.timeout_s:g} s")

    def ask() -> None:
        try:
            answered.put(_post(authority, body))
        except (OSError, ValueError) as error:
            late = isinstance(getattr(error, "reason", error), TimeoutError)
            answered.put(too_late if late else error)
        except http.client.HTTPException as error:
            answered.put(ValueError(f"its answer is not HTTP ({error!r})"))

    threading.Thread(target=ask, name="time stamp", daemon=True).start()
    try:
        answer = answered.get(timeout=authority.timeout_s)
    except queue.Empty:
        raise too_late from None
    if isinstance(answer, bytes):
        return answer
    raise answer


def _post(authority: Authority, body: bytes) -> bytes:
    if not authority.url.startswith(("http://", "https://")):
        raise ValueError("the address must begin with http:// or https://")
    request = urllib.request.Request(authority.url, data=body, headers={"Content-Type": _TYPE}, method="POST")
    with urllib.request.urlopen(request, timeout=authority.timeout_s) as reply:
        if reply.headers.get_content_type() != _REPLY_TYPE:
            raise ValueError(f"it answered with {reply.headers.get_content_type()}")
        content: bytes = reply.read(_LARGEST_REPLY + 1)
    if len(content) > _LARGEST_REPLY:
        raise ValueError("its answer is too long")
    return content
