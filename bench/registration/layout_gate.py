"""The layout check on random layouts: how often it passes an ambiguous one or rejects an unambiguous one.

Photographs are simulated outlines: projected with the true lens of a simulated scene, read with the nominal camera
that the step uses, with the noise and the bias given in bench/results/outlines*.md. They go through the step's own
functions and its rule: passed, rejected, or one more photograph from another side, five at most.
"""

from __future__ import annotations

import argparse
import datetime
import json
import time
from dataclasses import asdict

import numpy as np

from bench.machine import RESULTS, machine
from tests.support.scenes.judged_layout import Outcome, judge

KINDS = ("regular", "nearly regular", "irregular", "simulated scene")


def main() -> None:
    """Judge all layouts and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--layouts", type=int, default=1000)
    args = parser.parse_args()
    start = time.process_time()
    outcomes = [judge(KINDS[k % len(KINDS)], 1000 + k) for k in range(args.layouts)]
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    rig = machine()
    where = f"{rig['processor']}, {rig['cores']} cores"
    seconds = (time.process_time() - start) / len(outcomes)
    head = "| layouts | good in truth | passed though bad | sent back though good | photographs, mean | undecided |"
    lines = [
        f"# The layout check on {len(outcomes)} random layouts",
        "",
        f"{day}, {where}; {seconds:.2f} CPU-s a layout.",
        "",
        head,
        "|---|---|---|---|---|---|",
        *(_row(kind, [o for o in outcomes if o.kind == kind]) for kind in KINDS),
        _row("all", outcomes),
    ]
    (RESULTS / f"layout_gate-{day}.md").write_text("\n".join(lines) + "\n")
    (RESULTS / f"layout_gate-{day}.json").write_text(json.dumps([asdict(o) for o in outcomes], indent=1) + "\n")
    print("\n".join(lines))


def _row(name: str, outcomes: list[Outcome]) -> str:
    n = max(len(outcomes), 1)
    bad = sum(o.passed and not o.good for o in outcomes)
    needless = sum(o.good and not o.passed for o in outcomes)
    mean = float(np.mean([o.photographs for o in outcomes])) if outcomes else 0.0
    return (
        f"| {name}: {len(outcomes)} | {sum(o.good for o in outcomes)} | {bad} ({100 * bad / n:.1f} %) | "
        f"{needless} ({100 * needless / n:.1f} %) | {mean:.2f} | {sum(not o.decided for o in outcomes)} |"
    )


if __name__ == "__main__":
    main()
