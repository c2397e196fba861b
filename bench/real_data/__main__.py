"""The stand-alone commands on public data sets: where to get them, what to expect, and a table of results.

`python -m bench.real_data --data DIR` runs every set found in DIR under its name, and says how to get the others.
"""

from __future__ import annotations

import argparse
import json
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.machine import RESULTS, commit, machine
from bench.real_data.sets import SETS, PublicSet
from service.core.errors import OrthocaptureError


def run(one: PublicSet, data: Path, work: Path) -> dict[str, Any]:
    """Run a data set; returns its row with the result and whether it is as expected. A refusal is a result too."""
    row: dict[str, Any] = {"set": one.name, "what": one.what, "licence": one.licence, "expected": one.expected}
    folder = data / one.folder
    if one.measure is None or not folder.is_dir():
        return row | {"ran": False, "figures": "", "as_expected": None}
    begin = time.monotonic()
    out = work / one.name
    out.mkdir(parents=True, exist_ok=True)
    try:
        figures, good = one.measure(folder, out)
    except OrthocaptureError as error:
        figures, good = f"refused: {error.what}", False
    return row | {"ran": True, "figures": figures, "as_expected": good, "seconds": round(time.monotonic() - begin)}


def table(rows: list[dict[str, Any]]) -> str:
    """Format the rows as Markdown, with the sets that were not run below."""
    lines = ["| set | data | expected | result | as expected | s |", "|---|---|---|---|---|---|"]
    for row in rows:
        if row["ran"]:
            good = "yes" if row["as_expected"] else "**no**"
            lines.append(
                f"| {row['set']} | {row['what']} | {row['expected']} | {row['figures']} | {good} | {row['seconds']} |"
            )
    lines += [
        "",
        "Not run on this machine, because the data or the time was missing:",
        "",
        "| set | data | expected | where to get it | licence |",
    ]
    lines.append("|---|---|---|---|---|")
    ran = {row["set"] for row in rows if row["ran"]}
    lines += [
        f"| {one.name} | {one.what} | {one.expected} | {one.where} | {one.licence} |"
        for one in SETS
        if one.name not in ran
    ]
    lines += ["", "Sources of the sets that were run:", ""]
    lines += [f"- {one.name}: {one.where}; {one.licence}" for one in SETS if one.name in ran]
    return "\n".join(lines)


def main() -> None:
    """Run the available sets, list the missing ones, and write the table if anything ran."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with one subfolder per data set")
    parser.add_argument("--only", default="", help="part of a set's name")
    parser.add_argument("--work", type=Path, default=Path("build/real-data"), help="folder for the commands' output")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    file = options.out / f"real_data-{datetime.now(UTC):%Y-%m-%d}.json"
    before = {row["set"]: row for row in json.loads(file.read_text())["rows"]} if file.exists() else {}
    rows: list[dict[str, Any]] = []
    ran = False
    for one in SETS:
        row = run(one, options.data, options.work) if options.only in one.name else None
        if row is not None and row["ran"]:
            ran = True
            print(
                f"{one.name}: {row['figures']} ({'as' if row['as_expected'] else 'NOT as'} expected: {one.expected})"
            )
        elif row is not None:
            needed = "" if one.measure is None else f", into {options.data / one.folder}"
            print(f"{one.name}: not run. {one.where}{needed}")
        # Keep earlier rows if only some sets were requested.
        rows.append(
            row if row is not None and row["ran"] else before.get(one.name, row or run(one, Path("/"), Path()))
        )
    if not ran:
        return
    here = machine()
    document = {"machine": here, "commit": commit(), "rows": rows}
    file.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    text = f"""# Stand-alone commands on public data

`python -m bench.real_data --data DIR`; {here["processor"]}, {here["cores"]} cores, shared with other work. OpenCV's
figures are measured beside, on the same images, by its own detectors and solvers (bench/real_data/sets.py).

{table(rows)}
"""
    file.with_suffix(".md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
