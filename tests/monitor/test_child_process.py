"""Child processes of the audit: one at a time per run, followed to their end, however they end."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from service.audit.background import ChildProcesses, ChildState, report
from service.core.errors import DataError
from service.store.durable_effects import SystemClock


def follow(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> ChildProcesses:
    """Children that run this text."""
    (folder / "the_child.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return ChildProcesses("the_child", "export", SystemClock())


def test_the_last_line_of_a_child_is_what_became_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = """print('{"what": "reading", "done": 1, "total": 2}')\nprint('{"result": "made.zip"}')"""
    children = follow(tmp_path, monkeypatch, text)
    kept: list[ChildState] = []
    assert children.state("run") is None
    assert children.start("run", [], by="ada", keep=kept.append)
    children.wait("run", 60)
    state = children.state("run")
    assert state is not None
    assert (state.by, state.result, state.problem, state.pending) == ("ada", "made.zip", "", False)
    assert kept == [state]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise SystemExit(1)", "the export ended without a result"),
        ("print('no JSON')", "the export could not be done"),
        ("""print('{"unheard": "of"}')""", "the export could not be done"),
        ("""print('{"problem": "the disk is full", "remedy": "Make room"}')""", "the disk is full"),
    ],
)
def test_a_child_without_a_result_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    children = follow(tmp_path, monkeypatch, text)
    children.start("run", [], by="ada", keep=lambda _: pytest.fail("there is nothing to keep"))
    children.wait("run", 60)
    state = children.state("run")
    assert state is not None
    assert state.problem.startswith(said)
    assert (state.pending, bool(state.remedy)) == (False, True)


def test_a_result_that_cannot_be_kept_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: ChildState) -> None:
        raise OSError("no space left")

    children = follow(tmp_path, monkeypatch, """print('{"result": "made.zip"}')""")
    children.start("run", [], by="ada", keep=full)
    children.wait("run", 60)
    state = children.state("run")
    assert state is not None
    assert (state.result, "no space left" in state.problem) == (None, True)


def test_one_child_at_a_time_for_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "import sys, pathlib\nwhile not pathlib.Path(sys.argv[1]).exists(): pass\nprint('{\"result\": 1}')"
    children = follow(tmp_path, monkeypatch, text)
    go = tmp_path / "go"
    assert children.start("run", [str(go)], by="ada")
    assert not children.start("run", [str(go)], by="grace")
    go.touch()
    children.wait("run", 60)
    assert children.start("run", [str(go)], by="grace")
    children.wait("run", 60)
    state = children.state("run")
    assert state is not None
    assert state.by == "grace"


def test_a_child_says_how_far_it_is_and_how_it_ended(capsys: pytest.CaptureFixture[str]) -> None:
    report(lambda progress: progress("reading", 1, 2) or "made.zip", outlives_parent=True)

    def fail(_: object) -> None:
        raise DataError("the image is damaged", where="a.jpg", remedy="Take it again")

    report(fail, outlives_parent=True)
    assert capsys.readouterr().out.splitlines() == [
        '{"what": "reading", "done": 1, "total": 2}',
        '{"result": "made.zip"}',
        '{"problem": "the image is damaged [a.jpg]", "remedy": "Take it again"}',
    ]


def test_only_a_child_that_outlives_its_parent_goes_on_unheard(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed:
        def write(self, _: str) -> None:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Closed())
    done: list[str] = []
    report(lambda progress: (progress("reading", 1, 2), done.append("all")), outlives_parent=True)
    assert done == ["all"]
    with pytest.raises(BrokenPipeError):
        report(lambda progress: progress("reading", 1, 2), outlives_parent=False)
