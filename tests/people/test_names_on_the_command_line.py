"""Where accounts exist, a command that records a name asks for that account's password first."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.store.records import SITE
from service.store.store import Store
from tests.support.pages.web import password_of, web_site

COMMANDS = {
    "key replaced": ["audit", "rotate-key", "--reason", "yearly"],
    "bundle": ["audit", "export", "latest", "made.zip", "--hashes-only"],
    "report": ["audit", "report", "latest", "--html", "made.html"],
    "data set": ["export", "latest", "--format", "plain", "--out", "made"],
    "leftovers removed": ["store", "gc", "--remove", "--min-age-min", "0"],
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with accounts, and a completed run."""
    folder = tmp_path_factory.mktemp("site")
    with web_site(folder) as site:
        site.record_run()
    return folder / "data"


def called(data: Path, name: str, *words: str, typed: str) -> tuple[int, str]:
    options = ["--operator", name, "--password-stdin", "--data", str(data), "--json"]
    result = CliRunner().invoke(app, [*words, *options], input=f"{typed}\n", catch_exceptions=False)
    return result.exit_code, result.output


def recorded_by(data: Path, name: str) -> list[str]:
    with Store.open(data) as store:
        chains = (SITE, *(run.run_id for run in store.runs()))
        return [
            event.payload.kind
            for run in chains
            for event in store.events(run)
            if event.actor == name and event.payload.kind != "sign_in_recorded"
        ]


@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_is_recorded_in_the_name_of_an_account_without_its_password(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    before = recorded_by(data, "emmy")
    status, said = called(data, "emmy", *COMMANDS[name], typed="guessed")
    assert status == 1
    assert "name and password do not belong together" in said.lower(), said
    assert recorded_by(data, "emmy") == before
    assert list(tmp_path.iterdir()) == []


def test_with_the_password_it_is_recorded(data: Path, tmp_path: Path) -> None:
    words = ["audit", "export", "latest", str(tmp_path / "b.zip"), "--hashes-only"]
    status, said = called(data, "Lise", *words, typed=password_of("lise"))
    assert status == 0, said
    assert Path(json.loads(said)["path"]).exists()
    assert recorded_by(data, "lise")[-1] == "evidence_exported"


@pytest.mark.sqlite("backups and journal: a server has its own")
@pytest.mark.slow
def test_a_backup_is_restored_in_the_name_of_an_account_with_its_password_only(data: Path, tmp_path: Path) -> None:
    backup, destination = tmp_path / "backup", tmp_path / "restored"
    made = CliRunner().invoke(app, ["store", "backup", str(backup), "--data", str(data)], catch_exceptions=False)
    assert made.exit_code == 0, made.output
    words = ["store", "restore", str(backup), str(destination), "--operator", "Grace", "--password-stdin", "--json"]
    refused = CliRunner().invoke(app, words, input="guessed\n", catch_exceptions=False)
    assert refused.exit_code == 1
    assert "name and password do not belong together" in refused.output.lower()
    assert list(destination.iterdir()) == []
    restored = CliRunner().invoke(app, words, input=f"{password_of('grace')}\n", catch_exceptions=False)
    assert restored.exit_code == 0, restored.output
    assert "data_restored" in recorded_by(destination, "grace")
