"""The suite's own rules: what is drawn, what runs again, what a test costs, and that marks follow from it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.plugins.collecting import dearest_first, is_compiled
from tests.plugins.cost_limit import CostLimit
from tests.plugins.cpu_record import cpu_s_of_tree
from tests.plugins.draw import drawn
from tests.support.suite.marks import costs_of, disagreements, remarked, settled

ROOT = Path(__file__).parents[2]
SETTINGS = "[pytest]\naddopts = -p no:schemathesis\nmarkers =\n    slow\n    realtime\n    whole\n    sweep\n"


def test_marks_stand_in_the_test_files_in_which_the_makefile_looks_for_them() -> None:
    """It names the files of a mark, so that pytest reads no others; tests/browser it names whole."""
    marks = re.compile(r"mark\.(slow|realtime|packages|whole|sweep)\b")
    files = [path for path in (ROOT / "tests").rglob("*.py") if not path.name.startswith("test_")]
    assert [str(path.relative_to(ROOT)) for path in files if marks.search(path.read_text())] == [
        "tests/browser/conftest.py",
        "tests/support/suite/marks.py",  # sets the marks
    ]


def test_large_libraries_that_few_tests_need_are_imported_within_them() -> None:
    """Every worker collects every file, and would load them for nothing."""
    large = "highdicom|libcst|mlcroissant|mutmut|pandas|scipy.stats|torch|transformers|tests.support.mutants.places"
    at_the_top = re.compile(rf"(?m)^(?:from|import) (?:{large})\b.*")
    below = re.compile(r"(?m)^(?:@|def |class |[A-Z_]+(?: =|:))")  # what stands there may be a text with imports
    read = [path for path in (ROOT / "tests").rglob("*.py") if path != ROOT / "tests/support/mutants/places.py"]
    found = {str(path): at_the_top.findall(below.split(path.read_text(), maxsplit=1)[0]) for path in read}
    assert {path: lines for path, lines in found.items() if lines} == {}


def pytest_in(folder: Path, source: str, *words: str, conftest: str = "") -> subprocess.CompletedProcess[str]:
    """Run the tests of `source` in a process of their own, with this suite's settings and plug-ins."""
    (folder / "pytest.ini").write_text(SETTINGS)
    (folder / "conftest.py").write_text((ROOT / "tests/conftest.py").read_text() + conftest)
    (folder / "test_it.py").write_text(source)
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rA", *words],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_tenth_is_drawn_by_the_seed_and_every_unit_has_its_turn() -> None:
    units = [f"tests/test_{number}.py" for number in range(25)]
    assert len(drawn("a", units)) == 2
    assert drawn("a", units) == drawn("a", reversed(units))
    assert set.union(*(drawn(str(seed), units) for seed in range(100))) == set(units)
    assert drawn("a", []) == set()


def test_whole_runs_are_drawn_by_file_sweeps_by_row_and_what_was_drawn_is_printed(tmp_path: Path) -> None:
    source = """
import pytest
@pytest.mark.whole(always=True)
def test_always(): pass
@pytest.mark.whole(drawn=False)
def test_too_long(): pass
@pytest.mark.sweep
@pytest.mark.parametrize("row", range(20))
def test_row(row): pass
always, sweep = pytest.mark.sweep(always=True), pytest.mark.sweep
@pytest.mark.parametrize("row", [pytest.param(0, marks=always), *(pytest.param(k, marks=sweep) for k in range(1, 9))])
def test_covered(row): pass
def test_other(): pass
"""
    answer = pytest_in(tmp_path, source, "--draw", "seed")
    assert "drawn by seed: 3 of 28 marked sweep" in answer.stdout
    assert "6 passed, 26 deselected" in answer.stdout


@pytest.mark.slow
def test_only_the_body_of_a_test_that_meets_the_clock_runs_again(tmp_path: Path) -> None:
    source = """
import pytest
calls = []
def fails_once(name):
    calls.append(name)
    assert calls.count(name) > 1, f"first of {name}"
@pytest.fixture(scope="module")
def broken(): fails_once("set-up")
@pytest.mark.realtime
def test_late(): fails_once("late")
def test_other(): fails_once("other")
@pytest.mark.realtime
def test_not_set_up(broken): pass
"""
    once = pytest_in(tmp_path, source, "--force-reruns", "0")  # as bench.suite.realtime runs them
    assert "2 failed, 1 error" in once.stdout
    answer = pytest_in(tmp_path, source)
    assert "1 failed, 1 passed, 1 error, 1 rerun" in answer.stdout
    assert "1 realtime tests ran again" in answer.stdout
    assert "first failure of test_it.py::test_late" in answer.stdout


