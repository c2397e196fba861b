"""Accounts in a data folder, with the password and the PIN that tests enter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from service.people.person import Role
from service.people.sessions import People
from service.store.store import Store
from tests.support.processes.quick_hashes import QuickHasher

PASSWORD = "correct horse battery"
PIN = "246810"


def add_people(data: Path, people: Sequence[tuple[str, Role]]) -> None:
    """Create accounts with PASSWORD and PIN as the pages do: an administrator invites, people accept."""
    with Store.open(data) as store:
        desk = People(store, QuickHasher())
        desk.accounts.set_up(desk.first_link() or "", "ada", "Ada Example", PASSWORD, PIN)
    invite_people(data, people)


def invite_people(data: Path, people: Sequence[tuple[str, Role]]) -> None:
    """Create further accounts of that kind: the administrator Ada is there already."""
    with Store.open(data) as store:
        desk = People(store, QuickHasher())
        token = desk.sign_in("ada", PASSWORD)
        administrator = desk.person(token, idle_lock_s=600, deliberate=True)
        assert administrator is not None
        for account, role in people:
            link = desk.accounts.invite(administrator, account, f"{account.title()} Example", role)
            desk.accounts.accept(link, PASSWORD, PIN)
        desk.sign_out(administrator)
