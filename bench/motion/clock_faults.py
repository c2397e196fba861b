"""Clock faults × every duration that a gate or a timer judges (`python -m bench.motion.clock_faults`).

Each row begins a wait in a data folder on a host of its own, lets a fault of the host's clocks happen in the middle,
and asks the program's own code what it allows then. The true duration decides whether that is right; what errs may
err on the safe side only. Durations that one process measures by the monotonic clock alone are not in the table: of
the faults only sleep changes them, and while the host sleeps nothing is driven.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime

from bench.machine import RESULTS, commit, machine
from tests.support.clocks.places import DURATIONS, PLACES, places
from tests.support.clocks.world import FAULTS, Row, rows_of


def table(rows: Iterable[Row]) -> str:
    """The rows in Markdown."""
    lines = [
        "| duration | limit | fault | true | the program took it for | what it did | verdict |",
        "|---|---:|---|---:|---:|---|---|",
    ]
    for row in rows:
        took = "" if row.took_s is None else f"{row.took_s:.1f} s"
        lines.append(
            f"| {row.duration} | {row.limit_s:g} s | {row.fault} | {row.true_s:g} s | {took} | {row.did} | "
            f"{'**WRONG**' if row.verdict == 'WRONG' else row.verdict} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Try everything, print, and record if asked. Ends with 1 if a row is wrong or a place is not covered."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--record", action="store_true", help="write the results to bench/results")
    options = parser.parse_args()
    revision = commit()
    unknown = sorted(places() ^ PLACES.keys())
    rows = [row for duration in DURATIONS for fault in FAULTS for row in rows_of(duration, fault)]
    verdicts = Counter(row.verdict.partition(":")[0] for row in rows)
    today = datetime.now(UTC).date().isoformat()
    counted = ", ".join(f"{verdicts[name]} {name}" for name in ("right", "safe side", "WRONG"))
    text = "\n".join([
        f"# What faults of the host's clocks do to durations, {today}", "",
        f"`python -m bench.motion.clock_faults`, revision {revision}: {len(DURATIONS)} durations × {len(FAULTS)} "
        f"faults, {len(rows)} rows: {counted}.", "",
        table(rows), "",
        "Every place that looks at UTC, at a file's time or at the boot's:", "",
        "| place | tried by, or why not |", "|---|---|",
        *[f"| {place} | {why} |" for place, why in PLACES.items()],
    ]) + "\n"  # fmt: skip
    if options.record:
        data = {"commit": revision, "machine": machine(), "rows": [asdict(row) for row in rows]}
        (RESULTS / f"clock_faults-{today}.json").write_text(json.dumps(data, indent=1) + "\n")
        (RESULTS / f"clock_faults-{today}.md").write_text(text)
    print(text)
    if unknown or verdicts["WRONG"]:
        sys.exit(f"places not covered, or gone: {unknown}; wrong: {verdicts['WRONG']}")


if __name__ == "__main__":
    main()
