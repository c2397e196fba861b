"""Failed tries: where a secret was typed, how many were wrong there, and how long one has to wait there.

Strangers and people whom an account knows are counted apart, so that nobody can shut a person out by guessing.
Whoever is signed in, at a terminal of the machine, or at an address from which the account has signed in, has a count
of their own. The counts are those of the site's chain, so that a restart does not forget them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property
from math import inf
from typing import Any

from sqlalchemy import ColumnElement, Row, select

from service.core.records.events import SignInRecorded
from service.people.person import Person
from service.people.rows import SERVICE
from service.store.database.tables import event_facets, event_index, events
from service.store.event_index import facet_value
from service.store.events import to_event
from service.store.records import SITE
from service.store.store import Store

FREE_FAILURES = 5  # wrong passwords in a row before one waits; wrong PINs before a sign-in ends
FIRST_WAIT_S = 30.0
LONGEST_WAIT_S = 900.0
REMEMBERED_S = 6 * 3600.0  # how long a wrong password of a known person counts
_PLACE = (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq)
_OF_SITE = select(events).join(event_index, _PLACE).where(event_index.c.run_id == SITE)
_AT_ONCE = 200  # rows


def _has(name: str, value: str) -> ColumnElement[bool]:
    """Return the condition that an event of the index has this facet."""
    facet = event_facets.alias()
    return (
        select(facet.c.seq)
        .where(
            facet.c.run_id == event_index.c.run_id,
            facet.c.seq == event_index.c.seq,
            facet.c.name == name,
            facet.c.value == facet_value(value),
        )
        .correlate(event_index)
        .exists()
    )


def wait_after_s(failures: int) -> float:
    """Return the seconds to wait after this many wrong passwords in a row."""
    over = failures - FREE_FAILURES
    return 0.0 if over < 0 else min(FIRST_WAIT_S * 2.0 ** min(over, 10), LONGEST_WAIT_S)


@dataclass(frozen=True, slots=True)
class SecretOrigin:
    """The place where a secret is typed: a browser's address, a screen that is signed in, or a terminal."""

    address: str = ""  # address of the browser that signs in
    screen: str = ""
    by: str = ""  # the account that is signed in on the screen


TERMINAL = SecretOrigin(address="terminal")


def on_screen_of(person: Person) -> SecretOrigin:
    """Return the screen on which a person is signed in."""
    return SecretOrigin(screen=person.screen, by=person.account)


def _counted_at(account: str, origin: SecretOrigin) -> tuple[str, str, str]:
    """Return the key of the tries that are counted together.

    For another's secret the key is who typed it, so that a new sign-in starts no new count.
    """
    if not origin.by:
        return account, "address", origin.address
    return (account, "screen", origin.screen) if origin.by == account else (account, "by", origin.by)


