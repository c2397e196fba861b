"""The pure part of verifying signatures: keys, checkpoints and time stamps in, faults and notes out."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from service.store.events import sha256_text
from service.store.records import SITE, Checkpoint, Timestamp
from service.store.signatures.checkpoints import RowsDigest, key_fingerprint, signed_by
from service.store.verification.chain_checks import ChainFacts, Fault


@dataclass(frozen=True, slots=True)
class KeyPeriod:
    """A public key and the part of the site's chain during which it was in use."""

    key_id: str
    public_key: bytes
    seq: int  # number of its KeyChanged event
    replaced_seq: int | None  # seq of its successor's KeyChanged; None for the key in use


@dataclass
class Keys:
    """The history of keys in the site's chain, with faults and notes."""

    periods: dict[str, KeyPeriod] = field(default_factory=dict[str, KeyPeriod])
    faults: list[Fault] = field(default_factory=list[Fault])
    notes: list[str] = field(default_factory=list[str])


def key_history(site: ChainFacts, checkpoints: Sequence[Checkpoint]) -> Keys:
    """Return the keys in the site's chain; `checkpoints` are the site's.

    A new key counts as introduced if its predecessor signed its KeyChanged. Otherwise a note says so: the old key may
    have been lost, and only a fingerprint written down elsewhere distinguishes the new key from an intruder's.
    """
    keys = Keys()
    vouchers = {item.seq: item for item in checkpoints}
    before: KeyPeriod | None = None
    for index, (seq, change) in enumerate(site.key_changes):
        key_id, said_before = str(change["key_id"]), str(change["previous_key_id"])
        try:
            raw = base64.b64decode(str(change["public_key"]), validate=True)
        except (binascii.Error, ValueError):
            raw = b""
        if len(raw) != 32 or key_fingerprint(raw) != key_id:
            keys.faults.append(Fault(SITE, seq, "", f"the fingerprint {key_id} is not that of the public key"))
        if said_before != (before.key_id if before else ""):
            keys.faults.append(Fault(SITE, seq, "", f"key {key_id[:16]}… does not follow the key before it"))
        if key_id in keys.periods:
            keys.faults.append(Fault(SITE, seq, "", f"key {key_id[:16]}… is introduced twice"))
        if before is not None and (seq not in vouchers or not signed_by(vouchers[seq], before.public_key)):
            keys.notes.append(
                f"site, event {seq}: key {key_id} was not vouched for by the key before it ({change['reason']}): "
                "compare its fingerprint with one that was written down elsewhere"
            )
        after = site.key_changes[index + 1][0] if index + 1 < len(site.key_changes) else None
        before = KeyPeriod(key_id, raw, seq, after)
        keys.periods.setdefault(key_id, before)
    return keys


def checkpoint_faults(
    run_id: str,
    checkpoints: Sequence[Checkpoint],
    chain: ChainFacts,
    site: ChainFacts,
    keys: Mapping[str, KeyPeriod],
    artefact_rows: Sequence[Mapping[str, Any]],
) -> Iterator[Fault]:
    """Yield every fault of a run's checkpoints, given oldest first; `artefact_rows` in the order of the events."""
    digest, position = RowsDigest(), 0
    for item in checkpoints:
        while position < len(artefact_rows) and int(artefact_rows[position]["seq"]) <= item.seq:
            digest.add(str(artefact_rows[position]["record_sha256"]))
            position += 1
        period = keys.get(item.key_id)
        found = chain.sha256_at.get(item.seq)
        if period is None:
            yield _fault(item, f"it is signed by a key that the site's chain does not know ({item.key_id})")
        elif not signed_by(item, period.public_key):
            yield _fault(item, "its signature is not valid")
        elif not _in_use(item, period):
            yield _fault(
                item, f"its key {item.key_id[:16]}… was not in use at event {item.site_seq} of the site's chain"
            )
        if found is None:
            yield _fault(item, "it signs an event that is not there")
        elif found != item.sha256:
            yield _fault(item, f"it signs an event with hash {item.sha256}, the chain has {found}: it was rewritten")
        if item.artefacts_sha256 != digest.hexdigest():
            yield _fault(item, "the rows of the artefacts up to it are not those that it signs")
        if site.sha256_at.get(item.site_seq) != item.site_sha256:
            yield _fault(item, f"event {item.site_seq} of the site's chain is not the one that it names")


def _in_use(item: Checkpoint, period: KeyPeriod) -> bool:
    if period.replaced_seq is None or item.site_seq < period.replaced_seq:
        return item.site_seq >= period.seq
    return item.run_id == SITE and item.seq == item.site_seq == period.replaced_seq  # vouches for its successor


def _fault(item: Checkpoint, what: str) -> Fault:
    return Fault(item.run_id, item.seq, "", f"checkpoint: {what}")