@pytest.mark.slow
def test_one_worker_compiles_a_file_and_the_others_read_what_it_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "")
    files = [tmp_path / f"test_{number}.py" for number in range(12)]
    for file in files:
        file.write_text("def test_it():\n" + "    assert 1 + 1 == 2\n" * 200)
    notes_who_compiles = """
import sys
def note(event, words):
    if event == "compile" and "test_" in str(words[1]):
        with open("compiled", "a") as file:
            print(words[1], os.getpid(), file=file)
sys.addaudithook(note)
"""
    answer = pytest_in(tmp_path, "def test_it(): pass", "-n", "2", conftest=notes_who_compiles)
    assert "13 passed" in answer.stdout, answer.stdout
    assert all(map(is_compiled, files))
    compiled = set((tmp_path / "compiled").read_text().splitlines())
    assert len({line for line in compiled if Path(line.split()[0]) in files}) == len(files), "one process a file"
    files[0].write_text("def test_it(): pass\n")
    os.utime(files[0], (2e9, 2e9))
    assert not is_compiled(files[0])


def test_the_dearest_files_come_first_and_those_of_the_browser_stay_together(tmp_path: Path) -> None:
    cheap, dear, pages = "tests/test_a.py", "tests/test_b.py", "tests/browser/test_"
    costs = {cheap: {"test": 0.1}, dear: {"test": 5.0}, f"{pages}1.py": {"test": 0.0}, f"{pages}2.py": {"test": 9.0}}
    tests = [f"{pages}1.py::test", f"{cheap}::test[1]", f"{pages}2.py::test", f"{cheap}::test[2]", f"{dear}::test"]
    assert [tests[k] for k in dearest_first(tests, costs)] == [tests[k] for k in (0, 2, 4, 1, 3)]
    assert dearest_first([f"{dear}::test", "tests/test_whole_run.py::test"], costs) == [1, 0]

    dearer = "\n".join(f"def test_{n}(): pass" for n in range(3))
    (tmp_path / "test_other.py").write_text(dearer)
    (tmp_path / "test_third.py").write_text(
        dearer.replace("def test_0", "import pytest\n@pytest.mark.slow\ndef test_0")
    )
    answer = pytest_in(tmp_path, "def test(): pass", "--collect-only", "-m", "not slow")
    files = list(dict.fromkeys(re.findall(r"(?m)^(test_\w+\.py)::", answer.stdout)))
    assert files == ["test_other.py", "test_third.py", "test_it.py"], "what does not run does not count"


@pytest.mark.slow
def test_the_cost_of_a_test_has_its_processes_and_its_share_of_fixtures(tmp_path: Path) -> None:
    source = """
import subprocess, sys, pytest
WORK = "import time\\nwhile time.process_time() < 0.6: pass"
@pytest.fixture(scope="module")
def shared(): exec(WORK.replace("0.6", f"{__import__('time').process_time()} + 0.8"))
def test_alone(): subprocess.run([sys.executable, "-c", WORK], check=True)
def test_one(shared): pass
@pytest.mark.parametrize("row", range(3))
def test_rows(shared, row): pass
"""
    answer = pytest_in(tmp_path, source, "--cpu-record=cpu", "-n", "0")
    assert answer.returncode == 0, answer.stdout
    costs = costs_of(tmp_path / "cpu")["test_it.py"]
    assert 0.5 < costs["test_alone"] < 1.5
    assert costs["test_one"] == pytest.approx(0.2, abs=0.15)  # a fourth of 0.8
    assert costs["test_rows"] == pytest.approx(0.2, abs=0.15)


