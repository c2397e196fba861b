"""No text is markup, and none is obeyed by a terminal, wherever it comes from and wherever it is printed."""

from __future__ import annotations

import ast
import json
import logging
import sys
from pathlib import Path

import pytest
import typer
from rich.markup import escape  # noqa: TID251 - what Typer would take for markup

from service.audit import bundle_verifier
from service.cli import main as command_line
from service.cli.common import print_document, print_json, reporting_errors
from service.core.errors import ConfigurationError
from service.core.words import shown, shown_json, shown_lines
from service.logs import EscapingFormatter
from tests.support.every_command import every_command
from tests.support.hostile_places import ON_A_TERMINAL, TYPED_IN, printed_at, typed_in
from tests.support.hostile_text import HOSTILE, TYPED, obeyed
from tests.support.rig.rig import REPOSITORY

texts = pytest.mark.parametrize("text", HOSTILE.values(), ids=list(HOSTILE))


@texts
@pytest.mark.parametrize("place", ON_A_TERMINAL)
def test_a_text_is_shown_as_it_is_with_escapes(place: str, text: str) -> None:
    printed = printed_at(place, text)
    assert obeyed(printed) == []
    assert printed.encode()
    for line in text.split("\n"):
        assert shown(line) in printed
    if place not in ("a box", "a table"):  # which have an edge
        assert not any(line.startswith("Verified") for line in printed.splitlines())


@texts
def test_the_verifier_of_bundles_escapes_the_same_characters(text: str) -> None:
    assert bundle_verifier.shown(text) == shown(text)


def test_the_verifier_and_the_program_agree_on_every_character() -> None:
    every = "".join(map(chr, range(sys.maxunicode + 1)))
    assert bundle_verifier.shown(every) == shown(every)


@texts
def test_json_stays_the_same_and_can_be_printed(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    print_json({text: [text]})
    printed = capsys.readouterr().out
    assert obeyed(printed) == []
    assert json.loads(printed) == json.loads(json.dumps({text: [text]}))
    assert shown_json('"é 漢"') == '"é 漢"'


@texts
def test_a_document_keeps_its_lines(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    print_document(f"# {text}\n\nlast\n")
    printed = capsys.readouterr().out
    assert obeyed(printed) == []
    assert printed == f"# {shown_lines(text)}\n\nlast\n"


@texts
@pytest.mark.parametrize("as_json", [False, True])
def test_an_error_is_told(text: str, as_json: bool, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, reporting_errors(as_json):
        raise ConfigurationError(text, where=text, remedy=text)
    assert ended.value.exit_code == 1
    printed = capsys.readouterr()
    assert obeyed(printed.out + printed.err) == []
    if as_json:
        told = {name: value for name, value in json.loads(printed.out)["error"].items() if name != "kind"}
        assert told == dict.fromkeys(("what", "where", "remedy"), shown_lines(text))
    else:
        assert printed.err.count(shown(text.split("\n", maxsplit=1)[0])) >= 3


@texts
def test_a_fault_of_the_program_ends_with_json_too(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, reporting_errors(json=True):
        raise ZeroDivisionError(text)
    assert ended.value.exit_code == 1
    told = json.loads(capsys.readouterr().out)["error"]
    assert told["kind"] == "ZeroDivisionError"
    assert told["trace"]
    with pytest.raises(ZeroDivisionError), reporting_errors(json=False):
        raise ZeroDivisionError(text)


@texts
def test_a_traceback_is_escaped(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails() -> None:
        raise ZeroDivisionError(text)

    monkeypatch.setattr(command_line, "app", fails)
    monkeypatch.setattr(command_line, "show_own_words_only", lambda: None)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == 1
    assert obeyed(capsys.readouterr().err) == []


@texts
def test_a_message_of_the_log_is_escaped(text: str) -> None:
    record = logging.LogRecord("drivers", logging.WARNING, __file__, 1, "the device says %s", (text,), None)
    printed = EscapingFormatter("%(name)s %(message)s").format(record)
    assert obeyed(printed) == []
    assert len([line for line in printed.splitlines() if not line.startswith("    ")]) == 1


@pytest.mark.parametrize("text", [HOSTILE["brackets that close nothing"], TYPED], ids=["brackets", "all"])
@pytest.mark.parametrize("words", TYPED_IN, ids=" ".join)
def test_what_was_typed_is_repeated_with_escapes(
    words: tuple[str, ...], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, printed, fault = typed_in(words, text)
    assert fault is None
    assert status in (0, 1, 2)
    assert obeyed(printed) == []
    assert not any(line.startswith("Verified") for line in printed.splitlines())
    assert sorted(tmp_path.iterdir()) == []


def test_no_help_has_what_typer_takes_for_markup() -> None:
    seen: list[str] = []
    for name, command in every_command():
        for text in (command.help, *(getattr(one, "help", None) for one in command.params)):
            assert escape(text or "") == (text or ""), f"{name}: square brackets vanish from its help"
        seen.append(name)
    assert len(seen) > 50


def test_no_help_of_a_simulator_has_it_either() -> None:
    for path in sorted((REPOSITORY / "simulators").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "help" and isinstance(node.value, ast.Constant):
                text = str(node.value.value)
                assert escape(text) == text, f"{path.name}:{node.lineno}: square brackets vanish from this help"
