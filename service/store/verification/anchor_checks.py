"""Compares the record with its anchors in the object store: anchors and record in, faults, notes and counts out."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from service.core.errors import StoreError
from service.core.words import counted
from service.store.data_folder import object_store_of
from service.store.objects.anchors import (
    FOLDER,
    ROOTS,
    LineAnchor,
    ListedVersion,
    LockedVersion,
    RootAnchor,
    line_number,
    merkle_root,
)
from service.store.records import SITE
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.log import LogLine, line_alone
from service.store.verification.chain_checks import ChainFacts, Fault

_CLOCKS_DIFFER = timedelta(days=1)
_NAMED = 5  # most lines, days or objects that one note or fault names


@dataclass(frozen=True, slots=True)
class ReadAnchors:
    """The anchors as the object store has them, every version read.

    Attributes:
        place: the name of the store.
        versions: all versions that could be anchors; of one name the newest first.
        deletions: marks that an object was deleted; its versions are still there.
        unread: versions that are too large to be an anchor.
        lock_days: how long site.yaml has anchors locked.
        patience: how old a signature may be that has no anchor yet.
        at: the time of the comparison.
    """

    place: str
    versions: Sequence[LockedVersion]
    deletions: Sequence[ListedVersion]
    unread: Sequence[ListedVersion]
    lock_days: int
    patience: timedelta
    at: datetime


@dataclass(frozen=True, slots=True)
class AnchorCounts:
    """How much of a record was compared with the object store, and how much could not be."""

    lines: int = 0
    roots: int = 0
    heads: int = 0
    lines_not_compared: int = 0
    heads_not_compared: int = 0


@dataclass
class AnchorFindings:
    """The faults, notes and counts of a comparison with the anchors."""

    faults: list[Fault] = field(default_factory=list[Fault])
    notes: list[str] = field(default_factory=list[str])
    counts: AnchorCounts = AnchorCounts()


@dataclass(frozen=True, slots=True)
class RecordSide:
    """The side of the record in the comparison: the log of signatures, its keys and the chains.

    Attributes:
        lines: the log's lines, oldest first; None if it is in another data folder, which signs the site.
        chains: the chains that were read.
        keys: raw public keys by fingerprint.
        every_run: true if every chain was read, so that one that is missing was deleted.
    """

    lines: Sequence[LogLine] | None
    chains: Mapping[str, ChainFacts]
    keys: Mapping[str, bytes]
    every_run: bool


def compare(anchors: ReadAnchors, record: RecordSide) -> AnchorFindings:
    """Return what the anchors show of a record."""
    found = AnchorFindings()
    by_name: dict[str, list[LockedVersion]] = {}
    for version in anchors.versions:
        by_name.setdefault(version.listed.name, []).append(version)
    lines = {number: held for name, held in by_name.items() if (number := line_number(name)) is not None}
    days = {day: held for name, held in by_name.items() if (day := _day(name)) is not None}
    for name, held in by_name.items():
        found.faults += _version_faults(name, held, anchors)
    strangers = [name for name in by_name if line_number(name) is None and _day(name) is None]
    strangers += [listed.name for listed in anchors.unread]
    for name in strangers[:_NAMED]:
        found.faults.append(
            _fault(anchors, name, "this is no anchor that this software writes: somebody else put it")
        )
    if record.lines is not None:
        _compare_lines(found, anchors, record, record.lines, lines)
    heads = _compare_roots(found, anchors, record, days)
    _note_days(found, anchors, record, sorted(days))
    if anchors.deletions:
        names = ", ".join(sorted({mark.name for mark in anchors.deletions})[:_NAMED])
        number = counted(len(anchors.deletions), "anchor")
        found.notes.append(
            f"somebody with the keys of the object store marked {number} as deleted ({names}); their locked "
            "versions are still there and were compared"
        )
    found.counts = AnchorCounts(
        lines=sum(number in lines for number in range(1, len(record.lines or ()) + 1)), roots=len(days), heads=heads
    )
    return found


def not_compared(place: str, why: str, lines: int, heads: int) -> str:
    """Return the sentence on a record that could not be compared with its anchors."""
    return (
        f"{counted(lines, 'line')} of {LOG_NAME} and the ends of {counted(heads, 'chain')} are not compared, because "
        f"the anchors in {place} cannot be read: {why}. What only they would show was NOT verified"
    )


def lines_not_compared(place: str, where: str, lines: int) -> str:
    """Return the sentence on a log of signatures that is elsewhere, so that its anchors cannot be compared."""
    return (
        f"{counted(lines, 'line')} of {LOG_NAME} {'is' if lines == 1 else 'are'} not compared with the anchors in "
        f"{place}, because {where}. What only they would show was NOT verified: verify there too"
    )


def _day(name: str) -> date | None:
    try:
        return date.fromisoformat(name.removeprefix(ROOTS)) if name.startswith(ROOTS) else None
    except ValueError:
        return None


def _fault(anchors: ReadAnchors, name: str, what: str) -> Fault:
    return Fault(None, None, f"{name} in {anchors.place}", what)


def _version_faults(name: str, held: Sequence[LockedVersion], anchors: ReadAnchors) -> Iterator[Fault]:
    """Yield a fault for an anchor with other versions, or whose lock is missing or too short."""
    oldest = held[-1]
    others = sum(version.content != oldest.content for version in held)
    if others:
        what = f"it was overwritten: {counted(others, 'later version')} with other content"
        yield _fault(anchors, name, what)
    stated = _stated_end(oldest.content)
    if stated is None or stated <= anchors.at:
        return  # not an anchor, which is told elsewhere; or its time is over
    if oldest.retained_until is None:
        yield _fault(
            anchors, name, "it is not locked: the store did not apply its retention, or somebody else put it"
        )
    elif oldest.retained_until < stated:
        what = f"it is locked until {_text(oldest.retained_until)} only, and states {_text(stated)}"
        yield _fault(anchors, name, what)


def _stated_end(content: bytes) -> datetime | None:
    anchor = LineAnchor.parse(content) or RootAnchor.parse(content)
    return None if anchor is None else _time(anchor.retained_until_utc)


def _text(at: datetime) -> str:
    return f"{at:%Y-%m-%d %H:%M} UTC"


def _compare_lines(
    found: AnchorFindings,
    anchors: ReadAnchors,
    record: RecordSide,
    lines: Sequence[LogLine],
    held: Mapping[int, Sequence[LockedVersion]],
) -> None:
    """Compare every line of the log with its anchor, and look for anchors of lines that are gone."""
    beyond: list[int] = []
    for number, versions in sorted(held.items()):
        anchor = LineAnchor.parse(versions[-1].content)
        name = versions[-1].listed.name
        if anchor is None:
            found.faults.append(_fault(anchors, name, "this is not the anchor of a line: somebody else put it"))
        elif number > len(lines):
            if _ours(anchor.line, number, record):
                beyond.append(number)
            else:
                what = f"{LOG_NAME} has no line {number}, and no key of this record signed it: somebody else put it"
                found.faults.append(_fault(anchors, name, f"{what}, or the record was replaced"))
        elif lines[number - 1].raw.decode(errors="replace") != anchor.line:
            where = f"{LOG_NAME}, line {number}"
            found.faults.append(Fault(None, None, where, f"it is not the line that {name} in {anchors.place} holds"))
    if beyond:
        what = (
            f"{LOG_NAME} ends after line {len(lines)}, and the object store holds anchors up to line "
            f"{beyond[-1]}, signed with a key of this record: it was rolled back, and the record perhaps with it"
        )
        found.faults.append(Fault(None, None, LOG_NAME, what))
    _check_missing(found, anchors, lines, held)


def _ours(line: str, number: int, record: RecordSide) -> bool:
    """Return whether a key of this record signed a line, whatever line is before it here."""
    parsed = line_alone(line.encode(errors="replace"))
    key = record.keys.get(parsed.key_id)
    return parsed.number == number and key is not None and parsed.signed_by(key)


def _check_missing(
    found: AnchorFindings,
    anchors: ReadAnchors,
    lines: Sequence[LogLine],
    held: Mapping[int, Sequence[LockedVersion]],
) -> None:
    """List the lines without an anchor: too new for one, too old for the lock, or neither, which is a fault."""
    waiting: list[datetime] = []
    over: list[int] = []
    late: list[int] = []
    for line in lines:
        if line.checkpoint is None:
            continue  # a fault of the log
        signed_at = _time(line.checkpoint.at_utc)
        if signed_at is None:
            continue  # its checkpoint does not verify
        age = anchors.at - signed_at
        versions = held.get(line.number)
        if versions:
            if versions[-1].listed.at_utc - signed_at > anchors.patience + timedelta(minutes=1):
                late.append(line.number)
        elif age > timedelta(days=anchors.lock_days):
            over.append(line.number)
        elif -_CLOCKS_DIFFER <= age <= anchors.patience:  # signed since the anchors were read, or by another clock
            waiting.append(signed_at)
        else:
            what = (
                f"its signature of {_text(signed_at)} has no anchor in the object store, after more than "
                f"{_hours(anchors.patience)}: it was never written there, or this is another line"
            )
            found.faults.append(Fault(None, None, f"{LOG_NAME}, line {line.number}", what))
    if waiting:
        found.notes.append(
            f"{_lines(waiting, 'has', 'have')} no anchor in the object store yet, the oldest since "
            f"{_text(min(waiting))}"
        )
    if over:
        found.notes.append(
            f"{_lines(over, 'has', 'have')} no anchor any more, up to line {over[-1]}: older "
            f"than {counted(anchors.lock_days, 'day')}, for which anchors are locked"
        )
    if late:
        found.notes.append(
            f"{_lines(late, 'was', 'were')} anchored later (the first is line {late[0]}) than "
            f"{_hours(anchors.patience)} after its signature: until then no anchor covered it"
        )


def _lines(found: Sequence[object], one: str, several: str) -> str:
    """Return the beginning of a sentence on lines of the log, with its verb."""
    return f"{counted(len(found), 'line')} of {LOG_NAME} {one if len(found) == 1 else several}"


def _hours(patience: timedelta) -> str:
    return f"{patience / timedelta(hours=1):g} hours"


def _time(at_utc: str) -> datetime | None:
    try:
        return datetime.fromisoformat(at_utc).astimezone(UTC)
    except ValueError:
        return None


def _compare_roots(
    found: AnchorFindings, anchors: ReadAnchors, record: RecordSide, held: Mapping[date, Sequence[LockedVersion]]
) -> int:
    """Compare the daily ends of chains with the record. Returns how many were compared."""
    compared = 0
    differ: dict[str, list[tuple[date, int]]] = {}
    for day, versions in sorted(held.items()):
        name = versions[-1].listed.name
        anchor = RootAnchor.parse(versions[-1].content)
        if anchor is None or anchor.day != day.isoformat():
            found.faults.append(_fault(anchors, name, "this is not the root of its day: somebody else put it"))
            continue
        if not _signed(anchor, record.keys):
            what = "no key of this record signed it: somebody else put it, or the record was replaced"
            found.faults.append(_fault(anchors, name, what))
            continue
        if merkle_root(anchor.heads) != anchor.root:
            found.faults.append(_fault(anchors, name, "its root is not that of the chains that it names"))
        for run, seq, sha256 in anchor.heads:
            if run not in record.chains and not record.every_run:
                continue
            compared += 1
            if run not in record.chains or record.chains[run].sha256_at.get(seq) != sha256:
                differ.setdefault(run, []).append((day, seq))
    for run, places in differ.items():
        day, seq = places[0]
        gone = run not in record.chains
        what = "the run is not here any more" if gone else "that event is not here any more, or another one is"
        more = f", and so do {counted(len(places) - 1, 'later root')}" if len(places) > 1 else ""
        whole = "the site's own chain" if run == SITE else "the run"
        what = (
            f"the root of {day} in the object store names this as its last event{more}; {what}: {whole} was rolled "
        )
        found.faults.append(Fault(run, seq, "", f"{what}back or rewritten"))
    return compared


def _signed(anchor: RootAnchor, keys: Mapping[str, bytes]) -> bool:
    key = keys.get(anchor.key_id)
    if key is None:
        return False
    try:
        signature = base64.b64decode(anchor.signature, validate=True)
        Ed25519PublicKey.from_public_bytes(key).verify(signature, anchor.message())
    except (InvalidSignature, binascii.Error, ValueError):
        return False
    return True


def _note_days(found: AnchorFindings, anchors: ReadAnchors, record: RecordSide, days: Sequence[date]) -> None:
    """Add a note on the days without a root since the first one, and on the longest gap."""
    if not days:
        if record.lines is None or record.lines:
            found.notes.append("no day has a root in the object store yet")
        return
    today = anchors.at.date()
    gaps = [(before, (after - before).days - 1) for before, after in zip(days, [*days[1:], today], strict=True)]
    gaps = [(before + timedelta(days=1), length) for before, length in gaps if length > 0]
    if gaps:
        total = sum(length for _, length in gaps)
        first, length = max(gaps, key=lambda gap: gap[1])
        found.notes.append(
            f"{counted(total, 'day')} since {days[0]} {'has' if total == 1 else 'have'} no root in the object store; "
            f"the longest time without is {counted(length, 'day')} from {first} on"
        )


_AT_ONCE = 8
_MOST_BYTES = 64 << 20  # the ends of half a million chains


@dataclass(frozen=True, slots=True)
class UnreadAnchors:
    """The anchors of an object store that could not be read, and why."""

    place: str
    why: str


def read_anchors(data_dir: Path) -> ReadAnchors | UnreadAnchors | None:
    """Return the anchors that the site.yaml of a folder names; None if it has anchors nowhere.

    A store that is away, or that cannot be opened from here, is no error: a sentence says what was not compared.
    Raises ConfigurationError if the site's file itself is wrong.
    """
    section = object_store_of(data_dir)
    if section is None or section.lock_days is None:
        return None
    # Imported here: for sites only.
    from service.store.objects.anchors import LockedObjects  # noqa: PLC0415
    from service.store.objects.opening import open_objects  # noqa: PLC0415

    try:
        objects = open_objects(data_dir, section)
        objects.require_bucket()
        locked = LockedObjects(objects)
        listed = list(locked.versions(FOLDER))
        wanted = [found for found in listed if not found.deletion and found.size_bytes <= _MOST_BYTES]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            read = [version for version in pool.map(locked.read, wanted) if version is not None]
    except StoreError as error:
        return UnreadAnchors(section.place, error.what)
    return ReadAnchors(
        place=section.place,
        versions=read,
        deletions=[found for found in listed if found.deletion],
        unread=[found for found in listed if found.size_bytes > _MOST_BYTES],
        lock_days=section.lock_days,
        patience=timedelta(hours=section.anchor_within_hours),
        at=datetime.now(UTC),
    )