def test_the_tree_of_a_process_counts_children_that_still_run() -> None:
    before_s = cpu_s_of_tree(os.getpid())
    work = "import time\nwhile time.process_time() < 0.5: pass\nprint('done', flush=True)\ninput()"
    with subprocess.Popen([sys.executable, "-c", work], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert cpu_s_of_tree(os.getpid()) - before_s > 0.4
        child.communicate(b"\n")


def test_marks_follow_from_the_costs_and_the_check_names_what_disagrees() -> None:
    source = (
        "import pytest\n\n\n@pytest.mark.slow\n@pytest.mark.timeout(9)\ndef test_cheap() -> None: ...\n\n\n"
        "class TestClass:\n    def test_dear(self) -> None: ...\n"
    )
    costs = {"test_cheap": 0.1, "TestClass::test_dear": 3.0}
    assert remarked(source, costs, 0.8) == (
        "import pytest\n\n\n@pytest.mark.timeout(9)\ndef test_cheap() -> None: ...\n\n\n"
        "class TestClass:\n    @pytest.mark.slow\n    def test_dear(self) -> None: ...\n"
    )
    assert disagreements({"a": costs}, {"a": remarked(source, costs, 0.8)}) == []
    assert disagreements({"a": {"test_gone": 0.1}, "b": {}}, {"a": source}) == [
        "a::TestClass::test_dear was not measured",
        "a::test_cheap was not measured",
        "a::test_gone is on the list and not in the file",
        "b is on the list and does not exist",
    ]
    assert "a::test_cheap costs 0.1 CPU s and is marked slow" in disagreements({"a": costs}, {"a": source})
    whole = "import pytest\n\npytestmark = [pytest.mark.slow]\n"
    assert "marked for the whole file" in disagreements({}, {"a": whole})[0]


@pytest.mark.parametrize(
    ("before_s", "now_s", "listed_s"),
    [
        (None, 1.234, 1.2),
        (0.5, 0.6, 0.5),
        (0.5, 0.9, 0.9),
        (0.9, 1.15, 0.9),
        (0.9, 1.3, 1.3),
        (1.1, 0.85, 1.1),
        (9, 0.5, 0.5),
    ],
)
def test_a_measurement_near_the_limit_changes_no_mark(before_s: float | None, now_s: float, listed_s: float) -> None:
    assert settled(before_s, now_s, 1.0) == listed_s


def test_the_list_is_written_from_records_and_then_the_check_is_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_it.py").write_text("from tests.support import x\n\n\ndef test_it() -> None: ...\n")
    (tmp_path / "cpu").mkdir()
    record = {"kind": "test", "test": "tests/test_it.py::test_it", "cpu_s": 5.0, "shared": []}
    (tmp_path / "cpu/main.jsonl").write_text(json.dumps(record) + "\n")

    def marks(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "bench.suite.marks", *words],
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
        )  # fmt: skip

    unmeasured = marks("--check")
    assert (unmeasured.returncode, "test_it was not measured" in unmeasured.stderr) == (1, True)
    assert marks("cpu").returncode == 0
    assert marks("--check").returncode == 0
    marked = (tmp_path / "tests/test_it.py").read_text()
    assert marked.startswith("import pytest\n\nfrom tests")
    assert "@pytest.mark.slow\ndef test_it" in marked
    assert json.loads((tmp_path / "tests/cpu_seconds.json").read_text()) == {"tests/test_it.py": {"test_it": 5.0}}


def test_tests_that_cost_more_than_asked_for_are_left_out(tmp_path: Path) -> None:
    items = [
        SimpleNamespace(nodeid=f"tests/code_rules/test_suite_rules.py::{name}")
        for name in ("test_dear[row-1]", "TestAll::test_dear_too", "test_cheap", "test_unknown")
    ]
    costs = {"test_dear": 2.0, "TestAll::test_dear_too": 9.0, "test_cheap": 1.9}
    left_out: list[SimpleNamespace] = []
    config: Any = SimpleNamespace(hook=SimpleNamespace(pytest_deselected=lambda *, items: left_out.extend(items)))
    limit = CostLimit(2.0, {"tests/code_rules/test_suite_rules.py": costs})
    limit.pytest_collection_modifyitems(config, items)  # pyright: ignore[reportArgumentType]
    assert [item.nodeid.rpartition("::")[2] for item in items] == ["test_cheap", "test_unknown"]
    assert len(left_out) == 2
