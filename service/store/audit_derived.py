"""What the database holds beside the chains and can be made again from them: schema, index of events, accounts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, text

from service.store.audit_checks import Fault
from service.store.database import DATABASE_NAME, fresh_schema
from service.store.records import SITE

# Of an index that says something else than the events, or of events that it does not have.
_INDEX = """
SELECT coalesce(e.run_id, i.run_id) AS run_id, coalesce(e.seq, i.seq) AS seq,
       e.seq IS NULL AS foreign_row, i.seq IS NULL AS missing_row
FROM {left} LEFT JOIN {right} ON e.run_id = i.run_id AND e.seq = i.seq
WHERE e.seq IS NULL OR i.seq IS NULL OR i.kind IS NOT e.kind OR i.actor IS NOT e.actor
   OR (json_valid(e.payload) AND (i.step IS NOT json_extract(e.payload, '$.step')
                                  OR i.device IS NOT json_extract(e.payload, '$.device')))
"""


def schema_faults(connection: Connection) -> Iterator[Fault]:
    """Tables, indexes and triggers that are not as this software makes them: a trigger may do nothing any more."""
    statement = text("SELECT type, name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_stat%'")
    present = {(str(row.type), str(row.name)): row.sql for row in connection.execute(statement)}
    expected = fresh_schema()
    for (kind, name), sql in expected.items():
        if (kind, name) not in present:
            consequence = ": the evidence could be changed" if kind == "trigger" else ""
            yield Fault(None, None, DATABASE_NAME, f"the {kind} {name} is missing{consequence}")
        elif present[kind, name] != sql:
            yield Fault(None, None, DATABASE_NAME, f"the {kind} {name} is not the one that this software makes")
    for kind, name in present.keys() - expected.keys():
        yield Fault(None, None, DATABASE_NAME, f"the {kind} {name} is not of this software")


def index_faults(connection: Connection, run_ids: Sequence[str]) -> Iterator[Fault]:
    """Rows of the index that auditors filter by: missing, foreign, or saying something else than their event."""
    wanted = frozenset(run_ids)
    for left, right in (("events AS e", "event_index AS i"), ("event_index AS i", "events AS e")):
        seen_before = left.startswith("event_index")
        for row in connection.execute(text(_INDEX.format(left=left, right=right))):
            if row.run_id not in wanted or (seen_before and not row.foreign_row):
                continue
            what = "the index of events does not say what the event says"
            if row.missing_row:
                what = "the event is missing from the index by which auditors filter"
            elif row.foreign_row:
                what = "the index of events has a row of an event that is not there"
            yield Fault(str(row.run_id), int(row.seq), "", what)


def account_faults(
    rows: Sequence[Mapping[str, Any]], changes: Sequence[tuple[int, Mapping[str, Any]]]
) -> Iterator[Fault]:
    """Accounts whose role or state did not come about as the site's chain tells it.

    Args:
        rows: of the table of accounts.
        changes: payloads of account_changed with the numbers of their events, oldest first.
    """
    told: dict[str, tuple[str, str]] = {}
    for _, change in changes:
        account, new = str(change["account"]), str(change["new"])
        role, state = told.get(account, ("", ""))
        match change["field"]:
            case "created":
                role, _, state = new.partition(", ")
            case "role":
                role = new
            case "state":
                state = new
            case _:
                continue
        told[account] = (role, state)
    for row in rows:
        account = str(row["account"])
        recorded = told.pop(account, None)
        if recorded is None:
            yield Fault(
                SITE, None, "", f"the account {account} ({row['role']}) was made by nobody: no event tells of it"
            )
        elif recorded != (row["role"], row["state"]):
            what = f"the account {account} is {row['role']}, {row['state']}; the events say {', '.join(recorded)}"
            yield Fault(SITE, None, "", what)
    for account in told:
        yield Fault(SITE, None, "", f"the account {account} was made, and its row is gone")
