"""Time is injected: what decides by the time, or waits for it, takes the store's clock, which a test can set.

So few modules of the service call the host's clocks, and no test sleeps or looks at one, but those marked `realtime`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
CLOCKS = {
    "time": {
        "sleep", "monotonic", "monotonic_ns", "time", "time_ns", "perf_counter", "perf_counter_ns",
    },
    "datetime": {"now", "utcnow", "today"},
}  # fmt: skip
CLOCK = re.compile(r"\bimport (time|datetime)\b|\bfrom (time|datetime) import\b")

# The modules of the service that may call them.
SERVICE = {
    "service/store/durable_effects.py": "the clock of the host, which all others are given",
    # how long something took, for a report; nothing is decided by it
    "service/audit/replay.py": "measures how long a job took",
    "service/audit/verifications.py": "measures how long a verification took",
    "service/benchmark/measured.py": "measures how long a program took",
    "service/cli/audit.py": "measures how long a verification took, and says when it was",
    "service/cli/demo.py": "measures how long the demonstration took",
    "service/compute/matching/scores.py": "measures how long a pair of images took",
    "service/compute/sfm/estimate.py": "measures how long a reconstruction took",
    "service/compute/sfm/front_end.py": "measures how long a reconstruction took",
    "service/web/monitoring.py": "measures how long a page took",
    # the date of a file that is written now
    "service/audit/report.py": "the time of a report that is given none",
    "service/benchmark/running.py": "the time at which a benchmark ended",
    # what waits for another process, on a pipe, a socket or a file, which knows no other clock
    "service/audit/background.py": "a child says no more than its parent reads; and rests, so that pages come first",
    "service/cli/common.py": "a person at a terminal is shown progress only where it takes long",
    "service/cli/operators.py": "the time limit of a socket",
    "service/compute/sfm/colmap_process.py": "the time limit of a child process's answer",
    "service/machine/schedulers.py": "how long a scheduler has had no worker, and rests between tries to reach one",
    "service/machine/dask_files.py": "how long a file has not come",
    "service/store/verification/anchor_checks.py": "when anchors were compared, of a folder, which has no clock",
    "service/store/database/postgres.py": "a server is waited for, by the host's clock",
    "service/store/database/engine.py": "SQLite waits for another process, by the host's clock",
    "service/store/signatures/log.py": "waits for another process that signs, by the host's clock",
    "service/worker/pool.py": "in a child: looks whether the worker lives",
}

# The tests and their helpers that may: they are about processes, wires and machines outside the test's.
TESTS = {
    "tests/support/arms": "drivers and simulators of arms go by the host's clock",
    "tests/support/boards/arm_errors.py": "measures how long a calibration took, which a benchmark reports",
    "tests/support/pages/browser.py": "a browser goes by the host's clock",
    "tests/support/pages/technician.py": "a browser goes by the host's clock",
    "tests/support/pages/certificates.py": "certificates hold for the host's time",
    "tests/support/record/time_stamp_authority.py": "certificates hold for the host's time",
    "tests/support/mutants/trial.py": "ends a child process that takes too long",
    "tests/support/processes": "other processes go by the host's clock; until() is how a test waits for one",
    "tests/support/soak": "measures durations, which a benchmark reports, of programs that go by the host's clock",
    "tests/support/torture": "drivers, parsers and stores in processes of their own go by the host's clock",
    "tests/support/vendor": "other programs, which drive simulators in real time",
    "tests/support/rig/host_fake_driver.py": "runs in the driver's process",
    "tests/support/rig/world_watch.py": "looks at a simulator in real time",
}
# Those that still do, and shall not: this list only gets shorter.
STILL = {
    "tests/browser/whole_runs/test_browser_tasks.py",
    "tests/grbl/test_grbl_driver.py",
    "tests/grbl/test_grbl_late_lines.py",
    "tests/machine_vision/test_genicam_driver.py",
    "tests/machine_vision/test_gige_camera.py",
    "tests/machine_vision/test_video_driver.py",
    "tests/kuka/test_kuka_driver.py",
    "tests/kuka/test_kuka_fri.py",
    "tests/kuka/test_kuka_wire.py",
    "tests/robot/test_pose_stream.py",
    "tests/robot/test_ur_driver.py",
    "tests/robot/test_ur_driver_faults.py",
    "tests/server/test_serve_limits.py",
    "tests/system/test_demo.py",
    "tests/torture/test_torture_faults.py",
}


def _names(tree: ast.Module) -> dict[str, str]:
    """The names in a module of the modules, classes and functions that tell the time: name → `time`, `time.sleep`."""
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for one in node.names:
                if one.name in CLOCKS:
                    names[one.asname or one.name] = one.name
        elif isinstance(node, ast.ImportFrom) and node.module in CLOCKS:
            for one in node.names:
                if one.name in ("datetime", "date") or one.name in CLOCKS[node.module]:
                    names[one.asname or one.name] = f"{node.module}.{one.name}"
    return names


def _is_clock(node: ast.AST, names: dict[str, str]) -> bool:
    """Whether it names a function that tells the time, such as `time.sleep`: called, or handed on."""
    if not isinstance(node, ast.Attribute | ast.Name):
        return False
    first, *rest = ast.unparse(node).split(".")
    module, *called = [*names.get(first, "").split("."), *rest]
    return module in CLOCKS and bool(called) and called[-1] in CLOCKS[module]


def _is_marked(node: ast.AST) -> bool:
    """Whether a function or class is marked `realtime`."""
    marks = node.decorator_list if isinstance(node, ast.FunctionDef | ast.ClassDef) else []
    return any("mark.realtime" in ast.unparse(mark) for mark in marks)


def _marks_its_module(node: ast.stmt) -> bool:
    return isinstance(node, ast.Assign) and "pytestmark" in ast.unparse(node) and "mark.realtime" in ast.unparse(node)


def clock_lines(source: str) -> list[int]:
    """The lines of a module that sleep or look at the host's clock, but for those in what is marked `realtime`."""
    if CLOCK.search(source) is None:  # spares parsing most modules
        return []
    tree = ast.parse(source)
    if any(map(_marks_its_module, tree.body)):
        return []
    names = _names(tree)

    def lines(node: ast.AST) -> Iterator[int]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Attribute | ast.Name) and _is_clock(child, names):
                yield child.lineno
            elif not _is_marked(child):
                yield from lines(child)

    return list(lines(tree))


