"""What the embedded default costs beside an earlier revision: `python -m bench.record.embedded_cost --against DIR`.

DIR is a checkout of the earlier revision. Both take turns with the same work, each turn in processes of its own:
photographs recorded in a data folder, a run of 100,000 events verified and its auditor's pages served, and the whole
demonstration. Compared are CPU seconds, which other load hardly changes, turn by turn.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Container, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, RESULTS, commit, machine

# What runs in either checkout: only what both have.
_CAPTURES = """
import sys, time
from pathlib import Path
from service.store.store import Store
from service.store.records import NewArtefact
from tests.support.record.store import captured, start_run
with Store.open(Path(sys.argv[1])) as store:
    run = start_run(store)
    before_s = time.process_time()
    for k in range(int(sys.argv[2])):
        data = k.to_bytes(4, "big") * 250_000
        ref = store.put_bytes(data, kind="image", media_type="image/jpeg", original_name=f"v{k}.jpg")
        new = NewArtefact(ref, "camera", "capture", 1, f"v{k}", "Ada")
        store.record(run, [captured(ref, f"v{k}")], actor="camera", artefacts=[new])
    print((time.process_time() - before_s) / int(sys.argv[2]))
"""
_VERIFY = """
import sys, time
from pathlib import Path
from service.store.verification.verify import verify
before_s = time.process_time()
assert verify(Path(sys.argv[1])).ok
print(time.process_time() - before_s)
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, required=True, metavar="DIR", help="checkout of the earlier revision")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--demos", type=int, default=2, help="turns of the demonstration")
    parser.add_argument("--captures", type=int, default=200, help="photographs a turn")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    trees = {"now": REPOSITORY, "before": options.against.resolve()}
    figures: dict[str, dict[str, list[float]]] = {}

    def add(tree: str, found: Mapping[str, float]) -> None:
        for name, value in found.items():
            figures.setdefault(name, {"now": [], "before": []})[tree].append(value)

    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(max(options.turns, options.demos)):
            for name in list(trees) if turn % 2 == 0 else list(reversed(trees)):
                work = Path(scratch) / name
                work.mkdir(exist_ok=True)
                if turn < options.turns:
                    add(name, _record(trees[name], work, turn, options.captures))
                if turn < options.demos:
                    add(name, {"demonstration, s": _demonstration(trees[name], work / f"demo{turn}")})
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "before": _run(trees["before"], ["git", "describe", "--always"]).strip(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "figures": {
            name: {
                **{tree: round(statistics.median(values), 5) for tree, values in both.items()},
                "ratio": round(statistics.median(a / b for a, b in zip(both["now"], both["before"], strict=True)), 3),
                "turns": len(both["now"]),
            }
            for name, both in figures.items()
        },
    }
    text = _report(about)
    sys.stdout.write(text)
    stem = options.results / f"embedded_cost-{about['date']}"
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return 0


def _run(tree: Path, command: Sequence[str], *, statuses: Container[int] = (0,)) -> str:
    """Run a command in a checkout, with its packages before all others; returns what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, check=False, stdout=subprocess.PIPE, text=True)
    if done.returncode not in statuses:
        raise SystemExit(f"{' '.join(command)[:200]} in {tree}: exit status {done.returncode}")
    return done.stdout


def _record(tree: Path, work: Path, turn: int, captures: int) -> dict[str, float]:
    """Measure captures, verification and pages of a checkout, CPU seconds each."""
    pages = [sys.executable, "-m", "bench.pages.audit_scale", "--work", str(work), "--results", str(work)]
    _run(tree, pages, statuses=(0, 1))  # 1: a page took long, on a busy machine
    served = json.loads((work / "audit_scale.json").read_text(encoding="utf-8"))["pages"]
    capture = [sys.executable, "-c", _CAPTURES, str(work / f"captures{turn}"), str(captures)]
    return {
        "a photograph of 1 MB recorded, s": float(_run(tree, capture)),
        "a run of 100,000 events verified, s": float(_run(tree, [sys.executable, "-c", _VERIFY, str(work / "data")])),
        f"all {len(served)} pages of the audit served once, s": sum(page["cpu_ms"] for page in served.values()) / 1e3,
    }


def _demonstration(tree: Path, out: Path) -> float:
    """Run the whole demonstration of a checkout; returns its CPU seconds, all its processes included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _run(tree, [sys.executable, "-m", "service.cli.main", "demo", "--out", str(out), "--json"])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _report(about: Mapping[str, Any]) -> str:
    rows = [
        f"| {name} | {row['before']:.4g} | {row['now']:.4g} | {row['ratio']:.3f} | {row['turns']} |"
        for name, row in about["figures"].items()
    ]
    return "\n".join(
        [
            "# What the embedded default costs, before and after sites",
            "",
            f"One data folder with SQLite, at {about['commit']} beside {about['before']}, the last revision without "
            "PostgreSQL,",
            "object stores and clusters. CPU seconds; the ratio is the median over turns.",
            f"{about['machine']['processor']}, load {about['load'][0]}.",
            "",
            "| | before | now | ratio | turns |",
            "|---|---:|---:|---:|---:|",
            *rows,
            "",
        ]
    )


if __name__ == "__main__":
    raise SystemExit(main())
