"""`make torture-fuzz`: fuzzes every parser of the project for a given time each; results go to bench/results.

python -m bench.torture.fuzz --seconds-per-target 60 [--target NAME …] [--engine both|hypothesis|atheris]

Two engines mutate files written by the project's own simulators and exporters: hypothesis, and atheris, which is
guided by the lines that an input reaches (the extra `fuzz`; if it is not installed, this is reported and hypothesis
gets the whole time). Each target runs in a process of its own. A finding's smallest input is kept in the folder
--keep. Exit status: 0 without findings, 1 with.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import importlib.util
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.machine import REPOSITORY, commit, machine
from tests.support.torture.fuzz.targets.table import table
from tests.support.torture.fuzz.targets.target import Target
from tests.support.torture.fuzz.watch import Engine, Finding, Outcome, Sweep, all_findings

RESULTS = REPOSITORY / "bench" / "results"
UNLIMITED = 1 << 60


def engines(wanted: str) -> tuple[Engine, ...]:
    """The requested engines that are installed. Raises SystemExit if the only requested one is missing."""
    there = importlib.util.find_spec("atheris") is not None
    if wanted == "atheris" and not there:
        raise SystemExit("atheris is not installed: python -m pip install '.[fuzz]'")
    if wanted == "both" and not there:
        print("atheris is not installed: hypothesis alone reads (python -m pip install '.[fuzz]')", file=sys.stderr)
    return (
        ("hypothesis", "atheris")
        if wanted == "both" and there
        else ("atheris",)
        if wanted == "atheris"
        else ("hypothesis",)
    )


def keep(finding: Finding, folder: Path) -> Path:
    """Write the input of a finding and its effect; the file is named after its content."""
    place = folder / finding.target
    place.mkdir(parents=True, exist_ok=True)
    path = place / hashlib.sha256(finding.data).hexdigest()[:16]
    path.write_bytes(finding.data)
    path.with_suffix(".txt").write_text(f"{finding.fault}\n\n{finding.traceback}")
    return path


def swept(
    target: Target, group: str, with_engines: Sequence[Engine], options: argparse.Namespace
) -> dict[Engine, Outcome]:
    """Fuzz one target with each engine for its share of the time."""
    share_s: float = options.seconds_per_target / len(with_engines)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        return {
            engine: Sweep(group, engine, Path(folder)).run(
                {target.name: options.inputs}, seconds=share_s, seed=options.seed
            )[target.name]
            for engine in with_engines
        }


def row(target: Target, outcomes: dict[Engine, Outcome], revision: str) -> dict[str, object]:
    """The recorded row of a target."""
    each = list(outcomes.values())
    seconds, inputs = sum(one.seconds for one in each), sum(one.inputs for one in each)
    return {
        "target": target.name,
        "commit": revision,
        "entry": target.entry,
        "inputs": {engine: one.inputs for engine, one in outcomes.items()},
        "refused": sum(one.refused for one in each),
        "per_second": round(inputs / seconds, 1) if seconds else 0.0,
        "peak_mib": round(max((one.peak_mib for one in each), default=0.0), 1),
        "bound_mib": target.memory_mib,
        "bound_s": target.seconds,
        "findings": sorted(finding.fault for finding in all_findings(each)),
    }


def record(new: dict[str, object], order: Sequence[str]) -> None:
    """Write a row into today's results; the rows of other targets stay."""
    stem = RESULTS / f"fuzz-{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
    path = stem.with_suffix(".json")
    before = json.loads(path.read_text())["targets"] if path.exists() else []
    rows = {one["target"]: one for one in before} | {str(new["target"]): new}
    ordered = [rows[name] for name in order if name in rows]
    path.write_text(json.dumps({"machine": machine(), "targets": ordered}, indent=1) + "\n")
    stem.with_suffix(".md").write_text(markdown(ordered))


def markdown(rows: Sequence[dict[str, object]]) -> str:
    """Format the rows as Markdown."""
    total = sum(sum(counts.values()) for one in rows if isinstance(counts := one["inputs"], dict))
    here = machine()
    lines = [
        "# Bad input for every parser",
        "",
        f"`python -m bench.torture.fuzz --record`: {total:,} inputs; {here['cores']} cores, {here['memory_gb']} GB, "
        f"Python {here['python']}. The revision of each row is in the file beside this one.",
        "",
        "Inputs are mutated files that the simulators and exporters of this project wrote. Memory is what a process "
        "grew by at most, beside its bound. A finding is a crash, a hang, memory beyond the bound, an exception that "
        "is not of the project's tree, or one that names no place or no remedy.",
        "",
        "| target | parser | hypothesis | atheris | refused | inputs/s | peak MiB | bound | findings |",
        "|---|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for one in rows:
        inputs = one["inputs"]
        assert isinstance(inputs, dict)
        found = one["findings"]
        assert isinstance(found, list)
        counts = " | ".join(str(inputs.get(engine, "–")) for engine in ("hypothesis", "atheris"))
        bound, faults = f"{one['bound_mib']} MiB, {one['bound_s']} s", "; ".join(map(str, found)) or "none"
        lines.append(
            f"| {one['target']} | `{one['entry']}` | {counts} | {one['refused']} | {one['per_second']} | "
            f"{one['peak_mib']} | {bound} | {faults} |"
        )
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Sweep and report; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench.torture.fuzz", description="Bad input for every parser.")
    parser.add_argument("--seconds-per-target", type=float, default=60.0, help="total of all engines")
    parser.add_argument("--inputs", type=int, default=UNLIMITED, help="limit on the inputs, besides the time")
    parser.add_argument("--target", nargs="+", default=[], metavar="NAME", help="only these targets")
    parser.add_argument("--engine", choices=("both", "hypothesis", "atheris"), default="both")
    parser.add_argument("--seed", type=int, default=0, help="seed of hypothesis, for reproducible inputs")
    parser.add_argument("--keep", type=Path, default=REPOSITORY / "build" / "fuzz", help="folder for findings")
    parser.add_argument("--record", action="store_true", help="write bench/results/fuzz-DATE")
    options = parser.parse_args(arguments)
    targets = table()
    unknown = sorted(set(options.target) - set(targets))
    if unknown:
        parser.error(f"there is no target {unknown[0]}; there are {', '.join(targets)}")
    with_engines = engines(options.engine)
    revision = commit()  # before the results change the working tree
    rows: list[dict[str, object]] = []
    for name in options.target or targets:
        group, target = targets[name]
        outcomes = swept(target, group, with_engines, options)
        rows.append(row(target, outcomes, revision))
        print(json.dumps(rows[-1]), flush=True)
        for finding in all_findings(list(outcomes.values())):
            print(f"  {finding.fault}\n    input: {keep(finding, options.keep)}", flush=True)
        if options.record:
            record(rows[-1], list(targets))
    return 1 if any(one["findings"] for one in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
