"""What a name is, and the sweep: names that imitate a person or the program, at every place where a name enters."""

from __future__ import annotations

import itertools
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path

import pytest
from _pytest.mark.structures import ParameterSet
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from service.audit.verifications import Verifications
from service.cli.main import app
from service.core.errors import ConfigurationError
from service.core.records.entered import NAME_CHARACTERS, cleaned_name, looks_of, person_name
from service.people.person import AccountError
from service.people.sessions import People
from service.store.records import SITE
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.every_command import every_command
from tests.support.pages.web import PIN, QUICK_HASHES, password_of, web_site
from tests.support.record.entered_names import (
    COMMANDS,
    FORMS,
    HER_OWN,
    NAMES,
    OF_NOBODY,
    PEOPLE,
    PROGRAMS,
    NamedSite,
    set_up_as,
    site_with_accounts,
    site_without_accounts,
    typed,
)
from tests.support.record.office import Office
from tests.support.record.outsider import outsider
from tests.support.record.stepped_clock import SteppedClock

OF_SQLITE = ("store restore", "store rebuild")
# One of each kind, for the tests that are quick: in turn, one at each place. The sweep takes all at every place.
FEW = ("emmy\u200b", "\u0435mmy", "\x1b[2Jemmy", "runner", "A Stranger", "emmy\n")
FEW_OF_NOBODY = ("emmy\u200b", "\u0435mmy", "\x1b[2Jemmy", "runner", "claimed:emmy")


@pytest.mark.parametrize("name", PEOPLE)
def test_names_of_people_are_names(name: str) -> None:
    assert looks_of(person_name(name)) == looks_of(name)
    assert unicodedata.is_normalized("NFKC", person_name(name))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("A Stranger", "emmy.")])
def test_names_that_nobody_has(name: str) -> None:
    with pytest.raises(ConfigurationError, match="cannot be a person's name"):
        person_name(name)


@given(st.text(max_size=NAME_CHARACTERS + 10))
def test_a_name_is_printable_and_stays_what_it_is(typed: str) -> None:
    try:
        name = person_name(typed)
    except ConfigurationError:
        name = cleaned_name(typed)
        assert cleaned_name(name) == name
    else:
        assert person_name(name) == name
    assert name.isprintable()
    assert 1 <= len(name) <= NAME_CHARACTERS
    assert ":" not in name


@pytest.mark.parametrize(
    ("account", "full_name"),
    [
        ("еmmу".replace("m", "м"), "Somebody Else"),  # of Cyrillic letters alone
        ("ernmy", "Somebody Else"),
        ("émmy", "Somebody Else"),
        ("else", "Emrny Noether"),
        ("else", "Émmy Noether"),
        ("else", "Emmy"),  # the account of another person
        ("emmy.", "Somebody Else"),
    ],
)
def test_no_account_looks_like_another(office: Office, account: str, full_name: str) -> None:
    _, ada = office.enter("ada")
    with pytest.raises(AccountError):
        office.people.accounts.invite(ada, account, full_name, "auditor")


@pytest.mark.parametrize("name", ["Müller", "O'Brien", "李明", "Иван"])
def test_people_everywhere_can_have_accounts(office: Office, name: str) -> None:
    _, ada = office.enter("ada")
    link = office.people.accounts.invite(ada, name, name, "supervisor")
    account = office.people.accounts.accept(link, "a good password", PIN)
    office.people.sign_in(unicodedata.normalize("NFD", name.upper()), "a good password")
    assert account == name.lower()
    assert verify(office.data, SITE).ok


def test_two_people_may_have_the_same_name(office: Office) -> None:
    _, ada = office.enter("ada")
    office.people.accounts.invite(ada, "emmy2", "Emmy Noether", "auditor")


# --- the sweep -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> NamedSite:
    return site_with_accounts(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory) -> NamedSite:
    return site_without_accounts(tmp_path_factory.mktemp("without"))


def at_places(*names: Sequence[str]) -> list[ParameterSet]:
    """Each place of the command line; if there are names, with one of them in turn."""
    alone = pytest.mark.sqlite("backups and journal: a server has its own")
    rows = zip(COMMANDS, *map(itertools.cycle, names), strict=False)
    return [pytest.param(*row, marks=[alone] if row[0] in OF_SQLITE else []) for row in rows]


