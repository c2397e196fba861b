"""The fault matrix: every message of every wire spoilt in every way, plus faults of the devices and disks themselves.

`python -m bench.torture.faults` (or `make torture-faults`) tries every case on a small rig: the real drivers over
their real wires, the real runner, and a simulated person who takes the first way on that the screen lists. All cases
are judged by the same rules (`judgement/rules.py`), and the outcomes are compared with the table in
docs/reference/faults.md; `--record` writes that table, and the results to bench/results.
Exit status: 0 if every rule held and the table is right, 1 otherwise.
"""

from __future__ import annotations

import argparse
import datetime
import fnmatch
import gc
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from random import Random

import cv2

from bench.machine import REPOSITORY, commit, machine
from tests.support.torture.faults.case import Case
from tests.support.torture.faults.judgement.table import DOCUMENT, differences, read_table, report, table
from tests.support.torture.faults.judgement.verdict import Verdict
from tests.support.torture.faults.matrix import cases
from tests.support.torture.faults.trial import prepare_seed, run_in_child

RESULTS = REPOSITORY / "bench" / "results"
_POLL_S = 0.02


def chosen(options: argparse.Namespace) -> list[Case]:
    """Select the cases of this sweep, in random order if it may be cut short. Raises SystemExit if there are none."""
    every = list(cases().values())
    patterns: list[str] = options.only
    found = [c for c in every if not patterns or any(fnmatch.fnmatchcase(c.name, p) for p in patterns)]
    if not found:
        raise SystemExit(f"no case is named {' or '.join(patterns)}")
    if options.sample or options.minutes:
        Random(options.seed).shuffle(found)
    return found[: options.sample or len(found)]


def tried(case: Case, folder: Path, seed: Path, number: int) -> Verdict:
    """Run a case in a forked process and wait for its verdict; kill it with its children if it exceeds its bound."""
    folder.mkdir(parents=True)
    began_s = time.monotonic()
    pid = os.fork()
    if pid == 0:
        try:
            os.setsid()
            said = os.open(folder / "said.log", os.O_CREAT | os.O_APPEND | os.O_WRONLY)
            os.dup2(said, 1)
            os.dup2(said, 2)
            for stop in (signal.SIGINT, signal.SIGTERM):
                signal.signal(stop, signal.SIG_DFL)
            shutil.copytree(seed, folder / "data")
            run_in_child(case, folder, number)
        finally:
            os._exit(0)
    ended = 0
    while not ended and time.monotonic() - began_s < case.bound_s:
        time.sleep(_POLL_S)
        ended, _ = os.waitpid(pid, os.WNOHANG)
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # ends the simulators and the proxy too, whatever the case did
    if not ended:
        os.waitpid(pid, 0)
        return Verdict(case.name, broken=[f"it did not end within {case.bound_s:.0f} s"], seconds=case.bound_s)
    path = folder / "verdict.json"
    if not path.exists():
        return Verdict(case.name, broken=["its process died"], seconds=time.monotonic() - began_s)
    return Verdict(**json.loads(path.read_text()))


def sweep(some: Sequence[Case], folder: Path, options: argparse.Namespace) -> list[Verdict]:
    """Try the cases in turn until the time is up, reporting each as it ends."""
    began_s = time.monotonic()
    seed = prepare_seed(folder / "seed")
    gc.collect()
    gc.freeze()  # objects shared by all children are then not copied when their reference counts change
    verdicts: list[Verdict] = []
    for number, case in enumerate(some):
        if options.minutes and time.monotonic() - began_s > 60 * options.minutes:
            break
        place = folder / f"case-{number}"
        verdict = tried(case, place, seed, options.seed)
        if not verdict.reached and not verdict.broken:
            verdict.broken.append("the planned fault did not occur")
        verdicts.append(verdict)
        print(f"{verdict.name}: {', '.join(verdict.policy) or 'nothing'}; {verdict.end}; {verdict.seconds:.0f} s")
        for fault in verdict.broken:
            print(f"    {fault}")
        if verdict.broken:
            print(f"    kept in {place}")
        else:
            shutil.rmtree(place, ignore_errors=True)
        sys.stdout.flush()
    return verdicts


def main(arguments: Sequence[str] | None = None) -> int:
    """Sweep, compare and report; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench.torture.faults", description=__doc__)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="PATTERN", help="cases by name, such as robot/rtde/*"
    )
    parser.add_argument("--sample", type=int, default=0, metavar="N", help="a sample of N cases, drawn by --seed")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=0, help="start no further case after this time; 0: never")
    parser.add_argument("--record", action="store_true", help="write docs/reference/faults.md and bench/results")
    parser.add_argument("--list", action="store_true", help="list the cases and exit")
    parser.add_argument("--out", type=Path, help="write the verdicts to this file (JSON)")
    parser.add_argument(
        "--read", nargs="+", type=Path, default=[], metavar="FILE", help="try nothing; take verdicts written by --out"
    )
    options = parser.parse_args(arguments)
    some = chosen(options)
    if options.list:
        print("\n".join(case.name for case in some))
        return 0
    cv2.setNumThreads(1)
    revision = commit()  # before the results change the working tree
    folder = Path(tempfile.mkdtemp(prefix="orthocapture-faults-"))
    began_s = time.monotonic()
    if options.read:
        rows = [row for path in options.read for row in json.loads(path.read_text())]
        verdicts = [Verdict(**{key: row[key] for key in row if key != "commit"}) for row in rows]
    else:
        verdicts = sweep(some, folder, options)
        rows = [{**verdict.told(), "commit": revision} for verdict in verdicts]
    broken = [verdict for verdict in verdicts if verdict.broken]
    differing = differences(verdicts, read_table(DOCUMENT))
    for line in differing:
        print(line)
    print(
        f"{len(verdicts)} of {len(cases())} cases, {len(broken)} with a fault, {len(differing)} not as in the table"
    )
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")
    if options.record:
        about = {
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "commit": revision,
            "machine": machine(),
            "options": list(sys.argv[1:] if arguments is None else arguments),
            "cases": len(cases()),
            "seconds": round(time.monotonic() - began_s),
        }
        DOCUMENT.write_text(table(list(cases().values()), verdicts, read_table(DOCUMENT)), encoding="utf-8")
        stem = RESULTS / f"torture_faults-{about['date']}"
        report(about, cases(), rows, stem)
    if not broken:
        shutil.rmtree(folder, ignore_errors=True)
    return 1 if broken or (differing and not options.record) else 0


if __name__ == "__main__":
    if "OPENBLAS_NUM_THREADS" not in os.environ:  # read when numpy is loaded; a fork must have no threads
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "bench.torture.faults", *sys.argv[1:]])
    sys.exit(main())
