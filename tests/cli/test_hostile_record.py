"""A record whose every text means harm: all that reads it prints it with escapes, and all that exports it works."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit.verify import bundle_verifier
from service.cli.main import app
from service.cli.terminal_output import Terminal
from service.core.records.events import DeviceTrouble, OperatorAction, StepNote
from service.core.shown_text import shown
from service.store.durable_effects import DurableFiles, SystemClock
from service.store.records import NewArtefact
from service.store.signatures.second_place import SecondPlace, away_words
from service.store.signatures.signing import checkpoint, rotate_key
from tests.support.hostile_text import HOSTILE, obeyed
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

COMMANDS = {
    "show": ["audit", "show", "{run}"],
    "verify": ["audit", "verify", "{run}"],
    "verify all": ["audit", "verify", "all"],
    "keys": ["audit", "keys"],
    "status": ["status", "{run}"],
    "runs": ["runs"],
    "compare": ["compare", "{run}", "{other}"],
    "history": ["history"],
    "replay": ["replay", "{run}"],
    "leftovers": ["store", "gc"],
    "release": ["audit", "release", "{run}"],
    "plan": ["plan", "suggested", "{run}"],
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A completed run and an open one, with each text in the place of names, notes, reasons, messages and devices."""
    folder = tmp_path_factory.mktemp("hostile")
    with bench_store(folder / "data") as store:
        completed, waiting = begin_run(store, PROTOCOL, folder), begin_run(store, PROTOCOL, folder)
        for text in HOSTILE.values():
            ref = store.put_bytes(text.encode("utf-8", "replace"), kind="log", media_type="x", original_name=text)
            said = [
                StepNote(step="capture", attempt=1, note=text, data={text: text, "file": ref.model_dump()}),
                DeviceTrouble(device=text, error=text, message=text),
                OperatorAction(action="redo", step=text, viewpoint=text, reason=text, meaning=text),
                OperatorAction(action="skip", step="fixation", reason=text),
            ]
            store.record(waiting.run_id, said, actor=text, artefacts=[NewArtefact(ref, text, step=text, who=text)])
        for text in HOSTILE.values():
            said = [DeviceTrouble(device=text, error=text, message=text)]
            store.record(completed.run_id, said, actor=text)
        assert completed.run().status == "completed"
        checkpoint(store, completed.run_id)
        checkpoint(store, waiting.run_id)
        for text in (HOSTILE["rows above erased"], HOSTILE["NUL"]):
            rotate_key(store, reason=text, actor=text)
    return folder / "data", completed.run_id, waiting.run_id


@pytest.mark.parametrize("which", ["completed", "open"])
@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_that_reads_it_prints_escapes(recorded: tuple[Path, str, str], name: str, which: str) -> None:
    data, *runs = recorded
    run, other = runs if which == "completed" else reversed(runs)
    words = [word.format(run=run, other=other) for word in COMMANDS[name]] + ["--data", str(data)]
    done = CliRunner().invoke(app, words, env={"COLUMNS": "250"})
    assert isinstance(done.exception, SystemExit | None), done.exception
    assert done.exit_code in (0, 1, 2), done.output
    assert obeyed(done.output) == []
    verdicts = [line for line in done.output.splitlines() if line.startswith("Verified")]
    assert len(verdicts) == (1 if name.startswith("verify") else 0), verdicts
    if name == "show" and which == "open":
        assert "[bold red]x[/]" in done.output
        assert "\\x1b[3A" in done.output
    if name not in ("history", "plan"):
        told = CliRunner().invoke(app, [*words, "--json"])
        assert obeyed(told.stdout) == []
        json.loads(told.stdout)


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
