"""A command is for the roles that may do the same on the pages: every command that takes a name, with every role."""

from __future__ import annotations

import pytest

from service.people.person import ROLES, Permission, Role, may
from tests.support.pages.web import ACCOUNT_OF, password_of
from tests.support.processes.quick_hashes import QuickHasher
from tests.support.record.entered_names import COMMANDS, OF_NAMES, NamedSite, site_with_accounts

# What each command does, as the pages have it; whoever has an account may look after the files of a data folder.
NEEDED: dict[str, Permission] = {
    **dict.fromkeys(COMMANDS, "operate"),
    **dict.fromkeys(("store gc", "store restore", "store rebuild", "store copy"), "read"),
    "act sign": "sign",
    "accounts end-wait": "administer",
    "audit rotate-key": "administer",
    "audit sign-here": "administer",
    "audit export": "report",
    "audit report": "report",
    "audit release": "release",
    "audit correct": "correct",
    "export": "export",
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> NamedSite:
    return site_with_accounts(tmp_path_factory.mktemp("roles"))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hash as quickly as the accounts of the site were made."""
    monkeypatch.setattr("service.people.credentials.PasswordHasher", QuickHasher)


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_a_role_may_what_it_may_on_the_pages_and_nothing_else(site: NamedSite, role: Role) -> None:
    account = ACCOUNT_OF[role]
    refused = {place for place, needed in NEEDED.items() if not may(role, needed)}
    assert refused or role == "supervisor"
    for place in refused:
        attempt = site.attempt(place, account, password_of(account))
        assert (attempt.status, attempt.refusal, attempt.since) == (1, "NotAllowedError", ()), place
    for place in ("note", "store gc", "audit report", "audit rotate-key"):
        if place not in refused:
            assert site.attempt(place, account, password_of(account)).refusal not in OF_NAMES, place