def _found(folder: str) -> dict[str, list[int]]:
    paths = sorted((REPOSITORY / folder).rglob("*.py"))
    calls = {path.relative_to(REPOSITORY).as_posix(): clock_lines(path.read_text("utf-8")) for path in paths}
    return {path: lines for path, lines in calls.items() if lines}


@pytest.mark.slow
def test_the_service_is_given_its_time() -> None:
    found = _found("service")
    assert not {path: lines for path, lines in found.items() if path not in SERVICE}, "take the store's clock"
    assert not SERVICE.keys() - found.keys(), "these modules look at no clock any more"


def test_no_test_sleeps_or_looks_at_the_clock() -> None:
    found = _found("tests")
    allowed = {path for path in found if any(Path(path).is_relative_to(place) for place in TESTS)}
    wrong = {path: lines for path, lines in found.items() if path not in allowed | STILL}
    assert not wrong, "wait for the event with until(), let a SteppedClock go on, or mark the test `realtime`"
    assert not STILL - found.keys(), "these have been mended: take them off the list"
    assert all(any(Path(path).is_relative_to(place) for path in allowed) for place in TESTS), "not needed any more"


def test_it_sees_clocks_by_any_name_and_leaves_out_what_is_marked() -> None:
    source = """
import time
import datetime
from datetime import datetime as when, UTC
from time import sleep as rest, gmtime
def test():
    time.sleep(1); rest(2)
    time.gmtime(); gmtime(); clock.sleep(1); clock.now()
    when.now(UTC)
    datetime.datetime.now(); datetime.date.today()
    call(wait=time.sleep)
@pytest.mark.realtime
def test_in_real_time():
    time.monotonic()
"""
    assert clock_lines(source) == [7, 7, 9, 10, 10, 11]
    assert clock_lines(f"{source}\npytestmark = [pytest.mark.slow, pytest.mark.realtime]\n") == []
