"""Counts turns of phrase that a newcomer stumbles over; `make lint` fails if a count has risen.

CONTRIBUTING says how to write instead. The counts that stand are in bench/suite/dialect.json, for each top-level
folder. `python -m bench.suite.dialect` prints those of the working tree, `--list TIC` says where one of them is, and
`--renew` writes lower counts down. After a merge with text from elsewhere, `--renew --higher` writes all down.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from bench.machine import REPOSITORY
from tests.support.suite.dialect import FOLDERS, TICS, places_in

LIST = REPOSITORY / "bench" / "suite" / "dialect.json"


def counts(root: Path = REPOSITORY) -> dict[str, dict[str, int]]:
    """Return how often each turn of phrase stands in each top-level folder."""
    places = {folder: places_in([folder], root) for folder in FOLDERS}
    return {tic: {folder: len(places[folder][tic]) for folder in FOLDERS} for tic in TICS}


def main() -> int:
    """Print the counts, and compare or renew those that stand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", choices=TICS, metavar="TIC", help=f"print where it stands: {', '.join(TICS)}")
    parser.add_argument("--check", action="store_true", help="end with status 1 if a count has risen")
    parser.add_argument("--renew", action="store_true", help="write down the counts that have fallen")
    parser.add_argument("--higher", action="store_true", help="with --renew: also those that have risen")
    options = parser.parse_args()
    if options.list:
        for place in places_in(FOLDERS)[options.list]:
            print(f"{place.path}:{place.line}: {place.text.splitlines()[0]}")
        return 0
    standing: dict[str, dict[str, int]] = json.loads(LIST.read_text(encoding="utf-8")) if LIST.exists() else {}
    now = counts()
    risen = [
        f"{tic} in {room}: {now[tic][room]}, and {standing[tic][room]} stand in {LIST.name}"
        for tic in standing
        for room in standing[tic]
        if now[tic][room] > standing[tic][room]
    ]
    if options.renew:
        kinds = {
            tic: {
                room: count if options.higher else min(count, standing.get(tic, {}).get(room, count))
                for room, count in rooms.items()
            }
            for tic, rooms in now.items()
        }
        LIST.write_text(json.dumps(kinds, indent=1) + "\n", encoding="utf-8")
    if options.check:
        if risen:
            advice = "CONTRIBUTING says how to write instead; `python -m bench.suite.dialect --list TIC` says where."
            print("\n".join([*risen, advice]), file=sys.stderr)
        return 1 if risen else 0
    for tic, rooms in now.items():
        print(f"{tic}: " + ", ".join(f"{room} {count}" for room, count in rooms.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
