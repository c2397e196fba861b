"""Check accounts, their secrets, invitation links and sessions against the site's chain.

These rows are the present state. Anybody who inserted one without the software could act under another's name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from service.store.events import canonical, sha256_text
from service.store.records import SITE
from service.store.verification.chain_checks import Fault

Rows = Sequence[Mapping[str, Any]]
_SESSION = ("token_sha256", "account", "screen", "csrf", "created_utc_s")  # columns that never change
_ENDS = frozenset({"signed_out", "ended"})
_LOCKS = {"screen_locked": 1, "screen_unlocked": 0}


def session_sha256(row: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the columns of a session that never change.

    (A flipped bit may have turned text into bytes.)
    """
    values = {name: row[name] for name in _SESSION}
    return sha256_text(canonical({k: str(v) if isinstance(v, bytes) else v for k, v in values.items()}))


@dataclass
class _AccountState:
    role: str = ""
    state: str = ""
    full_name: str = ""
    created_utc: str = ""
    stored: dict[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, slots=True)
class _Link:
    account: str
    expires_utc_s: float


@dataclass
class _RecordedAccounts:
    """The state of accounts, links and sessions according to the site's chain."""

    accounts: dict[str, _AccountState] = field(default_factory=dict[str, _AccountState])
    links: dict[str, _Link] = field(default_factory=dict[str, _Link])  # links by SHA-256 of the stored token_sha256
    open_links: dict[str, str] = field(default_factory=dict[str, str])  # account → hash of its valid link
    unhashed_links: set[str] = field(default_factory=set[str])  # accounts with events older than these hashes
    sessions: dict[str, tuple[str, int]] = field(default_factory=dict[str, tuple[str, int]])  # screen → hash, locked

    def changed(self, change: Mapping[str, Any], at_utc: str) -> None:
        """Apply an account_changed event."""
        name, new, stored = str(change["account"]), str(change["new"]), change.get("stored") or {}
        if change["field"] == "link":
            sha256, hours = stored.get("token_sha256"), new.removeprefix("valid for ").removesuffix(" h")
            if sha256 is None or not hours.isdecimal():
                self.unhashed_links.add(name)
                return
            self.links[sha256] = _Link(name, datetime.fromisoformat(at_utc).timestamp() + float(hours) * 3600)
            self.open_links[name] = sha256
            return
        if change["field"] in ("state", "created"):
            self.open_links.pop(name if change["field"] == "state" else "", None)
        account = self.accounts.setdefault(name, _AccountState())
        match change["field"]:
            case "created":
                account.role, _, account.state = new.partition(", ")
                account.full_name = str(change.get("full_name", ""))
                account.created_utc = at_utc if stored else ""
            case "role":
                account.role = new
            case "state":
                account.state = new
            case _:
                pass
        account.stored |= stored

    def signed_in(self, event: Mapping[str, Any]) -> None:
        """Apply a sign_in_recorded event."""
        screen, outcome = str(event["screen"]), str(event["outcome"])
        if outcome == "signed_in":
            self.sessions[screen] = str(event.get("session_sha256", "")), 0
        elif outcome in _ENDS:
            self.sessions.pop(screen, None)
        elif outcome in _LOCKS and screen in self.sessions:
            self.sessions[screen] = self.sessions[screen][0], _LOCKS[outcome]


def people_faults(
    events: Iterable[tuple[Mapping[str, Any], str]], accounts: Rows, links: Rows, sessions: Rows
) -> Iterator[Fault]:
    """Yield a fault for each row that differs from the site's chain; what older chains do not record is none.

    Args:
        events: (payload, time) of account_changed and sign_in_recorded, oldest first.
        accounts: rows of the table accounts.
        links: rows of the table invitations.
        sessions: rows of the table sessions.
    """
    told = _RecordedAccounts()
    for payload, at_utc in events:
        if payload["kind"] == "account_changed":
            told.changed(payload, at_utc)
        else:
            told.signed_in(payload)
    yield from _account_faults(told, accounts)
    yield from _link_faults(told, links)
    for row in sessions:
        where = f"table sessions: the sign-in of {row['account']} on screen {row['screen']}"
        sha256, locked = told.sessions.get(str(row["screen"]), (None, 0))
        if sha256 is None:
            yield _fault(f"{where} is not told by any event, or has ended")
        elif sha256 not in ("", session_sha256(row)):
            yield _fault(f"{where} is not the one that its event records")
        elif row["locked"] != locked:
            yield _fault(f"{where} is {'' if row['locked'] else 'not '}locked; the events say otherwise")


def _link_faults(told: _RecordedAccounts, rows: Rows) -> Iterator[Fault]:
    for row in rows:
        sha256, account = sha256_text(str(row["token_sha256"])), str(row["account"])
        known, of = told.links.get(sha256), f"for the account {account}" if account else "for the first administrator"
        if known is None and account in told.unhashed_links:
            continue
        if known != _Link(account, row["expires_utc_s"]):
            yield _fault(f"table invitations: a link {of} is not one that the events record")
        elif row["used"] != int(told.open_links.get(account) != sha256):
            state = "used up" if row["used"] else "valid"
            yield _fault(f"table invitations: a link {of} is {state}; the events say otherwise")


def _account_faults(told: _RecordedAccounts, rows: Rows) -> Iterator[Fault]:
    seen: set[str] = set()
    for row in rows:
        name = str(row["account"])
        seen.add(name)
        known = told.accounts.get(name)
        if known is None:
            yield _fault(f"the account {name} ({row['role']}) was made by nobody: no event records it")
            continue
        if (known.role, known.state) != (row["role"], row["state"]):
            recorded = f"{known.role}, {known.state}"
            yield _fault(f"the account {name} is {row['role']}, {row['state']}; the events say {recorded}")
        for column, sha256 in known.stored.items():
            if sha256_text(str(row[column])) != sha256:
                secret = column.removesuffix("_hash").replace("pin", "PIN")
                yield _fault(f"the {secret} of the account {name} was set past the software")
        if row["badge_hash"] and "badge_hash" not in known.stored:
            yield _fault(f"the badge of the account {name} was set past the software")
        if known.created_utc and (known.created_utc, known.full_name) != (row["created_utc"], row["full_name"]):
            yield _fault(f"the account {name} has another name or beginning than its event records")
    for name in told.accounts.keys() - seen:
        yield _fault(f"the account {name} was made, and its row is gone")


def _fault(what: str) -> Fault:
    return Fault(SITE, None, "", what)
