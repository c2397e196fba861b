"""Makes collecting cheap: without a search for garbage, and each file is compiled by one worker alone.

The order of files is chosen here, too: the dearest first.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import json
import os
import sys
from collections import defaultdict
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.processes.memory import spend_memory_rather_than_time

TESTS = Path(__file__).parents[1]
_BROWSER = "tests/browser/"  # its files share a browser, which ends with the last of those that run in a row
_UNKNOWN_S = 100.0  # of a test that is not on the list: of a whole run, which is begun before all others
Costs = Mapping[str, Mapping[str, float]]  # file → test function → CPU seconds


def is_compiled(path: Path) -> bool:
    """Whether pytest has kept the byte code of a test file as it is now."""
    kept = path.parent / "__pycache__" / f"{path.stem}.{sys.implementation.cache_tag}-pytest-{pytest.__version__}.pyc"
    return kept.exists() and kept.stat().st_mtime >= path.stat().st_mtime


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    """Look for no garbage while tests are collected, and never again among what was made by that."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        spend_memory_rather_than_time()
        gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let one worker compile a file while the others wait for it: in a fresh clone all of them begin at once."""
    config = collector.config
    shared = _is_worker(config) and not (sys.dont_write_bytecode or sys.pycache_prefix)
    if not (shared and isinstance(collector, pytest.Module)) or is_compiled(collector.path):
        return (yield)
    with _alone(config):
        if not is_compiled(collector.path):
            return (yield)
    return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config) -> Generator[None, object, object]:
    """Let one worker read the constants of the program for Hypothesis, which keeps them for the others."""
    with _alone(config) if _is_worker(config) else contextlib.nullcontext():
        return (yield)


def _is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


@contextmanager
def _alone(config: pytest.Config) -> Generator[None]:
    """Do something while no other process of these tests does."""
    folder = os.open(config.rootpath, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def listed_costs() -> Costs:
    """Return what each test function costs, as `make marks` has listed it."""
    listed = TESTS / "cpu_seconds.json"
    return json.loads(listed.read_text()) if listed.exists() else {}


def listed_name(test: str) -> tuple[str, str]:
    """Return the file of a test and its name as the list of costs has them, without the row of a parametrised test.

    >>> listed_name("tests/test_a.py::TestB::test_c[row-1]")
    ('tests/test_a.py', 'TestB::test_c')
    """
    file, _, name = test.partition("[")[0].partition("::")
    return file, name


def dearest_first(tests: Sequence[str], costs: Costs) -> list[int]:
    """Return the order of tests with the dearest files first, so that none keeps one process busy at the end.

    >>> dearest_first(["a::one", "a::two", "b::one"], {"a": {"one": 1.0, "two": 1.0}, "b": {"one": 3.0}})
    [2, 0, 1]
    """
    places: list[str] = []
    cost_s: dict[str, float] = defaultdict(float)
    for test in tests:
        file, name = listed_name(test)
        places.append(_BROWSER if file.startswith(_BROWSER) else file)
        cost_s[places[-1]] += costs.get(file, {}).get(name, _UNKNOWN_S)
    return sorted(range(len(tests)), key=lambda k: -cost_s[places[k]])
