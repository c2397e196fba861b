"""Settings for all tests: repeatable examples, one thread of linear algebra, files in memory, dear files first."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.plugins import collecting
from tests.plugins.cost_limit import CostLimit
from tests.plugins.cpu_record import CpuRecord
from tests.plugins.draw import Draw

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, here and in child processes
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # begun in the background: what it starts would be deaf as well
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A scene's textures and light are computed once, and kept for the next tests (simulators/rendering/array_cache.py).
os.environ.setdefault("ORTHOCAPTURE_RENDER_CACHE", str(Path(__file__).parents[1] / "build" / "rendered"))

MOST_WORKERS = 12  # each takes up to half a GiB

# Each commit of the store waits for the disk, which is half the time of its tests. What a disk loses is simulated
# (bench.torture.crash), so a file system in memory proves as much, where there is room for the files of whole runs.
MEMORY, ROOM_BYTES = Path("/dev/shm"), 12 * 2**30
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# The same examples every time, so that a failure is due to the change. `--hypothesis-profile=default` tries new ones.
# They are not timed: a machine that is busy is no fault.
settings.register_profile(
    "repeatable", derandomize=True, database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of this suite."""
    parser.addoption(
        "--cpu-record", type=Path, metavar="DIR", help="write the CPU seconds of tests and fixtures to DIR"
    )
    parser.addoption("--cpu-below", type=float, metavar="S", help="leave out tests that cost S CPU seconds or more")
    parser.addoption("--draw", metavar="SEED", help="run a tenth of the whole runs and sweeps, chosen by SEED")
    parser.addoption("--database", choices=["postgresql"], help="run the tests of the record on PostgreSQL")
    parser.addoption(
        "--repeat", type=int, default=1, metavar="N", help="run every test N times (bench.suite.realtime)"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the plug-ins of this suite."""
    config.pluginmanager.register(collecting)
    directory: Path | None = config.getoption("--cpu-record")
    if directory is not None:
        config.pluginmanager.register(CpuRecord(directory / f"{os.environ.get('PYTEST_XDIST_WORKER', 'main')}.jsonl"))
    limit_s: float | None = config.getoption("--cpu-below")
    if limit_s is not None:
        config.pluginmanager.register(CostLimit(limit_s, collecting.listed_costs()))
    seed: str | None = config.getoption("--draw")
    if seed is not None:
        config.pluginmanager.register(Draw(seed))
    if config.getoption("--database") is not None:
        from tests.plugins.database import OnPostgres  # noqa: PLC0415 - it loads the store

        config.pluginmanager.register(OnPostgres(config))


@pytest.fixture
def one_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have jobs and commands compute within this process: to start more takes longer than what these would do."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return two workers a processor: tests of devices and servers wait for half of their time."""
    return min(2 * (os.cpu_count() or 1), MOST_WORKERS)


@pytest.hookimpl(trylast=True)  # once those that do not run have been left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the dearest files first. A test that meets the clock may run once more if it failed."""
    for item in items:
        if item.get_closest_marker("realtime") is not None:
            item.add_marker(pytest.mark.flaky(reruns=1))
    order = collecting.dearest_first([item.nodeid for item in items], collecting.listed_costs())
    items[:] = [items[k] for k in order]
    items *= int(config.getoption("--repeat") or 1)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Let the failure of a set-up stand: only the body of a test that meets the clock may run again."""
    report = yield
    if report.failed and report.when == "setup":
        item.add_marker(pytest.mark.flaky(reruns=0, condition=False), append=False)
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Count the tests that ran again, and print why each failed at first."""
    rerun = terminalreporter.getreports("rerun")
    if rerun:
        terminalreporter.section(f"{len(rerun)} realtime tests ran again")
    for report in rerun:
        terminalreporter.section(f"first failure of {report.nodeid}")
        terminalreporter.line(report.longreprtext)
