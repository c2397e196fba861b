"""Mutations: what is changed and what is left out, how they are drawn, and that a test that fails kills one."""

from __future__ import annotations

import ast
import json
import os
import py_compile
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.support.mutants.reach import RECORD, Reach, digest, files_of_tests
from tests.support.mutants.recorder import functions
from tests.support.mutants.subjects import SUBJECTS, TESTS
from tests.support.mutants.trial import Trial, copied_tree
from tests.support.rig.rig import REPOSITORY

MODULE = '''"""Words."""

from __future__ import annotations

import logging

__all__ = ["judge"]
LIMIT: float = 5.0
_LOG = logging.getLogger("a")


def judge(value: float, *, anew: bool = False) -> bool:
    """Say whether it is in limits."""
    if value < 0:
        raise ValueError("a value below nothing is none", value)
    _LOG.info("judged %s times", 3)
    note(value)
    return value <= LIMIT and not anew


def note(value: float) -> None:
    words = "for people to read"
    NOTES.append((value, words))


NOTES: list[tuple[float, str]] = []
'''


def tree(folder: Path, module: str = MODULE) -> Path:
    """A tree that has one file for each subject, and tests of one of them."""
    for patterns in SUBJECTS.values():
        for pattern in patterns:
            path = folder / pattern.replace("**/", "").replace("*", "made_up")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text('"""Nothing."""\n\nA, B = 1, len("b")\n')
    (folder / GATES).write_text(module)
    (folder / "tests" / "core").mkdir(parents=True)
    return folder


GATES = "service/core/gates.py"


def changes(folder: Path) -> dict[str, set[tuple[str, str]]]:
    """What the lines of the module become, by kind."""
    from tests.support.mutants.places import mutated, places  # noqa: PLC0415 - loads libcst: a second in every worker

    made = [mutated(folder, place) for place in places(folder, "gates", GATES)]
    found: dict[str, set[tuple[str, str]]] = {}
    for mutation in made:
        assert mutation is not None
        ast.parse(mutation.text)
        found.setdefault(mutation.place.kind, set()).add((mutation.before, mutation.after))
    return found


def test_every_condition_number_comparison_operand_and_statement_has_its_changes(tmp_path: Path) -> None:
    found = changes(tree(tmp_path))
    assert found["float"] == {("LIMIT: float = 5.0", f"LIMIT: float = {x}") for x in ("50.0", "0.5")}
    assert found["condition"] == {("if value < 0:", "if not (value < 0):")}
    last = "return value <= LIMIT and not anew"
    assert found["operand"] == {(last, "return value <= LIMIT"), (last, "return not anew")}
    assert (last, "return value < LIMIT and not anew") in found["swap_op"]
    assert (last, "return value <= LIMIT or not anew") in found["swap_op"]
    assert found["remove_unary_ops"] == {(last, "return value <= LIMIT and anew")}
    assert ("note(value)", "pass") in found["statement"]
    assert ("if value < 0:", "if value < 1:") in found["number"]
    assert any("anew: bool = True" in after for _, after in found["name"])


def test_what_no_result_depends_on_is_left_alone(tmp_path: Path) -> None:
    said = {text for of_kind in changes(tree(tmp_path)).values() for pair in of_kind for text in pair}
    for untouched in ("Words", "import logging", "__all__", "getLogger", "Say whether", "below nothing", "judged"):
        assert not any(untouched in text for text in said), untouched
    assert not any("XXfor people" in text for text in said)


def test_the_seed_alone_decides_and_no_subject_comes_short(tmp_path: Path) -> None:
    from tests.support.mutants.places import drawn  # noqa: PLC0415 - loads libcst

    folder = tree(tmp_path)
    first, again, other = (drawn(folder, seed, 24) for seed in ("1", "1", "2"))
    assert first == again
    assert [m.name for m in first] != [m.name for m in other]
    assert Counter(m.place.subject for m in first) == dict.fromkeys(SUBJECTS, 2)


def recorded(folder: Path, text: str) -> Reach:
    """Tests of the module, as they were recorded: one of its two functions is reached."""
    file = folder / "tests" / "core" / "test_gate.py"
    file.write_text(text)
    record = {
        "tests": {"tests/core/test_gate.py::test_limit": 0.1, "tests/core/test_gate.py::test_gone": 0.1},
        "files": {"tests/core/test_gate.py": digest(text)},
        "reached": {GATES: {"judge": [0, 1], "note": []}},
    }
    (folder / RECORD).parent.mkdir(parents=True, exist_ok=True)
    (folder / RECORD).write_text(json.dumps(record))
    return Reach(folder)


