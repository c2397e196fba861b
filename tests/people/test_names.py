"""What a name is, and the sweep: names that imitate a person or the program, at every place where a name enters."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from service.audit.verify.verifications import Verifications
from service.cli.main import app
from service.core.errors import ConfigurationError
from service.core.text.person_names import NAME_CHARACTERS, cleaned_name, looks_of, person_name
from service.people.errors import AccountError
from service.people.sessions import People
from service.store.records import SITE
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, WebSite, password_of, web_site
from tests.support.record.office import Office
from tests.support.record.stepped_clock import SteppedClock
from tests.support.runs.bench_run import PROTOCOL, begin_run

# Names that look like the account emmy, or like nothing.
IMITATING = {
    "zero width": "emmy\u200b",
    "joiner": "em\u200dmy",
    "Cyrillic": "\u0435mmy",
    "Greek": "\u03b5mmy",
    "small capitals": "\u1d07mmy",
    "right to left": "\u202eymme",
    "newline": "emmy\n",
    "escapes": "\x1b[2Jemmy",
    "filler": "emmy\u3164",
    "variation": "emmy\ufe0f",
    "struck through": "e\u0336mmy",
    "NUL": "emmy\x00",
    "dot": "emmy.",
}
# Those under which the program itself acts.
PROGRAMS = ("runner", "Runner", "web", "worker", "site", "service", "\uff57\uff45\uff42", "s1te", "\u0441amera")
NAMES = (*IMITATING.values(), *PROGRAMS, "A Stranger", "claimed:emmy", "x" * 100)
# In full width, or with blanks around, it is emmy's own name, and needs her password.
HER_OWN = ("\uff45\uff4d\uff4d\uff59", " EMMY ", "emmy\n")
PEOPLE = ("Müller", "O'Brien", "O\u2019Brien", "李明", "Иван", "Αλέξης", "محمد", "राज कुमार", "Adébáyọ̀", "김철수")
# One of each kind, for the tests that are quick; the sweep takes all.
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
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with accounts, and a run that waits for its first confirmation."""
    folder = tmp_path_factory.mktemp("site")
    with web_site(folder) as site:
        site.begin_run()
        CliRunner().invoke(app, ["store", "backup", str(folder / "backup"), "--data", str(folder / "data")])
    return folder / "data"


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without accounts."""
    folder = tmp_path_factory.mktemp("without")
    with Store.open(folder / "data") as store:
        store.record_site([], actor="service")
        begin_run(store, PROTOCOL, folder)
    return folder / "data"


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)


# Place where a name enters → its words on the command line.
PLACES: dict[str, tuple[str, ...]] = {
    **{
        f"act {verb}": ("act", verb, "--reason", "no reason") for verb in ("confirm", "sign", "redo", "skip", "abort")
    },
    **{f"act {verb}": ("act", verb) for verb in ("accept", "resume", "release", "finish")},
    "note": ("note", "seen"),
    "resume": ("resume", "latest", "--no-worker"),
    "key": ("audit", "rotate-key", "--reason", "yearly"),
    "bundle": ("audit", "export", "latest", "made.zip", "--hashes-only"),
    "report": ("audit", "report", "latest", "--html", "made.html"),
    "data set": ("export", "latest", "--format", "plain", "--out", "made"),
    "leftovers": ("store", "gc", "--remove", "--min-age-min", "0"),
}


def actors(data: Path) -> list[tuple[str, str, str]]:
    """Who did what, but for refused passwords and actions."""
    with Store.open(data) as store:
        chains = (SITE, *(run.run_id for run in store.runs()))
        return [
            (run, event.payload.kind, event.actor)
            for run in chains
            for event in store.events(run)
            if event.payload.kind not in ("sign_in_recorded", "run_signed")
        ]


def called(data: Path, name: str, words: tuple[str, ...], typed: str = "") -> tuple[int, str]:
    options = ["--operator", name, "--password-stdin", "--data", str(data), "--json"]
    result = CliRunner().invoke(app, [*words, *options], input=f"{typed}\n", catch_exceptions=False)
    return result.exit_code, result.output


def refused_at(data: Path, place: str, names: Iterable[str]) -> None:
    """Nobody acts under these names at a place where a name enters."""
    before = actors(data)
    for name in names:
        status, said = called(data, name, PLACES[place])
        assert status == 1, (name, said)
    assert actors(data) == before


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.usefixtures("elsewhere")
def test_where_there_are_accounts_nobody_else_acts(data: Path, place: str) -> None:
    refused_at(data, place, FEW[:4])


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.usefixtures("elsewhere")
def test_where_there_are_none_nobody_acts_under_a_name_that_is_no_persons(without: Path, place: str) -> None:
    refused_at(without, place, FEW_OF_NOBODY)


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.usefixtures("elsewhere")
def test_every_name_at_every_place_where_there_are_accounts(data: Path, place: str) -> None:
    refused_at(data, place, (*NAMES, *HER_OWN, *PEOPLE))


@pytest.mark.sweep
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.usefixtures("elsewhere")
def test_every_name_at_every_place_where_there_are_none(without: Path, place: str) -> None:
    refused_at(without, place, (name for name in NAMES if name not in ("emmy.", "A Stranger")))


@pytest.mark.parametrize("name", PEOPLE)
def test_where_there_are_no_accounts_people_act_by_claim(without: Path, name: str) -> None:
    status, said = called(without, name, PLACES["note"])
    assert status == 0, said
    assert actors(without)[-1][1:] == ("note_taken", person_name(name))
    assert verify(without).ok


@pytest.mark.parametrize("name", FEW)
def test_everybody_may_pause_and_the_record_says_that_the_name_is_a_claim(data: Path, name: str) -> None:
    status, said = called(data, name, ("act", "pause"))
    assert (status, "the run is paused already" in said) in ((0, False), (1, True)), said
    actor = actors(data)[-1][2]
    assert actor.startswith("claimed:")
    assert actor.removeprefix("claimed:").isprintable()


def test_a_name_of_the_machine_is_a_name_like_any_other(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = actors(data)
    for name in FEW:
        monkeypatch.setenv("LOGNAME", name)
        result = CliRunner().invoke(
            app, ["note", "seen", "--password-stdin", "--data", str(data)], catch_exceptions=False
        )
        assert result.exit_code == 1
    assert actors(data) == before
    monkeypatch.setenv("LOGNAME", "\x1b[2Jemmy")
    CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(data)], catch_exceptions=False)
    with Store.open(data) as store:
        (run,) = store.runs()
    kept = Verifications(data, store.clock).last(run.run_id)
    assert kept is not None
    assert kept.by == "2Jemmy (command line)"


def test_a_restoration_is_recorded_in_an_accounts_name_only(data: Path, tmp_path: Path) -> None:
    for number, name in enumerate(FEW):
        words = ["store", "restore", str(data.parent / "backup"), str(tmp_path / str(number))]
        result = CliRunner().invoke(app, [*words, "--operator", name, "--password-stdin"], input="guessed\n")
        assert result.exit_code == 1, name
        assert not list((tmp_path / str(number)).iterdir()), name


def posts(site: WebSite) -> dict[str, Callable[[str], int]]:
    """Every form of the pages in which a name is typed; each returns the status of its answer."""
    administrator, technician = site.browser("administrator"), site.browser("technician")
    link = f"/set-up/{site.people.accounts.invite(administrator.person, 'mary', 'Mary Shelley', 'auditor')}"
    secrets = {"password": "a good password", "repeated": "a good password", "pin": PIN}
    run = {"protocol": "bench.yaml", "specimen": "a spine"}
    return {
        "account": lambda name: (
            administrator.send_form("/accounts", account=name, full_name="Some Body", role="auditor").status_code
        ),
        "full name": lambda name: (
            administrator.send_form("/accounts", account="somebody", full_name=name, role="auditor").status_code
        ),
        "operator": lambda name: technician.send_form("/runs", operator=name, **run).status_code,
        "sign in": lambda name: site.browser().sign_in(name, "guessed").status_code,
        "link": lambda name: site.browser().post(link, data={**secrets, "pin": "1", "account": name}).status_code,
        "badge": lambda name: (
            administrator.send_form(f"/badges/{quote(name)}", password="x", badge="0004711815").status_code
        ),
    }


@pytest.mark.parametrize("place", ["account", "full name", "operator", "sign in", "link", "badge"])
def test_pages_take_no_name_that_nobody_has(tmp_path: Path, place: str) -> None:
    clock = SteppedClock()
    with web_site(tmp_path, clock=clock) as site:
        post = posts(site)[place]
        before = len(site.store.events(SITE))
        for name in FEW[:4]:
            clock.passed_s += 300.0
            status = post(name)
            assert status in (400, 401, 403, 404, 409, 422), (name, status)
        since = [event.payload.kind for event in site.store.events(SITE)[before:]]
        assert not {*since} - {"sign_in_recorded", "key_changed"}
        assert not site.store.runs()


def test_the_first_administrator_has_a_name(tmp_path: Path) -> None:
    with Store.open(tmp_path, SteppedClock()) as store:
        people = People(store, QUICK_HASHES)
        link = people.first_link() or ""
        for name in (*PROGRAMS, "\u0435mmy", "emmy\u200b"):
            with pytest.raises(AccountError):
                people.accounts.set_up(link, name, "Ada Lovelace", "a good password", PIN)
            with pytest.raises(AccountError):
                people.accounts.set_up(link, "ada", name, "a good password", PIN)
        assert people.accounts.set_up(link, "ada", "Ada Lovelace", "a good password", PIN) == "ada"


def test_accounts_with_names_of_earlier_versions_still_act(office: Office) -> None:
    """Names were checked less in earlier versions; who has such an account keeps it."""
    _, ada = office.enter("ada")
    office.people.accounts.invite(ada, "mary", "Mary Shelley", "auditor")
    with office.store.database.writing() as connection:
        connection.exec_driver_sql("PRAGMA foreign_keys = OFF")
        connection.exec_driver_sql(
            "UPDATE accounts SET account = 'emmy_', full_name = 'Emmy <Noether>' WHERE account = 'emmy'"
        )
    office.people.sign_in("Emmy_", password_of("emmy"))
