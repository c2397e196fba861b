"""Alters the evidence in every possible way and checks that `audit verify` reports it: `make torture-audit`.

A small record made by the software itself is attacked: every byte with one bit flipped, every row and column altered,
every roll-back, and a forger with every subset of what can be written and signed with. Undetected changes must be
listed in the table of docs/explanation/evidence.md, and everything listed there must have been found undetected. Each
sweep makes its changes in a random order of a fixed seed: if it ends early (--minutes), what it has done is a sample
of all changes, and with the same --work it is continued.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import pickle
import random
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, commit, machine
from tests.support.torture.audit.documented import DOCUMENT, SWEEPS, documented_codes, problems, undetected_codes
from tests.support.torture.audit.outcome import quickened, verdict
from tests.support.torture.audit.record import Record, make_record, put_back
from tests.support.torture.audit.tally import Tallies, Tally, add_all, in_a_process

RESULTS = REPOSITORY / "bench" / "results"
CHUNK = 250  # changes per process


def main(words: Sequence[str] | None = None) -> int:
    """Run the sweeps, print and write the table. Returns 1 if the documentation and the findings disagree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, help="number of changes per sweep, instead of all")
    parser.add_argument("--seed", type=int, default=11, help="seed of the order of the changes")
    parser.add_argument("--minutes", type=float, help="start nothing new after this time")
    parser.add_argument("--only", nargs="+", choices=SWEEPS, default=list(SWEEPS))
    parser.add_argument(
        "--work", type=Path, help="folder for the record and the progress, kept for continuing; best in memory"
    )
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    ends = time.monotonic() + options.minutes * 60 if options.minutes is not None else None
    with ExitStack() as stack:
        work = options.work or Path(stack.enter_context(tempfile.TemporaryDirectory(dir=_memory())))
        record = _record(work)
        done = {
            name: sweep(work, record, name, sample=options.sample, seed=options.seed, ends=ends)
            for name in options.only
        }
    about: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "seed": options.seed,
        "sweeps": {name: {"done": number, "of": size} for name, (number, size, _) in done.items()},
        "kinds": {},
    }
    total: Tallies = {}
    for _number, _size, tallies in done.values():
        add_all(total, tallies)
    documented = documented_codes(DOCUMENT.read_text())
    whole = all(number == size for number, size, _ in done.values()) and set(done) == set(SWEEPS)
    about["problems"] = problems(total, documented, whole=whole)
    about["kinds"] = {kind: tally.as_json() for kind, tally in total.items()}
    text = report(about, total, documented)
    sys.stdout.write(text)
    options.results.mkdir(parents=True, exist_ok=True)
    stem = options.results / f"torture_audit-{about['date']}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return int(bool(about["problems"]))


def _memory() -> str | None:
    """A memory file system, if there is room: the record is written some hundred thousand times."""
    memory = Path("/dev/shm")
    return str(memory) if memory.is_dir() and os.access(memory, os.W_OK) else None


def _record(work: Path) -> Record:
    kept = work / "record.pickle"
    if kept.exists():
        record: Record = pickle.loads(kept.read_bytes())
        put_back(record)
        return record
    record = make_record(work / "record")
    kept.write_bytes(pickle.dumps(record))
    return record


def sweep(
    work: Path, record: Record, name: str, *, sample: int | None, seed: int, ends: float | None
) -> tuple[int, int, Tallies]:
    """Run a sweep, or continue it; returns the number of changes done, the number of all, and the tallies."""
    log = work / f"{name}-{seed}.jsonl"
    total: Tallies = {}
    done = 0
    for line in log.read_text().splitlines() if log.exists() else ():
        part = json.loads(line)
        done += part["done"]
        add_all(total, {kind: Tally.of_json(tally) for kind, tally in part["tallies"].items()})
    with quickened(files_stay=name != "artefacts", database_stays=name in ("log", "journal", "artefacts")):
        put_back(record)
        verdict(record, ())  # caches what every process needs about the unaltered record
        made = SWEEPS[name](record)
        numbers = list(range(made.size))
        random.Random(seed).shuffle(numbers)
        wanted = numbers if sample is None else numbers[:sample]
        while done < len(wanted) and (ends is None or time.monotonic() < ends):
            chunk = wanted[done : done + CHUNK]
            found = in_a_process(made, chunk)
            add_all(total, found)
            done += len(chunk)
            with log.open("a") as stream:
                tallies = {kind: tally.as_json() for kind, tally in found.items()}
                stream.write(json.dumps({"done": len(chunk), "tallies": tallies}) + "\n")
            sys.stderr.write(f"{name}: {done} of {len(wanted)}\n")
    put_back(record)
    return done, made.size, total


def report(about: Mapping[str, Any], total: Mapping[str, Tally], documented: Mapping[str, tuple[str, str]]) -> str:
    """Format the findings as Markdown."""
    cpu = about["machine"]
    lines = [
        f"# Evidence altered in every way: what `audit verify` detects ({about['date']})",
        "",
        "`make torture-audit`. Detected: a fault is named, or the record is refused with a message. Meaningless:",
        "everything that SQLite reads from the database is unchanged. In each byte bit offset modulo 8 is flipped.",
        "",
        f"Commit {about['commit']}; {cpu['processor']}, {cpu['cores']} cores, Python {cpu['python']}; "
        f"load {about['load']}.",
        "",
        "Done: "
        + "; ".join(f"{name} {one['done']} of {one['of']}" for name, one in about["sweeps"].items())
        + f" (in a random order, seed {about['seed']}).",
        "",
        "| change | number | detected | with its place | meaningless | undetected | of these with a note | crashes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, t in sorted(total.items()):
        cells = (kind, t.number, t.told, t.placed, t.meaningless, sum(t.untold.values()), t.noted, len(t.crashes))
        lines.append(f"| {' | '.join(str(cell) for cell in cells)} |")
    lines += ["", "Undetected changes, why, and what reveals them from outside (docs/explanation/evidence.md):", ""]
    lines += ["| what | number | why | revealed by |", "|---|---|---|---|"]
    numbers: dict[str, int] = {}
    for _kind, code, number in undetected_codes(total):
        pattern = next((p for p in documented if fnmatchcase(code, p)), code)
        numbers[pattern] = numbers.get(pattern, 0) + number
    for pattern, number in sorted(numbers.items()):
        why, anchor = documented.get(pattern, ("**not documented**", ""))
        lines.append(f"| `{pattern}` | {number} | {why} | {anchor} |")
    lines += ["", "Undetected forgeries that something kept elsewhere reveals:", ""]
    lines += ["| forger | undetected | revealed by |", "|---|---|---|"]
    for kind, t in sorted(total.items()):
        if t.anchors:
            by = "; ".join(f"{anchor} {number}" for anchor, number in t.anchors.most_common())
            lines.append(f"| {kind} | {sum(t.untold.values())} | {by} |")
    lines += ["", "Problems: " + ("none." if not about["problems"] else "")]
    lines += [f"- {problem}" for problem in about["problems"]]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