TEST = "from service.core.gates import judge\n\ndef test_limit() -> None:\n    assert judge(5.0)\n"


def test_the_tests_that_reach_a_line_are_chosen_and_changed_files_are_added_whole(tmp_path: Path) -> None:
    reach = recorded(tree(tmp_path), TEST)
    (limit,) = [line for line, text in enumerate(MODULE.splitlines(), 1) if "<= LIMIT" in text]
    (noted,) = [line for line, text in enumerate(MODULE.splitlines(), 1) if "NOTES.append" in text]
    assert [one.arguments for one in reach.selected("gates", GATES, limit)] == [
        ["tests/core/test_gate.py::test_limit"]
    ]
    assert reach.selected("gates", GATES, noted) == []
    rules = "service/core/protocol.py"  # has no function, so that no test is known to reach it
    assert [one.tests for one in reach.selected("gates", rules, 3)] == [("test_limit",)]
    (whole,) = reach.selected("gates", GATES, 8)  # a constant: whatever reaches the file
    assert whole.tests == ("test_limit",)
    (tmp_path / "tests/core/test_new.py").write_text(TEST)
    assert [one.arguments for one in Reach(tmp_path).selected("gates", GATES, noted)] == [["tests/core/test_new.py"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after", "outcome"),
    [("value < LIMIT", "killed"), pytest.param("value <= 2 * LIMIT", "survived", marks=pytest.mark.sweep)],
)
def test_a_mutation_is_killed_by_a_test_that_fails_and_the_tree_is_as_before(
    tmp_path: Path, after: str, outcome: str
) -> None:
    """The file is longer or not, and of the same second: byte code of either text is never taken for the other."""
    from tests.support.mutants.places import Place, mutated  # noqa: PLC0415 - loads libcst

    folder = tree(tmp_path)
    selected = recorded(folder, TEST).selected("gates", GATES, 18)
    (folder / "pyproject.toml").write_text(
        "[tool.pytest.ini_options]\nmarkers = ['packages', 'realtime', 'sweep', 'whole']\n"
    )
    option = 'def pytest_addoption(parser): parser.addoption("--cpu-below")\n'
    (folder / "conftest.py").write_text(option)
    place = Place("gates", GATES, 0, "test")
    mutation = mutated(folder, place)
    assert mutation is not None
    changed = type(mutation)(place, 18, "", "", MODULE.replace("value <= LIMIT", after))
    for _ in range(2):
        trial = Trial(folder, changed, selected)
        _, status, used = os.wait4(trial.pid, 0)
        verdict = trial.ended(status, used)
        assert verdict.outcome == outcome, verdict.by
        assert verdict.by == ("tests/core/test_gate.py::test_limit" if outcome == "killed" else "")
        assert (folder / GATES).read_text() == MODULE


def test_a_copied_tree_need_not_be_compiled_again(tmp_path: Path) -> None:
    module = "tests/support/mutants/subjects.py"
    py_compile.compile(str(REPOSITORY / module))
    copied = copied_tree(tmp_path / "tree", None)
    shown = subprocess.run(
        [sys.executable, "-v", "-c", "import tests.support.mutants.subjects"],
        cwd=copied, env={**os.environ, "PYTHONPATH": str(copied)}, capture_output=True, text=True, check=True,
    ).stderr  # fmt: skip
    assert re.search(rf"subjects\S*\.pyc matches {re.escape(str(copied / module))}", shown)


def test_the_record_is_of_tests_and_functions_that_exist() -> None:
    """`python -m bench.suite.mutants --reach` renews it; a few that have gone since do no harm, many hide holes."""
    record = json.loads((REPOSITORY / RECORD).read_text())
    present = set(files_of_tests(REPOSITORY))
    assert all(of.startswith("tests/") and (REPOSITORY / of).is_dir() for of in TESTS)
    tests: list[str] = list(record["tests"])
    assert sum(test.partition("::")[0] not in present for test in tests) < 0.1 * len(tests)
    reached: dict[str, dict[str, list[int]]] = record["reached"]
    there = {
        file: {span.name for span in functions(REPOSITORY / file)} if (REPOSITORY / file).exists() else set[str]()
        for file in reached
    }
    named = [(file, name) for file, of_file in reached.items() for name in of_file]
    gone = [(file, name) for file, name in named if name not in there[file]]
    assert len(gone) < 0.1 * len(named)