class KnownTries:
    """Wrong passwords, PINs and badges of people whom their account knows, since the last right password there."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def knows(self, account: str, origin: SecretOrigin) -> bool:
        """Return whether the origin is a screen, a terminal, or an address from which the account has signed in."""
        return bool(origin.by) or origin == TERMINAL or (account, origin.address) in self._addresses

    def wait_s(self, account: str, origin: SecretOrigin) -> float:
        """Return the seconds to wait before the next try; 0 for none."""
        return self._wait_s(_counted_at(account, origin))

    def longest_wait_s(self, account: str) -> float:
        """Return the longest wait at any of the account's known origins."""
        return max((self._wait_s(counted) for counted in tuple(self._failed) if counted[0] == account), default=0.0)

    def failed(self, account: str, origin: SecretOrigin) -> None:
        """Count a wrong secret."""
        at_s = self._store.clock.monotonic_s()
        self._failed.setdefault(_counted_at(account, origin), _new_count()).append(at_s)

    def succeeded(self, account: str, origin: SecretOrigin) -> None:
        """Start the count again after the right password; a sign-in makes its address known."""
        self._failed.pop(_counted_at(account, origin), None)
        if origin.address and not origin.by:
            self._addresses.add((account, origin.address))

    def _wait_s(self, counted: tuple[str, str, str]) -> float:
        now, failed = self._store.clock.monotonic_s(), self._failed.get(counted)
        while failed and now - failed[0] >= REMEMBERED_S:
            failed.popleft()
        left_s = failed[-1] + wait_after_s(len(failed)) - now if failed else 0.0
        if left_s > 0 and self._ended_after(counted[0], failed[-1] if failed else now):
            self._failed.pop(counted, None)
            return 0.0
        return max(0.0, left_s)

    def _ended_after(self, account: str, monotonic_s: float) -> bool:
        """Return whether an administrator has ended the account's waits since; perhaps from another process."""
        ended = (
            _OF_SITE.where(
                event_index.c.kind == "account_changed", _has("field", "lock_out"), _has("account", account)
            )
            .order_by(events.c.seq.desc())
            .limit(1)
        )
        with self._store.database.reading() as connection:
            row = connection.execute(ended).first()
        return row is not None and _age_s(self._store, row) <= self._store.clock.monotonic_s() - monotonic_s

    @cached_property
    def _addresses(self) -> set[tuple[str, str]]:
        """(account, address) of every sign-in that succeeded."""
        account, address = event_facets.alias(), event_facets.alias()
        signed_in = (
            select(account.c.value, address.c.value)
            .distinct()
            .join(event_index, (event_index.c.run_id == account.c.run_id) & (event_index.c.seq == account.c.seq))
            .join(address, (address.c.run_id == account.c.run_id) & (address.c.seq == account.c.seq))
            .where(
                account.c.run_id == SITE,
                account.c.name == "account",
                address.c.name == "address",
                event_index.c.kind == "sign_in_recorded",
                event_index.c.actor != SERVICE,
                _has("outcome", "signed_in"),
            )
        )
        with self._store.database.reading() as connection:
            return {(str(one), str(other)) for one, other in connection.execute(signed_in) if other}

    @cached_property
    def _failed(self) -> dict[tuple[str, str, str], deque[float]]:
        """Monotonic times of the tries that count, as the chain has them when this process first asks."""
        now = self._store.clock.monotonic_s()
        counted: dict[tuple[str, str, str], deque[float]] = {}
        for row, tried, age_s in reversed(list(_recent(self._store, REMEMBERED_S))):
            by = "" if row.actor == SERVICE or not tried.screen else str(row.actor)
            origin = SecretOrigin(tried.address, tried.screen if by else "", by)
            if tried.outcome == "signed_in":
                counted.pop((tried.account, "address", tried.address), None)
            elif _is_wrong(tried) and (by or tried.address) and self.knows(tried.account, origin):
                counted.setdefault(_counted_at(tried.account, origin), _new_count()).append(now - age_s)
        return counted


def failed_tries(store: Store, window_s: float) -> list[tuple[str, float]]:
    """Return (address, age in s) of every failed try at a sign-in within the last `window_s` seconds, oldest first.

    A try that seems to be in the future, because the clock was set back, counts as made now. Since the first start of
    the service in the present boot, both clocks must say that a try is old. Raises IntegrityError.
    """
    tries = [(tried.address, age_s) for _row, tried, age_s in _recent(store, window_s) if _is_try(tried)]
    return tries[::-1]


def _recent(store: Store, window_s: float) -> Iterator[tuple[Row[Any], SignInRecorded, float]]:
    """Yield row, payload and age of recorded sign-ins within the last `window_s` seconds, newest first."""
    since = _first_start(store)
    newest_first = _OF_SITE.where(event_index.c.kind == "sign_in_recorded").order_by(event_index.c.seq.desc())
    with (
        store.database.reading() as connection,
        connection.execution_options(yield_per=_AT_ONCE).execute(newest_first) as rows,
    ):
        for row in rows:
            age_s = _age_s(store, row, since)
            if age_s >= window_s:
                return
            payload = to_event(row).payload
            if isinstance(payload, SignInRecorded):
                yield row, payload, age_s


def _first_start(store: Store) -> float:
    """Return the number of the event of the service's first start in the present boot; infinity if there is none."""
    boot = store.clock.boot()
    if not boot:
        return inf
    start = _OF_SITE.where(event_index.c.kind == "service_started", _has("boot", boot))
    with store.database.reading() as connection:
        first = connection.execute(start.order_by(events.c.seq).limit(1)).first()
    return inf if first is None else float(first.seq)


def _age_s(store: Store, row: Row[Any], since: float | None = None) -> float:
    now, monotonic_s = store.clock.utc_now(), store.clock.monotonic_s()
    by_utc_s = (now - datetime.fromisoformat(row.at_utc)) / timedelta(seconds=1)
    same_boot = row.seq > (_first_start(store) if since is None else since)
    return max(0.0, min(by_utc_s, monotonic_s - row.monotonic_s) if same_boot else by_utc_s)


def _new_count() -> deque[float]:
    return deque(maxlen=100)


def _is_wrong(event: SignInRecorded) -> bool:
    """Return whether a secret was wrong and was counted; nothing is counted while somebody has to wait."""
    return event.outcome == "refused" and event.account != ""


def _is_try(event: SignInRecorded) -> bool:
    # Events without an address concern a PIN or a signature; that an address has to wait is not a try.
    refused = event.outcome == "refused" or (event.outcome == "locked_out" and event.account != "")
    return refused and event.address not in ("", TERMINAL.address)
