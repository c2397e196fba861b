"""Whether a run's protocol has the approved content of its id and version: approvals, other contents, differences."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import text

from service.core.errors import OrthocaptureError
from service.people.approvals import Approval, approvals, difference
from service.store.records import SITE
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class DifferingContent:
    """Different content under the same id and version: its runs, who approved it, and the lines that differ."""

    sha256: str
    runs: tuple[str, ...]
    by: str
    changes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ProtocolIdentity:
    """The content of a run's protocol, who approved it, and the others under its name."""

    sha256: str
    approval: Approval | None
    others: tuple[DifferingContent, ...]


_CONTENTS = text(
    "SELECT e.run_id, json_extract(e.payload, '$.protocol_sha256') AS sha256 FROM events AS e "
    "WHERE e.seq = 1 AND e.run_id <> :site AND json_valid(e.payload) "
    "AND json_extract(e.payload, '$.protocol_id') = :protocol "
    "AND json_extract(e.payload, '$.protocol_version') = :version ORDER BY e.run_id"
)


def protocol_identity(store: Store, run_id: str, protocol: str, version: str) -> ProtocolIdentity:
    """Look up the contents that runs used under this protocol's name, and who approved each of them."""
    known = approvals(store, protocol, version)
    with store.database.reading() as connection:
        rows = connection.execute(_CONTENTS, {"site": SITE, "protocol": protocol, "version": version})
        by_run = {str(row.run_id): str(row.sha256 or "") for row in rows}
    mine = by_run.get(run_id, "")
    approved = {one.payload.sha256: one for one in known}
    hashes = dict.fromkeys(sha256 for sha256 in (*by_run.values(), *approved) if sha256 not in ("", mine))
    source = _source(store, approved, mine)
    others = [
        DifferingContent(
            sha256,
            tuple(run for run, its in by_run.items() if its == sha256),
            approved[sha256].by if sha256 in approved else "",
            tuple(difference(_source(store, approved, sha256), source)) if source else (),
        )
        for sha256 in hashes
    ]
    return ProtocolIdentity(mine, approved.get(mine), tuple(others))


def _source(store: Store, approved: dict[str, Approval], sha256: str) -> str:
    """The text of a content: from its approval, else from the evidence of a run; "" if neither can be read."""
    if sha256 in approved:
        return approved[sha256].payload.source
    try:
        return store.artefact_path(sha256).read_text("utf-8")
    except (OSError, UnicodeDecodeError, OrthocaptureError):
        return ""
