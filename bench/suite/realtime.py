"""Runs each test that meets the clock many times beside load, without reruns, and says which failed and how often.

`python -m bench.suite.realtime --times 200 --record` starts eight pytest processes at once, beside four that only
compute, on however few cores there are: what passes here does not fail by chance in continuous integration, where
these tests run alone.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from bench.machine import REPOSITORY, RESULTS, commit, machine

BUSY = [sys.executable, "-c", "while True: pass"]


def run_at_once(processes: int, repeats: int, folder: Path, words: list[str]) -> list[Path]:
    """Run the tests `repeats` times in each of the processes; returns their reports (JUnit's XML)."""
    reports = [folder / f"{number}.xml" for number in range(processes)]
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "pytest", "-m", "realtime", "-n", "0", "-q", "--force-reruns", "0",
             "--repeat", str(repeats), f"--junitxml={report}", *words],
            cwd=REPOSITORY, stdout=subprocess.DEVNULL,
            # Simulators listen on addresses of their own for each process of pytest-xdist.
            env={**os.environ, "PYTEST_XDIST_WORKER": f"gw{number}"},
        )
        for number, report in enumerate(reports)
    ]  # fmt: skip
    for process in running:
        process.wait()
    return reports


def main() -> int:
    """Run them, and say which failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--processes", type=int, default=8)
    parser.add_argument("--busy", type=int, default=4, help="processes beside them that only compute")
    parser.add_argument("--record", action="store_true", help="write the results to bench/results")
    parser.add_argument("tests", nargs="*", default=["tests"], help="files or tests, instead of all")
    options = parser.parse_args()
    began_s = time.monotonic()
    passed: Counter[str] = Counter()
    failed: Counter[str] = Counter()
    why: dict[str, list[str]] = {}
    load = [subprocess.Popen(BUSY) for _ in range(options.busy)]
    try:
        with tempfile.TemporaryDirectory() as folder:
            repeats = -(-options.times // options.processes)
            for report in run_at_once(options.processes, repeats, Path(folder), options.tests):
                for case in ElementTree.parse(report).iter("testcase"):
                    name = f"{case.get('classname')}::{case.get('name')}"
                    broken = [child for child in case if child.tag in ("failure", "error")]
                    (failed if broken else passed)[name] += 1
                    why.setdefault(name, []).extend((child.get("message") or "")[:200] for child in broken)
    finally:
        for process in load:
            process.kill()
            process.wait()
    names = sorted(passed.keys() | failed.keys())
    today = datetime.now(UTC).date().isoformat()
    record = {
        "commit": commit(), "machine": machine(), "date": today,
        "minutes": round((time.monotonic() - began_s) / 60, 1), "processes": options.processes, "busy": options.busy,
        "tests": [{"test": n, "passed": passed[n], "failed": failed[n], "why": sorted(set(why[n]))} for n in names],
    }  # fmt: skip
    rows = [f"| `{name}` | {passed[name] + failed[name]} | {failed[name]} |" for name in names]
    told = [
        f"# Tests that meet the clock, {today}", "",
        f"{len(names)} tests, {options.processes} pytest processes at once beside {options.busy} busy ones on "
        f"{os.cpu_count()} cores, {record['minutes']} minutes, revision {record['commit']}.", "",
        "| test | times | failed |", "|---|---:|---:|", *rows, "",
        *(f"- `{name}`: {reason}" for name in names for reason in sorted(set(why[name]))),
    ]  # fmt: skip
    text = "\n".join(told).rstrip() + "\n"
    if options.record:
        (RESULTS / f"realtime-{today}.json").write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")
        (RESULTS / f"realtime-{today}.md").write_text(text)
    print(text)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
