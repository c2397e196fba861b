"""A record whose every text means harm: all that reads it prints it with escapes, and all that exports it works."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit import bundle_verifier
from service.cli.main import app
from service.cli.terminal_output import Terminal
from service.core.words import shown
from service.store.durable_effects import DurableFiles, SystemClock
from service.store.signatures.second_place import SecondPlace, away_words
from tests.support.hostile_places import PAGES, READING, elements_made, read_by, record_of_hostile_texts, settled
from tests.support.hostile_text import obeyed
from tests.support.pages.web import web_site
from tests.support.record.outsider import copy_data


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    return record_of_hostile_texts(tmp_path_factory.mktemp("hostile"))


@pytest.mark.parametrize("which", ["completed", "open"])
@pytest.mark.parametrize("name", READING)
def test_every_command_that_reads_it_prints_escapes(recorded: tuple[Path, str, str], name: str, which: str) -> None:
    data, *runs = recorded
    run, other = runs if which == "completed" else reversed(runs)
    as_words, *as_json = read_by(name, data, run, other)
    for status, printed, fault in (as_words, *as_json):
        assert fault is None
        assert status in (0, 1, 2), printed
        assert obeyed(printed) == []
    verdicts = [line for line in as_words[1].splitlines() if line.startswith("Verified")]
    assert len(verdicts) == (1 if name.startswith("verify") else 0), verdicts
    if name == "show" and which == "open":
        assert "[bold red]x[/]" in as_words[1]
        assert "\\x1b[3A" in as_words[1]


@pytest.mark.parametrize("which", ["completed", pytest.param("open", marks=pytest.mark.sweep)])
def test_no_page_makes_elements_of_it(recorded: tuple[Path, str, str], tmp_path: Path, which: str) -> None:
    data, *runs = recorded
    copy_data(data, tmp_path / "data")
    with web_site(tmp_path) as site:
        browser = site.browser("administrator")
        for page in PAGES:
            status, text = settled(browser, page.format(run=runs[which == "open"]))
            assert status in (200, 404), page
            assert elements_made(text) == [], page


def test_it_is_reported_exported_and_verified_elsewhere(recorded: tuple[Path, str, str], tmp_path: Path) -> None:
    data, run, _ = recorded
    for words in (
        ["audit", "report", run, "--html", str(tmp_path / "r.html"), "--pdf", str(tmp_path / "r.pdf")],
        ["audit", "export", run, str(tmp_path / "b.zip")],
    ):
        done = CliRunner().invoke(app, [*words, "--data", str(data), "--operator", "Ada"], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        assert obeyed(done.output) == []
    assert "\x00" not in (tmp_path / "r.html").read_text(encoding="utf-8")
    check = bundle_verifier.Check()
    check.run(tmp_path / "b-SIMULATED.zip", None, None)
    assert check.faults == []
    assert obeyed(bundle_verifier.report(check)) == []
    with zipfile.ZipFile(tmp_path / "b-SIMULATED.zip") as archive:
        assert b"\\u0000" not in archive.read("events.jsonl").replace(b"\\\\u0000", b"")


@pytest.mark.parametrize("folder", ["[/gone]", "[bold red]share[/]", "\x1b[2Jshare"])
def test_a_second_place_of_signatures_that_is_away_is_told_as_it_is_named(
    recorded: tuple[Path, str, str], tmp_path: Path, folder: str
) -> None:
    stream = io.StringIO()
    place = tmp_path / folder / "signatures.jsonl"
    away = SecondPlace.of(recorded[0], place, SystemClock(), DurableFiles()).update()
    assert away is not None
    Terminal(file=stream, width=300).print(away_words(away))
    assert shown(folder) in stream.getvalue()
    assert obeyed(stream.getvalue()) == []
