"""The people of a site with a clock that stands still unless told otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from service.core.records.events import AccountChanged, SignInRecorded
from service.people.person import PeopleError, Person
from service.people.sessions import People
from service.store.records import SITE
from service.store.store import Store
from tests.support.pages.web import password_of
from tests.support.record.stepped_clock import SteppedClock

IDLE_S = 600.0


@dataclass
class Office:
    """People with a clock that stands still unless told otherwise."""

    people: People
    store: Store
    clock: SteppedClock
    data: Path

    def person(self, token: str, *, deliberate: bool = False) -> Person | None:
        return self.people.person(token, idle_lock_s=IDLE_S, deliberate=deliberate)

    def enter(self, account: str) -> tuple[str, Person]:
        token = self.people.sign_in(account, password_of(account))
        person = self.person(token)
        assert person is not None
        return token, person

    def outcomes(self, account: str | None = None) -> list[str]:
        """Recorded outcomes of sign-ins since the office was created."""
        events = [event.payload for event in self.store.events(SITE)]
        signs = [p for p in events if isinstance(p, SignInRecorded) and account in (None, p.account)]
        return [p.outcome for p in signs]

    def changes(self, account: str) -> list[tuple[str, str, str, str]]:
        events = [event.payload for event in self.store.events(SITE)]
        own = [p for p in events if isinstance(p, AccountChanged) and p.account == account]
        return [(p.field, p.old, p.new, p.reason) for p in own]


def refused(act: Callable[[], object]) -> PeopleError:
    with pytest.raises(PeopleError) as caught:
        act()
    return caught.value
