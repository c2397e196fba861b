"""The crash sweep: a short run is killed at every point of its durable effects, and processes at random moments.

`python -m bench.torture.crash` (or `make torture-crash`) kills at every point, by SIGKILL and by a loss of power, and
then at random over the real wires. After each death the run is resumed, confirmed, completed and checked by
bench/torture/crash/check.py. The table goes to bench/results.
"""

from __future__ import annotations

import argparse
import datetime
import gc
import json
import os
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import cv2

from bench.machine import RESULTS, commit, machine
from bench.torture.crash.random_kills import Kill, random_kills
from bench.torture.crash.sweep import Case, How, Sweep, Verdict

_WAYS: tuple[How, ...] = ("kill", "power")
_TWICE = 10  # one case in this many dies again after resuming
_TRIES = 3  # points of a kind, of which a run of several processes may not reach each


def chosen(sweep: Sweep, rng: Random, options: argparse.Namespace) -> list[Case]:
    """All cases, or a sample, in random order, so that an aborted sweep has tried a bit of everything."""
    cases = list(sweep.cases(options.ways))
    rng.shuffle(cases)
    if options.kinds:
        return [case for kind in options.kinds for case in [c for c in cases if kind_of(c) == kind][:_TRIES]]
    later = sweep.points["runner", "kill"]
    twice = [Case(c.role, c.point, c.how, rng.choice(later)) for c in cases[::_TWICE] if c.role == "runner"]
    both = [*cases, *twice]
    return both if options.sample is None else both[: options.sample]


def kind_of(case: Case) -> str:
    """The process, the effect and the way to die, as `--kinds` names them."""
    return f"{case.role}/{case.point.effect}/{case.how}"


def sweep_points(folder: Path, options: argparse.Namespace, rng: Random) -> dict[str, Any]:
    """Run the systematic part; returns what was tried and found."""
    began_s = time.monotonic()
    sweep = Sweep.begin(folder)
    # Objects shared by all children are then not copied when their reference counts change.
    gc.collect()
    gc.freeze()
    cases = chosen(sweep, rng, options)
    verdicts: list[Verdict] = []
    died: set[str] = set()
    for number, case in enumerate(cases, start=1):
        if options.kinds and kind_of(case) in died:
            continue
        if options.minutes and time.monotonic() - began_s > 60 * options.minutes:
            break
        verdict = sweep.try_case(case, rng)
        verdicts.append(verdict)
        if verdict.reached:
            died.add(kind_of(case))
        for fault in verdict.faults:
            print(f"{_named(case)}: {fault}", flush=True)
        if verdict.faults and options.first_fault:
            break
        if number % 50 == 0:
            print(f"{number} of {len(cases)}, {time.monotonic() - began_s:.0f} s", flush=True)
    return {
        "points": sum(map(len, sweep.points.values())),
        "planned": len(cases),
        "rows": rows(sweep, verdicts),
        "deaths": sum(v.reached for v in verdicts),
        "twice": sum(v.reached for v in verdicts if v.case.again is not None),
        "taken_by_power": sum(bool(v.taken) for v in verdicts),
        "leftovers": sum(v.leftovers for v in verdicts),
        "faults": [
            {"case": _named(v.case), "kind": kind_of(v.case), "faults": list(v.faults)} for v in verdicts if v.faults
        ],
        "seconds": round(time.monotonic() - began_s),
    }


def _named(case: Case) -> str:
    again = f", again {case.again.where} {case.again.effect} {case.again.call}" if case.again else ""
    return f"{case.role}, {case.how}, {case.point.where} {case.point.effect} (call {case.point.call}){again}"


