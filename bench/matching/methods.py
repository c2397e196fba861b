"""Methods of feature matching on a data set that `orthocapture export --format matching` wrote.

Run: python -m bench.matching.methods DATASET [--method sift] [--weights FILE] [--pairs-per-class 50] [--out NAME]
"""

from __future__ import annotations

import argparse
import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

from bench.machine import REPOSITORY, RESULTS, commit, machine
from service.benchmark.matching import MatchingTask, markdown, record, run_matching
from service.compute.matching.methods import matcher

_WORK = REPOSITORY / "build" / "bench" / "matching"


def main() -> None:
    """Measure, print and write the result: figures, table and curves of all methods that ran with this name."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--method", default="sift")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--pairs-per-class", type=int, default=50)
    parser.add_argument("--out", default="matching")
    args = parser.parse_args()
    work = _WORK / args.out
    work.mkdir(parents=True, exist_ok=True)
    wanted = MatchingTask(args.dataset, matcher(args.method), args.weights, args.pairs_per_class, work)
    results = run_matching(wanted, lambda what, done, total: print(what, done, total, flush=True))
    about = json.loads((args.dataset / "dataset.json").read_text(encoding="utf-8"))
    document = {
        "machine": machine(),
        "commit": commit(),
        "run": about.get("run"),
        "protocol": about.get("protocol"),
        "results": [record(result) for result in results],
    }
    name = f"{args.out}-{datetime.now(UTC).date().isoformat()}"
    (RESULTS / f"{name}.json").write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")
    (RESULTS / f"{name}.md").write_text(f"# Feature matching\n\n{markdown(results)}", encoding="utf-8")
    shutil.copyfile(work / "curves.png", RESULTS / f"{name}.png")
    print(markdown(results))


if __name__ == "__main__":
    main()
