"""`make soak`: four long or large tests of configurable size; figures go to bench/results/soak-DATE.

python -m bench.soak [--only captures large together speed] [--minutes 60] [--viewpoints 10000] …

A part that is measured again on the same day replaces its earlier figures; the others stay. Exit status: 0 without
faults, 1 with.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, commit, machine
from tests.support.soak import captures, creep, large, speed, together

RESULTS = REPOSITORY / "bench" / "results"
PARTS = ("captures", "large", "together", "speed")
TITLES: Mapping[str, str] = {
    "captures": "Captures for a long time",
    "large": "A large run",
    "together": "Many on one database file",
    "speed": "Speed compared with the usual tools",
}
TABLES: Mapping[str, Callable[[dict[str, Any]], list[str]]] = {
    "captures": creep.table,
    "large": large.table,
    "together": together.table,
    "speed": speed.table,
}


def measured(part: str, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Measure one part at the requested size."""
    match part:
        case "captures":
            return captures.captures(
                folder, options.minutes, options.sample_s, options.planned, calibrated=not options.uncalibrated
            )
        case "large":
            sizes = [options.viewpoints // share for share in (8, 4, 2, 1)]
            return large.large(folder, sizes, options.gigabytes)
        case "together":
            return together.together(folder, options.together_minutes)
        case _:
            return speed.speed(folder, options.rounds, options.images, options.image_mb)


def report(parts: Mapping[str, dict[str, Any]]) -> str:
    """Format the figures as Markdown."""
    lines = ["# Long and large", "", "`make soak` (docs/howto/soak.md).", ""]
    for part in (name for name in PARTS if name in parts):
        found = parts[part]
        on = found["machine"]
        lines += [
            f"## {TITLES[part]}: `{part}`",
            "",
            f"`python -m bench.soak {' '.join(found['options'])}`, commit {found['commit']}; {on['processor']}, "
            f"{on['cores']} cores shared with other work, Python {on['python']}; load at the beginning and the end "
            f"{found['load'][0]:.1f}, {found['load'][1]:.1f}; {found['took_s']:.0f} s.",
            "",
            *TABLES[part](found),
            "",
            "Faults:" if found["faults"] else "No fault.",
            "",
            *(f"- {fault}" for fault in found["faults"]),
            *([""] if found["faults"] else []),
        ]
    return "\n".join(lines).rstrip() + "\n"


def main(words: Sequence[str] | None = None) -> int:
    """Measure, report and write the results; returns the exit status."""
    words = sys.argv[1:] if words is None else words
    parser = argparse.ArgumentParser(prog="python -m bench.soak", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--minutes", type=float, default=60.0, help="captures: duration")
    parser.add_argument("--sample-s", type=float, default=5.0, help="captures: sampling interval")
    parser.add_argument(
        "--planned", type=int, default=8000, help="captures: planned viewpoints, more than can be taken"
    )
    parser.add_argument(
        "--uncalibrated", action="store_true", help="captures: skip the calibration; the worker is idle"
    )
    parser.add_argument("--viewpoints", type=int, default=10_000, help="large: viewpoints of the run")
    parser.add_argument("--gigabytes", type=float, default=50.0, help="large: size of the photographs (sparse)")
    parser.add_argument("--together-minutes", type=float, default=5.0, help="together: duration")
    parser.add_argument("--rounds", type=int, default=7, help="speed: rounds, alternating with the tools")
    parser.add_argument("--images", type=int, default=6, help="speed: images per round")
    parser.add_argument("--image-mb", type=float, default=45.0, help="speed: size of each image")
    parser.add_argument("--work", type=Path, help="folder for temporary files, which are removed")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    stem = options.results / f"soak-{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
    options.results.mkdir(parents=True, exist_ok=True)
    if options.work is not None:
        options.work.mkdir(parents=True, exist_ok=True)
    revision = commit()  # before the results change the working tree
    faults: list[str] = []
    for part in options.only:
        load, began_s = os.getloadavg()[0], time.monotonic()
        with tempfile.TemporaryDirectory(prefix="orthocapture-soak-", dir=options.work) as folder:
            found = measured(part, Path(folder) / part, options)
        about: dict[str, Any] = {
            "commit": revision,
            "machine": machine(),
            "options": ["--only", part, *_sizes(part, words)],
        }
        about |= {"load": [load, os.getloadavg()[0]], "took_s": round(time.monotonic() - began_s)}
        found = about | found
        print("\n".join([TITLES[part], "", *TABLES[part](found), "", *found["faults"]]), flush=True)
        parts = json.loads(stem.with_suffix(".json").read_text()) if stem.with_suffix(".json").exists() else {}
        parts[part] = found
        stem.with_suffix(".json").write_text(json.dumps(parts, indent=1) + "\n")
        stem.with_suffix(".md").write_text(report(parts))
        faults += found["faults"]
    return int(bool(faults))


_OPTIONS: Mapping[str, tuple[str, ...]] = {
    "captures": ("--minutes", "--sample-s", "--planned"),
    "large": ("--viewpoints", "--gigabytes"),
    "together": ("--together-minutes",),
    "speed": ("--rounds", "--images", "--image-mb"),
}


def _sizes(part: str, words: Sequence[str]) -> list[str]:
    """The options of a part, as given on the command line."""
    return [word for name, value in pairwise(words) if name in _OPTIONS[part] for word in (name, value)]


if __name__ == "__main__":
    sys.exit(main())