def rows(sweep: Sweep, verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """One row for each process, effect and way to die."""
    by: dict[tuple[str, str, str], list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        by[verdict.case.role, verdict.case.how, verdict.case.point.effect].append(verdict)
    return [
        {
            "process": role,
            "how": how,
            "effect": effect,
            "points": sum(p.effect == effect for p in sweep.points[verdict[0].case.role, verdict[0].case.how]),
            "tried": len(verdict),
            "deaths": sum(v.reached for v in verdict),
            "faults": sum(bool(v.faults) for v in verdict),
            "seconds": round(sum(v.seconds for v in verdict)),
        }
        for (role, how, effect), verdict in sorted(by.items())
    ]


def report(result: dict[str, Any]) -> str:
    """Format the result as Markdown."""
    command = " ".join(["python -m bench.torture.crash", *result["options"]])
    lines = [
        "# Crash sweep",
        "",
        f"`{command}`, {result['date']}, {result['commit']}; {result['machine']['processor']}, "
        f"{result['machine']['cores']} cores shared with other work. Seed {result['seed']}.",
        "",
    ]
    points = result.get("points")
    if points:
        lines += [
            f"At points of the seam, of which a run has {points['points']} by both deaths together: "
            f"{points['deaths']} deaths (of {points['planned']} planned), "
            f"{points['twice']} of which died once more after the resumption; a loss of power took something from "
            f"{points['taken_by_power']} of them; {points['leftovers']} leftovers were collected by "
            f"`orthocapture store gc`; **{len(points['faults'])} with a fault**; {points['seconds']} s.",
            "",
            "| process | death | effect | points | tried | deaths | with a fault | s |",
            "|---|---|---|---:|---:|---:|---:|---:|",
        ]
        lines += [
            f"| {r['process']} | {r['how']} | {r['effect'].replace('_', ' ')} | {r['points']} | {r['tried']} | "
            f"{r['deaths']} | {r['faults']} | {r['seconds']} |"
            for r in points["rows"]
        ]
        lines.append("")
    kills = result.get("random")
    if kills:
        lines += [
            f"At random over the real wires: {len(kills['kills'])} kills in {kills['runs']} runs, "
            f"**{len(kills['faults'])} faults**; {kills['seconds']} s.",
            "",
            "| process | kills |",
            "|---|---:|",
        ]
        names = sorted({kill["what"] for kill in kills["kills"]})
        lines += [f"| {name} | {sum(kill['what'] == name for kill in kills['kills'])} |" for name in names]
        lines.append("")
    faults = [f"{entry['case']}: {fault}" for entry in (points or {}).get("faults", []) for fault in entry["faults"]]
    faults += (kills or {}).get("faults", [])
    if faults:
        lines += ["Faults:", "", *(f"- {fault}" for fault in faults), ""]
    return "\n".join(lines)


def main() -> None:
    """Sweep and write bench/results/torture_crash-DATE.{json,md}; exits with status 1 if there is a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sample", type=int, help="number of cases of the systematic sweep; default: all")
    parser.add_argument(
        "--kinds", nargs="+", metavar="KIND", help="one death of each, such as runner/commit/power, instead of all"
    )
    parser.add_argument("--ways", nargs="+", choices=_WAYS, default=_WAYS, help="how the processes die")
    parser.add_argument("--first-fault", action="store_true", help="end the systematic sweep at the first fault")
    parser.add_argument("--minutes", type=float, default=0, help="end the systematic sweep after this time; 0: never")
    parser.add_argument("--random-runs", type=int, default=6, help="runs over the real wires; 0: none")
    parser.add_argument("--kills", type=int, default=4, help="kills per random run")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rng = Random(options.seed)
    folder = Path(tempfile.mkdtemp(prefix="orthocapture-torture-"))
    result: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "seed": options.seed,
        "options": sys.argv[1:],
    }
    if options.sample != 0:
        result["points"] = sweep_points(folder / "points", options, rng)
    if options.random_runs:
        began_s = time.monotonic()
        kills, faults = random_kills(folder / "random", options.random_runs, options.kills, rng)
        result["random"] = {
            "runs": options.random_runs,
            "kills": [_kill_record(kill) for kill in kills],
            "faults": faults,
            "seconds": round(time.monotonic() - began_s),
        }
    stem = f"torture_crash-{result['date']}"
    options.out.mkdir(exist_ok=True)
    (options.out / f"{stem}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (options.out / f"{stem}.md").write_text(report(result), encoding="utf-8")
    faulty = bool(result.get("points", {}).get("faults") or result.get("random", {}).get("faults"))
    if faulty:
        print(f"what shows faults is kept in {folder}")
    else:
        shutil.rmtree(folder)
    sys.exit(faulty)


def _kill_record(kill: Kill) -> dict[str, Any]:
    return {"what": kill.what, "after_s": round(kill.after_s, 2), "run": kill.run}


if __name__ == "__main__":
    if "OPENBLAS_NUM_THREADS" not in os.environ:  # read when numpy is loaded; a fork must have no threads
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "bench.torture.crash", *sys.argv[1:]])
    main()
