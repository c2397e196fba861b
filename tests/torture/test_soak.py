"""A short soak: each part at a small size, and its judgement of figures that creep, wait or slow down."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from sqlalchemy import text

from service.store.store import Store
from tests.support.rig.rig import REPOSITORY
from tests.support.soak.captures import figures_of
from tests.support.soak.creep import DATABASE_DESCRIPTORS, JUDGED_S, Sample, judge
from tests.support.soak.fit import Duration, exponent, growth
from tests.support.soak.large import judge as judge_large

pytestmark = [pytest.mark.timeout(600)]
SMALL = (
    "--minutes", "0.15", "--sample-s", "0.4", "--planned", "40", "--uncalibrated",
    "--viewpoints", "64", "--gigabytes", "0.02", "--together-minutes", "0.05",
    "--rounds", "2", "--images", "2", "--image-mb", "1",
)  # fmt: skip


@dataclass(frozen=True)
class Parts:
    """The folder with the results of the parts that are measured, each beside those before it."""

    results: Path

    def measured(self, part: str, **environment: str) -> dict[str, Any]:
        """Measure a part; returns its figures. Raises AssertionError if those of the others are lost."""
        before = {path: set(json.loads(path.read_text())) for path in self.results.glob("soak-*.json")}
        command = [sys.executable, "-m", "bench.soak", *SMALL, "--only", part, "--results", str(self.results)]
        subprocess.run(  # its exit status says whether it is fast enough, of which such a small size says nothing
            command, cwd=REPOSITORY, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, check=False
        )
        written = max(self.results.glob("soak-*.json"))
        found: dict[str, dict[str, Any]] = json.loads(written.read_text())
        assert set(found) == {part} | before.get(written, set())
        report = written.with_suffix(".md").read_text()
        assert all(f"`{name}`" in report for name in found)
        return found[part]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    return Parts(tmp_path_factory.mktemp("soak"))


@pytest.mark.slow
@pytest.mark.sweep
def test_captures_go_on_until_there_are_figures_of_each_program(parts: Parts) -> None:
    # with other than one thread nothing is forked: each program has its own memory
    found = parts.measured("captures", OPENBLAS_NUM_THREADS="2")
    assert found["faults"] == []
    assert found["captured"] >= 2
    figures = {"runner: threads", "driver of the robot: resident memory, MB", "database, MB"}
    figures |= {"simulated rig: threads", "worker: threads", "simulated camera: threads"}
    figures |= {"web: descriptors, but for the database", "web: descriptors of the database"}
    assert figures <= {row["what"] for row in found["rows"]}


@pytest.mark.slow
@pytest.mark.sweep
def test_many_programs_at_one_file_do_not_fail(parts: Parts) -> None:
    found = parts.measured("together")
    of_speed = (" waited ", "this says nothing")  # durations are not judged here
    assert [fault for fault in found["faults"] if not any(words in fault for words in of_speed)] == []
    assert {row["who"]: row["processes"] for row in found["rows"]} == {
        "runner": 1, "worker": 4, "status": 3, "pages": 3, "audit show": 2, "person": 1,
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.sweep
def test_a_large_run_is_read_at_four_sizes(parts: Parts) -> None:
    found = parts.measured("large")
    assert found["sizes"] == [8, 16, 32, 64]
    assert found["artefact_bytes"] > 0.014e9  # those taken by the runner itself are small
    assert found["disk_bytes"] < 0.5 * found["artefact_bytes"], "the photographs are not sparse"
    assert {"status", "audit show", "audit verify", "page: capture", "ingest of a viewpoint"} <= {
        row["what"] for row in found["rows"]
    }


@pytest.mark.slow
@pytest.mark.sweep
def test_speed_is_compared_for_each_kind_of_work(parts: Parts) -> None:
    found = parts.measured("speed")
    assert {row["what"] for row in found["rows"]} >= {"ingest", "verify, cached", "verify, from the disk"}


def samples(**per_capture: float) -> list[Sample]:
    """Six hundred samples over an hour, with noise; the named figures of the web process grow with each capture."""
    draw = random.Random(3)
    out: list[Sample] = []
    for number in range(600):
        grown = {name: rate * number for name, rate in per_capture.items()}
        web = {
            "own_mb": 100 + draw.gauss(0, 1) + grown.get("own_mb", 0),
            "rss_mb": 150 + draw.gauss(0, 1),
            "descriptors": 20 + draw.choice((0, 1)) + grown.get("descriptors", 0),
            "database_descriptors": 3 + 2 * (number > 300) + grown.get("database_descriptors", 0),
            "threads": 9.0,
        }
        sizes = {"database": 1000 * number, "write-ahead log": 4_000_000, "logs": 10 * number, "monitor": 900}
        out.append(Sample(number * JUDGED_S / 50, number, {"web": web}, sizes))
    return out


def test_what_stays_is_no_fault_and_what_creeps_is_one() -> None:
    assert judge(samples())["faults"] == []
    (fault,) = judge(samples(descriptors=0.01))["faults"]
    assert "web: descriptors" in fault
    (fault,) = judge(samples(database_descriptors=0.1))["faults"]
    assert fault == "web: descriptors of the database: 64.9, more than 33"
    (fault,) = judge(samples(own_mb=0.2))["faults"]
    assert "web: memory of its own" in fault
    assert "200" in fault
    assert judge(samples(own_mb=0.02))["faults"] == [], "it holds the events of the run"


def test_what_was_too_short_is_not_judged_and_too_few_samples_are_told() -> None:
    hasty = [Sample(s.at_s / 100, s.captured, s.processes, s.sizes) for s in samples(descriptors=0.01)]
    found = judge(hasty)
    assert (found["judged"], found["faults"]) == (False, [])
    assert "say nothing" in judge(samples()[:6])["faults"][0]


def test_memory_of_its_own_does_not_depend_on_other_programs(tmp_path: Path) -> None:
    """Both map the same file, as programs map the same libraries."""
    (tmp_path / "library").write_bytes(bytes(20_000_000))
    words = (
        "import mmap, signal, sys; file = open(sys.argv[1], 'rb'); "
        "pages = mmap.mmap(file.fileno(), 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ); "
        "sum(pages[::4096]); print('mapped', flush=True); signal.pause()"
    )
    with ExitStack() as ending:

        def begin() -> psutil.Process:
            command = [sys.executable, "-S", "-c", words, str(tmp_path / "library")]
            child = ending.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
            ending.callback(child.kill)
            assert child.stdout is not None
            child.stdout.readline()
            return psutil.Process(child.pid)

        first = begin()
        alone = figures_of(first)["own_mb"]
        begin()
        assert figures_of(first)["own_mb"] == pytest.approx(alone, abs=0.5)


def test_each_connection_to_the_database_is_bounded_and_counted_apart(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        before = figures_of(psutil.Process())
        with ExitStack() as reading:
            for _ in range(15):
                reading.enter_context(store.database.reading()).execute(text("SELECT 1 FROM heads")).all()
            most = figures_of(psutil.Process())
        for _ in range(100):
            with store.database.reading() as connection:
                connection.execute(text("SELECT 1 FROM heads")).all()
        after = figures_of(psutil.Process())
    assert before["database_descriptors"] < most["database_descriptors"] <= DATABASE_DESCRIPTORS.most
    assert after["database_descriptors"] <= most["database_descriptors"]
    assert before["descriptors"] == most["descriptors"]


def test_a_line_knows_how_well_it_is_known() -> None:
    exact = growth([0, 1, 2, 3, 4], [1, 3, 5, 7, 9])
    assert exact is not None
    assert exact.slope == pytest.approx(2)
    assert exact.half_width < 1e-6
    draw = random.Random(1)
    x = [number / 100 for number in range(400)]
    noisy = growth(x, [0.5 * one + draw.gauss(0, 1) for one in x])
    assert noisy is not None
    assert noisy.least < 0.5 < noisy.slope + noisy.half_width
    assert growth([1, 1, 1, 1, 1], [1, 2, 3, 4, 5]) is None


def test_what_grows_with_the_square_is_a_fault_and_so_is_a_slow_page() -> None:
    sizes = (1250, 2500, 5000, 10_000)
    assert exponent(sizes, [1, 2, 4, 8]) == pytest.approx(1)
    assert exponent(sizes, [1, 4, 16, 64]) == pytest.approx(2)

    def found(**seconds: float) -> list[str]:
        at = {n: {name: Duration(s * n / 10_000, s * n / 10_000) for name, s in seconds.items()} for n in sizes}
        at |= {n: at[n] | {"status": Duration(1, (n / 10_000) ** 2)} for n in sizes}
        return [fault for row in judge_large(at) for fault in row["faults"]]

    assert found() == ["status grows with the power 2.00 of the viewpoints"]
    assert len(found(**{"page: run": 1.4})) == 2
    assert len(found(**{"page: run": 0.9, "audit verify": 90})) == 1
