"""Draws mutations of safety, evidence and accuracy by a seed, and tries each against the fast tests that reach it.

`python -m bench.suite.mutants --seed S --count N` (or `make mutants`). The seed alone decides what is drawn: each of
twelve subjects (subjects.py) as often as the others, within it each kind of change (places.py). A mutation is made
in a copy of the tree; the tests that reach it (reach.py) run, those of the subject first, until one fails: then it is
killed. What no test notices is listed. Mutations that change no result are explained in equivalent.yaml and not
counted.

Exit status: 0, or 1 if the share that was killed is below `--at-least`, or a mutation could not be tried.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml

from bench.machine import REPOSITORY, RESULTS, commit, machine
from bench.suite.mutants.record import record_reach
from tests.support.mutants.places import Mutation, drawn
from tests.support.mutants.reach import Reach
from tests.support.mutants.subjects import SUBJECTS
from tests.support.mutants.trial import Trial, Verdict, copied_tree, import_libraries

EQUIVALENT = Path(__file__).with_name("equivalent.yaml")
MEMORY, ROOM_BYTES = Path("/dev/shm"), 2 * 2**30
POLL_S = 0.05


def explained(mutation: Mutation) -> str:
    """Why a mutation changes no result, or nothing if no one has said so."""
    for entry in yaml.safe_load(EQUIVALENT.read_text(encoding="utf-8")):
        if (entry["file"], entry["before"], entry["after"]) == (
            mutation.place.file,
            mutation.before,
            mutation.after,
        ):
            return str(entry["why"])
    return ""


def tried(trees: Sequence[Path], mutations: Sequence[Mutation], tell: Callable[[Verdict], None]) -> list[Verdict]:
    """Try all mutations, one a tree at a time; the verdicts in the order of the mutations."""
    reach = {tree: Reach(tree) for tree in trees}
    import_libraries()
    waiting, free = list(mutations), list(trees)
    running: dict[int, tuple[Trial, Path]] = {}
    verdicts: dict[Mutation, Verdict] = {}
    while waiting or running:
        while waiting and free:
            tree, mutation = free.pop(), waiting.pop(0)
            selected = reach[tree].selected(mutation.place.subject, mutation.place.file, mutation.line)
            trial = Trial(tree, mutation, selected)
            running[trial.pid] = (trial, tree)
        for pid, (trial, tree) in list(running.items()):
            trial.overdue()
            ended, status, used = os.wait4(pid, os.WNOHANG)
            if ended:
                del running[pid]
                free.append(tree)
                verdict = trial.ended(status, used)
                verdicts[verdict.mutation] = verdict
                tell(verdict)
        time.sleep(POLL_S)
    return [verdicts[mutation] for mutation in mutations]


KILLED = ("killed", "hung")


def recorded(verdicts: Sequence[Verdict], options: argparse.Namespace, cpu_s: float) -> dict[str, Any]:
    """The results as data."""
    rows = [
        {
            "subject": v.mutation.place.subject, "kind": v.mutation.place.kind, "at": v.mutation.name,
            "before": v.mutation.before, "after": v.mutation.after, "outcome": v.outcome, "by": v.by,
            "cpu_s": round(v.cpu_s, 2), "explained": explained(v.mutation), "tests": list(v.tests),
        }
        for v in verdicts
    ]  # fmt: skip
    counted = [row for row in rows if row["outcome"] in KILLED or not row["explained"]]
    return {
        "day": options.day, "seed": options.seed, "count": len(rows), "tests_of": options.tests_of or "",
        "commit": commit(), "machine": machine(), "killed": sum(row["outcome"] in KILLED for row in rows),
        "counted": len(counted), "cpu_s": round(cpu_s, 1), "mutations": rows,
    }  # fmt: skip


def page(data: dict[str, Any]) -> str:
    """The results as a page."""
    rows: list[dict[str, Any]] = data["mutations"]
    counted = [row for row in rows if row["outcome"] in KILLED or not row["explained"]]
    of = {subject: [row["outcome"] in KILLED for row in counted if row["subject"] == subject] for subject in SUBJECTS}
    tests_of = f", with the tests of {data['tests_of']}" if data["tests_of"] else ""
    mean_s = sum(row["cpu_s"] for row in rows) / max(1, len(rows))
    lines = [
        f"# Mutations of {data['day']}",
        "",
        f"`python -m bench.suite.mutants --seed {data['seed']} --count {data['count']}` "
        f"at {data['commit']}{tests_of}: "
        f"**{data['killed']} of {data['counted']} killed ({data['killed'] / max(1, data['counted']):.1%})**; "
        f"{len(rows) - len(counted)} more change no result (bench/suite/mutants/equivalent.yaml). "
        f"{data['cpu_s']:.0f} CPU seconds in all, {mean_s:.1f} a mutation.",
        "",
        "| subject | killed | counted |",
        "|---|---|---|",
        *(f"| {subject} | {sum(found)} | {len(found)} |" for subject, found in of.items() if found),
        "",
    ]
    survivors = [row for row in rows if row["outcome"] not in KILLED]
    lines += ["## Survivors", ""] if survivors else []
    for row in survivors:
        ran = f"{row['outcome']}; tests: {', '.join(row['tests']) or 'none reaches it'}"
        lines += [f"- `{row['at']}` ({row['subject']}, {row['kind']}): {row['explained'] or ran}", "", "  ```diff"]
        lines += [f"  - {row['before']}", f"  + {row['after']}", "  ```", ""]
    return "\n".join(lines).rstrip() + "\n"


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    today = datetime.datetime.now(tz=datetime.UTC).date()
    parser.add_argument("--seed", default=f"{today:%Y%m%d}", help="decides what is drawn; the day if left out")
    parser.add_argument("--count", type=int, default=300, help="how many mutations are drawn")
    parser.add_argument("--skip", type=int, default=0, help="leave out the first of those drawn: tried before")
    parser.add_argument("--jobs", type=int, default=2, help="how many are tried at a time")
    parser.add_argument("--at-least", type=float, default=0.0, metavar="SHARE", help="exit status 1 below this share")
    parser.add_argument("--tests-of", metavar="REVISION", help="the score of an older revision's tests")
    parser.add_argument("--only", metavar="TEXT", help="of those drawn, only those whose file:line contains this")
    parser.add_argument("--record", action="store_true", help="write the results to bench/results")
    parser.add_argument("--reach", action="store_true", help="renew reached.json first (minutes)")
    options = parser.parse_args()
    options.day = today.isoformat()
    return options


def main() -> int:
    """Draw, try, report."""
    options = arguments()
    parent = MEMORY if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM_BYTES else None
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mutants-", dir=parent)))
        if options.reach:
            record_reach(folder / "recorded")
        trees = [copied_tree(folder / f"tree-{k}", options.tests_of) for k in range(options.jobs)]
        mutations = [
            m
            for m in drawn(trees[0], options.seed, options.count)[options.skip :]
            if not options.only or options.only in m.name
        ]

        def tell(verdict: Verdict) -> None:
            m = verdict.mutation
            print(f"{verdict.outcome:8} {verdict.cpu_s:6.1f} s  {m.name} ({m.place.kind})  {verdict.by}", flush=True)

        verdicts = tried(trees, mutations, tell)
    times = os.times()
    cpu_s = times.user + times.system + times.children_user + times.children_system
    data = recorded(verdicts, options, cpu_s)
    print(f"\n{page(data)}")
    if options.record:
        name = f"mutants{'-before' if options.tests_of else ''}-{options.day}"
        (RESULTS / f"{name}.md").write_text(page(data), encoding="utf-8")
        (RESULTS / f"{name}.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    broken = any(verdict.outcome == "broken" for verdict in verdicts)
    return int(broken or data["killed"] < options.at_least * data["counted"])


if __name__ == "__main__":
    sys.path[:] = [str(REPOSITORY), *sys.path]
    sys.exit(main())