def start_faults(run_id: str, chain: ChainFacts, site: ChainFacts) -> Iterator[Fault]:
    """Yield a fault for each end of the run's chain that the site's chain recorded at a start and that is gone."""
    for start_seq, heads in site.heads_at_start:
        if run_id in heads:
            seq, sha256 = heads[run_id]
            if chain.sha256_at.get(int(seq)) != sha256:
                what = (
                    f"the service saw another event here when it started (event {start_seq} of the site's chain): "
                    "the chain was cut or rewritten since"
                )
                yield Fault(run_id, int(seq), "", what)


def stamp_faults(
    site: ChainFacts, signed: Mapping[str, Sequence[Checkpoint]], stamps: Mapping[str, Sequence[Timestamp]]
) -> Iterator[Fault]:
    """Yield a fault for each time stamp unlike that recorded in the site's chain; `signed`, `stamps` are by run.

    Stamps of other runs, and stamps made before the site's chain recorded them, are not checked.
    """
    told: dict[tuple[str, int, str], tuple[str, str]] = {}
    for _, payload in site.stamps:
        place = str(payload["run"]), int(payload["seq"]), str(payload["authority"])
        told[place] = str(payload["at_utc"]), str(payload["token_sha256"])
    present = {(stamp.run_id, stamp.seq, stamp.authority): stamp for items in stamps.values() for stamp in items}
    site_seq = {(item.run_id, item.seq): item.site_seq for items in signed.values() for item in items}
    first = min((site_seq[place[:2]] for place in told if place[:2] in site_seq), default=None)
    for place, stamp in present.items():
        if place in told:
            if told[place] != (stamp.at_utc, sha256_text(stamp.token)):
                yield Fault(*place[:2], "", f"time stamp of {place[2]}: it is not the one that was given")
        elif first is not None and site_seq.get(place[:2], first) >= first:
            yield Fault(*place[:2], "", f"time stamp of {place[2]}: no event records that it was given")
    for place in told:
        if place[0] in stamps and place not in present:
            yield Fault(*place[:2], "", f"the time stamp of {place[2]} was removed")


def signed_run_faults(site: ChainFacts, chains: Mapping[str, ChainFacts], *, every_run: bool) -> Iterator[Fault]:
    """Yield a fault for each run that the site's chain recorded as signed and that is missing, cut or different."""
    gone: set[str] = set()
    for at, payload in site.runs_signed:
        run_id, seq = str(payload["run"]), int(payload["seq"])
        if run_id not in chains:
            if every_run and run_id not in gone:
                what = f"the run was signed (event {at} of the site's chain) and is no longer here: it was deleted"
                yield Fault(run_id, None, "", what)
            gone.add(run_id)
        elif chains[run_id].sha256_at.get(seq) != payload["sha256"]:
            what = f"the site's chain says (event {at}) that another event was signed here: it was cut or rewritten"
            yield Fault(run_id, seq, "", what)


def unsigned_end_faults(run_id: str, checkpoints: Sequence[Checkpoint], chain: ChainFacts) -> Iterator[Fault]:
    """Yield a fault for each event that is signed at once (step passed, run ended) and whose signature was removed.

    The last event may still be waiting for its signature, even if a worker has reported since.
    """
    signed = checkpoints[-1].seq if checkpoints else 0
    for seq, kind in chain.to_sign:
        if signed < seq < chain.last_own:
            what = f"{kind.replace('_', ' ')} was never signed, or its signature was removed"
            yield Fault(run_id, seq, "", what)


def late_signatures(run_id: str, checkpoints: Sequence[Checkpoint], chain: ChainFacts) -> Iterator[str]:
    """Yield notes on events that are always signed at once and have no signature of their own, only a later one.

    Signing may have failed then, or a signature may have been taken away, the events rewritten, and signed again.
    """
    late: dict[int, list[int]] = {}
    for seq, _kind in chain.to_sign:
        covering = next((item.seq for item in checkpoints if item.seq >= seq), None)
        if covering is not None and chain.to_sign_before.get(seq, covering + 1) <= covering:
            late.setdefault(covering, []).append(seq)
    for covering, events in late.items():
        several = len(events) != 1
        named = ", ".join(map(str, events))
        yield (
            f"{run_id}: event{'s' if several else ''} {named}, signed at once as a rule, "
            f"{'were' if several else 'was'} signed only with event {covering}: a change before that leaves no trace"
        )


def unsigned(run_id: str, checkpoints: Sequence[Checkpoint], events: int) -> tuple[int, str]:
    """Return the number of events after the last checkpoint, and a note on them; (0, "") if there are none."""
    last = checkpoints[-1].seq if checkpoints else 0
    count = max(0, events - last)
    if count == 0:
        return 0, ""
    after = f"after its last checkpoint (event {last})" if checkpoints else "and none of them is signed"
    return count, f"{run_id}: {count} event{'s' if count != 1 else ''} {after}"
