"""Approvals of protocols on this site. An approval names the hash of the file and is recorded in the site's chain."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import unified_diff

from sqlalchemy import select

from service.core.errors import ConfigurationError
from service.core.protocol import LoadedProtocol
from service.core.records.entered import reason_of
from service.core.records.events import Event, ProtocolApproved
from service.core.records.run_events import Identified
from service.store.database.tables import event_index, events
from service.store.events import to_event
from service.store.records import SITE
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class Approval:
    """A person's approval of one content of a protocol."""

    payload: ProtocolApproved
    by: str
    at_utc: str
    seq: int  # number of the event in the site's chain


@dataclass(frozen=True, slots=True)
class ProtocolStanding:
    """The standing of a protocol file on a site: its approval, or that of another content.

    Attributes:
        approval: the approval of exactly this content; None if there is none.
        other: the last approval of other content with the same id and version; None if there is none.
    """

    approval: Approval | None
    other: Approval | None

    @property
    def changed(self) -> bool:
        """True if this content is not approved, but other content of the same id and version is."""
        return self.approval is None and self.other is not None


def approvals(store: Store, protocol: str, version: str) -> list[Approval]:
    """Return all approvals for an id and version of a protocol, oldest first."""
    found = (
        select(events)
        .join(event_index, (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq))
        .where(event_index.c.run_id == SITE, event_index.c.kind == "protocol_approved")
        .order_by(events.c.seq)
    )
    with store.database.reading() as connection:
        read = [to_event(row) for row in connection.execute(found)]
    return [one for event in read if (one := _approval(event)) is not None and _same(one, protocol, version)]


def _approval(event: Event) -> Approval | None:
    payload = event.payload
    return Approval(payload, event.actor, event.at_utc, event.seq) if isinstance(payload, ProtocolApproved) else None


def _same(one: Approval, protocol: str, version: str) -> bool:
    return (one.payload.protocol, one.payload.version) == (protocol, version)


def standing_of(store: Store, loaded: LoadedProtocol) -> ProtocolStanding:
    """Return the standing of a protocol file on this site."""
    known = approvals(store, loaded.protocol.id, loaded.protocol.version)
    mine = [one for one in known if one.payload.sha256 == loaded.sha256]
    others = [one for one in known if one.payload.sha256 != loaded.sha256]
    return ProtocolStanding(mine[-1] if mine else None, others[-1] if others else None)


def approve(
    store: Store,
    loaded: LoadedProtocol,
    by: str,
    *,
    reason: str = "",
    identified: Identified = "",
) -> ProtocolStanding:
    """Record that a person approves this content, unless it is approved already. Returns the new standing.

    Raises ConfigurationError if other content of the same id and version is approved and no reason is given.
    """
    standing = standing_of(store, loaded)
    if standing.approval is not None:
        return standing
    protocol = loaded.protocol
    if standing.other is not None and not reason.strip():
        raise ConfigurationError(
            f"{protocol.id} {protocol.version} has another content than the one that {standing.other.by} approved: "
            + "; ".join(difference(standing.other.payload.source, loaded.source)[:8]),
            where=f"SHA-256 {loaded.sha256}, approved was {standing.other.payload.sha256}",
            remedy="Give it another version, put the approved file back, or approve the change with a reason",
        )
    record = ProtocolApproved(
        protocol=protocol.id,
        version=protocol.version,
        sha256=loaded.sha256,
        source=loaded.source,
        instead_of=standing.other.payload.sha256 if standing.other is not None else "",
        reason=reason.strip() and reason_of(reason, ConfigurationError),
        identified=identified,
    )
    store.record_site([record], actor=by)
    return standing_of(store, loaded)


def difference(before: str, now: str) -> list[str]:
    """Return the lines that differ, each with − or + and its line number, such as `− 41: min: 0.9`."""
    out: list[str] = []
    old = new = 0
    for line in list(unified_diff(before.splitlines(), now.splitlines(), n=0, lineterm=""))[2:]:
        if line.startswith("@@"):
            old, new = (int(part.split(",")[0][1:]) for part in line.split()[1:3])
        elif line.startswith("-"):
            out.append(f"− {old}: {line[1:].strip()}")
            old += 1
        else:
            out.append(f"+ {new}: {line[1:].strip()}")
            new += 1
    return out
