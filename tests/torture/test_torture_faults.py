"""A short fault matrix: cases of each device obey the rules and the table.

A program that breaks a rule is detected.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from service.store.store import Store
from tests.support.rig.rig import REPOSITORY
from tests.support.runs.bench_run import PROTOCOL, begin_run
from tests.support.runs.drawn_rows import rows_to_run
from tests.support.torture.faults.judgement import rules
from tests.support.torture.faults.judgement.table import DOCUMENT, Row, differences, read_table, report, table
from tests.support.torture.faults.judgement.verdict import Verdict, masked
from tests.support.torture.faults.matrix import COLUMNS, cases
from tests.support.torture.faults.place.person import Motions

# One case of each device that ends the same way on any machine; for the robot also one of its own faults.
CHOSEN = (
    "robot/rtde/inputs/reject",
    "robot/itself/protective_stop",
    "camera/ptpip/file/drop",
    "lightbox/serial/light/corrupt",
    "table/itself/door_tapped",
    "kuka/itself/protective_stop",
    "video/itself/frozen",
    "gige/gvsp/payload/drop",
    "scanner/export/half_written",
    "store/disk_full/commit_02",
)
SILENT = """
import runpy
import service.store.database.engine as database
database._advise = lambda _error: ""  # a store that says what is wrong, and not what to do
runpy.run_module("bench.torture.faults", run_name="__main__")
"""


def sweep(folder: Path, *words: str, code: str = "") -> tuple[int, str, list[dict[str, Any]]]:
    """Status, output and verdicts of the sweep, run in a process without threads because it forks."""
    program = ["-c", code] if code else ["-m", "bench.torture.faults"]
    done = subprocess.run(
        [sys.executable, *program, *words, "--out", str(folder / "verdicts.json")],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert (folder / "verdicts.json").exists(), done.stdout + done.stderr
    return done.returncode, done.stdout, json.loads((folder / "verdicts.json").read_text())


@pytest.fixture(scope="module")
def tried(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Verdicts of the cases that are tested this time: one process prepares the record that all of them need."""
    folder = tmp_path_factory.mktemp("faults")
    return {one["name"]: one for one in sweep(folder, "--only", *rows_to_run(request, "case"))[2]}


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.timeout(1800)  # the first of them waits for the others
@pytest.mark.parametrize("case", CHOSEN)
def test_the_case_goes_as_the_table_says(tried: dict[str, dict[str, Any]], case: str) -> None:
    verdict = tried[case]
    assert verdict["broken"] == []
    assert verdict["reached"]
    as_tried = Verdict(**{key: value for key, value in verdict.items() if key != "commit"})
    assert differences([as_tried], read_table(DOCUMENT)) == []


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.timeout(400)
def test_a_store_that_does_not_say_what_to_do_shows(tmp_path: Path) -> None:
    status, _, (verdict,) = sweep(tmp_path, "--only", "store/disk_full/commit_02", code=SILENT)
    assert status == 1
    assert any(fault.startswith("no place or no remedy") for fault in verdict["broken"]), verdict


def test_a_motion_that_nobody_confirmed_shows(tmp_path: Path) -> None:
    early, late, stopped = Motions(), Motions(), Motions()
    early.began()
    with Store.open(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.run()
        events = store.events(bench.run_id)
    late.began()
    stopped.stopped_s.append(time.monotonic())
    stopped.begun_s.append(time.monotonic() + 1.0)

    def broken(motions: Motions) -> list[str]:
        return rules.broken(events, motions, tmp_path / "data", (), "completed", ())

    assert broken(late) == []
    assert broken(early) == ["the arm moved, and nobody had confirmed"]
    assert broken(stopped) == ["the arm moved after a stop, and nobody had confirmed since"]
    assert rules.broken(events, late, tmp_path / "data", ("v009",), "completed", ()) == ["v009 is not in the record"]


def test_every_kind_of_message_is_spoilt_in_every_way_that_its_wire_has() -> None:
    names = cases()
    for device, kinds in (
        ("robot", 10), ("camera", 11), ("canon", 8), ("lightbox", 5), ("table", 8), ("kuka", 8), ("gige", 8),
        ("listen", 7),
    ):  # fmt: skip
        wires = {name.rsplit("/", 1)[0] for name, case in names.items() if case.spoil and name.startswith(device)}
        assert len(wires) == kinds
        for wire in wires:
            there = {name.rsplit("/", 1)[1] for name in names if name.startswith(f"{wire}/")}
            checked_by_udp = {"corrupt", "mutated"} if wire == "gige/gvsp/payload" else set()
            assert COLUMNS.keys() - there <= {"reject"} | checked_by_udp, wire


def test_the_table_is_read_as_it_is_written_and_differences_are_told(tmp_path: Path) -> None:
    some = list(cases().values())[:2]
    words = masked("no answer within 2.5 s [127.0.0.1:30004]. Look | at the `cable`")
    first = Verdict(some[0].name, True, [], ["retry", "ask"], ["DeviceTimeoutError"], words, "completed")
    second = Verdict(some[1].name, True, [], [], [], "", "completed")
    path = tmp_path / "faults.md"
    path.write_text(table(some, [first, second], {}))
    rows = read_table(path)
    assert rows == {some[0].name: Row.of(some[0], first), some[1].name: Row.of(some[1], second)}
    assert "no answer within N s" in rows[some[0].name].words
    assert differences([first, second], rows) == []
    second.policy.append("ask")
    assert differences([second], rows) == [
        f"{second.name}: ask / completed / ; the table says nothing / completed / "
    ]
    assert table(some, [], rows) == path.read_text(), "rows that were not tried stay"


def test_results_say_on_which_revision_each_case_was_tried_last(tmp_path: Path) -> None:
    names = list(cases())[:3]
    about = {"machine": {"processor": "P", "cores": 2}, "cases": 3, "options": [], "seconds": 1}
    for date, commit, tried in (("2026-11-01", "aaa", names[:2]), ("2026-11-02", "bbb", names[1:])):
        new = [{**Verdict(name, True, end="completed").told(), "commit": commit} for name in tried]
        day = about | {"date": date, "commit": commit}
        report(day, names, new, tmp_path / f"torture_faults-{date}")
    page = (tmp_path / "torture_faults-2026-11-02.md").read_text()
    assert "3 of 3 cases were tried" in page
    assert "| 2026-11-01 | aaa | 1 |\n| 2026-11-02 | bbb | 2 |" in page