def refused_at(site: NamedSite, place: str, names: Iterable[str]) -> None:
    """Nobody acts under these names at a place where a name enters."""
    for name in names:
        attempt = site.attempt(place, name)
        assert attempt.refused_for_its_name, attempt


@pytest.mark.slow
@pytest.mark.parametrize(("place", "name"), at_places(FEW[:4]))
def test_where_there_are_accounts_nobody_else_acts(site: NamedSite, place: str, name: str) -> None:
    refused_at(site, place, (name,))


@pytest.mark.slow
@pytest.mark.parametrize(("place", "name"), at_places(FEW_OF_NOBODY))
def test_where_there_are_none_nobody_acts_under_a_name_that_is_no_persons(
    without: NamedSite, place: str, name: str
) -> None:
    refused_at(without, place, (name,))


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.parametrize("place", at_places())
def test_every_name_at_every_place_where_there_are_accounts(site: NamedSite, place: str) -> None:
    refused_at(site, place, (*NAMES, *HER_OWN, *PEOPLE))


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.parametrize("place", at_places())
def test_every_name_at_every_place_where_there_are_none(without: NamedSite, place: str) -> None:
    refused_at(without, place, OF_NOBODY)


def test_every_command_that_takes_a_name_is_tried() -> None:
    taking = {name for name, command in every_command() if any("--operator" in one.opts for one in command.params)}
    assert len(taking) > 10
    assert not {name for name in taking if not any(" ".join(words).startswith(name) for words in COMMANDS.values())}


@pytest.mark.parametrize("name", PEOPLE)
def test_where_there_are_no_accounts_people_act_by_claim(without: NamedSite, name: str) -> None:
    attempt = without.attempt("note", name)
    assert attempt.status == 0
    assert attempt.since == (f"note_taken by {person_name(name)}",)
    assert verify(without.data).ok


@pytest.mark.parametrize("name", FEW)
def test_everybody_may_pause_and_the_record_says_that_the_name_is_a_claim(site: NamedSite, name: str) -> None:
    attempt = site.attempt("act pause", name)
    (act,) = attempt.since  # the pause, or that it was refused because the run is paused already
    actor = act.partition(" by ")[2]
    assert actor.startswith("claimed:")
    assert actor.removeprefix("claimed:").isprintable()


def test_a_name_of_the_machine_is_a_name_like_any_other(site: NamedSite, monkeypatch: pytest.MonkeyPatch) -> None:
    before = site.actors()
    for name in FEW:
        monkeypatch.setenv("LOGNAME", name)
        result = CliRunner().invoke(
            app, ["note", "seen", "--password-stdin", "--data", str(site.data)], catch_exceptions=False
        )
        assert result.exit_code == 1
    assert site.actors() == before
    monkeypatch.setenv("LOGNAME", "\x1b[2Jemmy")
    CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(site.data)], catch_exceptions=False)
    with Store.open(site.data) as store:
        (run,) = store.runs()
    kept = Verifications(site.data, store.clock).last(run.run_id)
    assert kept is not None
    assert kept.by == "2Jemmy (command line)"


@pytest.mark.parametrize("place", FORMS)
def test_pages_take_no_name_that_nobody_has(tmp_path: Path, place: str) -> None:
    clock = SteppedClock()
    with web_site(tmp_path, clock=clock) as site:
        for attempt in typed(site, clock, place, (*FEW[:4], "emmy\0")):
            assert attempt.status in (400, 401, 403, 404, 409, 422), attempt
            assert attempt.since == (), attempt


def test_the_first_administrator_has_a_name(tmp_path: Path) -> None:
    with Store.open(tmp_path, SteppedClock()) as store:
        for name in (*PROGRAMS, "\u0435mmy", "emmy\u200b"):
            for attempt in set_up_as(store, name):
                assert attempt.refusal == "AccountError", attempt
        people = People(store, QUICK_HASHES)
        assert people.accounts.set_up(people.first_link() or "", "ada", "Ada Lovelace", "a good password", PIN)


def test_accounts_with_names_of_earlier_versions_still_act(office: Office) -> None:
    """Names were checked less in earlier versions; who has such an account keeps it."""
    _, ada = office.enter("ada")
    office.people.accounts.invite(ada, "mary", "Mary Shelley", "auditor")
    with outsider(office.data) as connection:
        connection.execute(
            "UPDATE accounts SET account = 'emmy_', full_name = 'Emmy <Noether>' WHERE account = 'emmy'"
        )
    office.people.sign_in("Emmy_", password_of("emmy"))
