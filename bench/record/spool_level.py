"""What the fill level of the spool costs a page of a large site: `python -m bench.record.spool_level`.

A database of many artefacts is generated, all of them confirmed but the newest. The level is read as the pages read
it: what the uploader counted, and what was recorded since. Beside it stands a count of everything, as the pages
made it before; they make it now only where no uploader has ever counted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sqlite3
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.machine import RESULTS, commit, machine
from service.store.data_folder import object_store_of
from service.store.database.engine import database_path
from service.store.durable_effects import utc_text
from service.store.objects.spool import CountedSpool, Waiting, last_position, read_waiting, spool_level, write_counted
from service.store.store import Store

_A_RUN = 100  # artefacts of one run
_WAITING = 20  # of the newest artefacts
_PAGES, _COUNTED = "as the pages read it", "counting everything, as before"
_SITE = "object_store: {url: 's3://bucket/site', endpoint: 'http://127.0.0.1:9'}\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Generate, measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--artefacts", type=int, nargs="+", default=[10_000, 1_000_000])
    parser.add_argument("--folder", type=Path, default=None, help="on the disk to measure")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for count in options.artefacts:
        with tempfile.TemporaryDirectory(dir=options.folder) as work:
            rows.append({"artefacts": count, "median_ms": _measure(Path(work), count)})
            sys.stderr.write(f"{rows[-1]}\n")
    about = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "waiting": _WAITING,
        "rows": rows,
    }
    report = _report(about)
    sys.stdout.write(report)
    stem = options.results / f"spool_level-{about['date']}"
    stem.with_suffix(".md").write_text(report)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return 0


def _measure(data: Path, count: int) -> dict[str, float]:
    """Milliseconds of one reading, by way."""
    with Store.open(data):
        pass
    (data / "site.yaml").write_text(_SITE)
    section = object_store_of(data)
    assert section is not None
    place = section.place
    with closing(sqlite3.connect(database_path(data))) as raw:
        _generate(raw, count, place)
    with Store.open(data) as store:
        with store.database.reading() as connection:
            waiting = read_waiting(connection, place)
            until = last_position(connection) - 2 * _WAITING  # an uploader counted a moment ago
        nothing = Waiting(0, 0, "", waiting.confirmed)
        write_counted(data, CountedSpool(place, utc_text(datetime.now(UTC)), until, until, "", nothing))
        level = spool_level(store)
        assert level is not None
        assert level.waiting == waiting

        def count_everything() -> None:
            with store.database.reading() as connection:
                read_waiting(connection, place)

        return {
            _COUNTED: _median_ms(count_everything, 3),
            _PAGES: _median_ms(lambda: spool_level(store), 30),
        }


def _median_ms(read: Callable[[], object], times: int) -> float:
    taken: list[float] = []
    for _ in range(times):
        begun_s = time.perf_counter()
        read()
        taken.append(1e3 * (time.perf_counter() - begun_s))
    return round(statistics.median(taken), 2)


def _generate(raw: sqlite3.Connection, count: int, place: str) -> None:
    """Fill the tables that a level is read from; the rows verify as nothing."""

    def names() -> Iterator[tuple[int, str, int, str]]:
        for number in range(count):
            run, seq = divmod(number, _A_RUN)
            yield number, f"run-{run:06d}", seq + 2, hashlib.sha256(b"%d" % number).hexdigest()

    at_utc = utc_text(datetime.now(UTC))
    with raw:
        raw.executemany(
            "INSERT INTO event_index (run_id, seq, kind, actor) VALUES (?, ?, 'viewpoint_captured', 'runner')",
            ((run, seq) for _, run, seq, _ in names()),
        )
        raw.executemany(
            "INSERT INTO artefacts (run_id, seq, position, sha256, kind, media_type, size_bytes, original_name, "
            "device, who, at_utc, monotonic_s, record_sha256) "
            "VALUES (?, ?, 0, ?, 'image', 'image/jpeg', 8000000, 'v.jpg', 'camera', 'runner', ?, 1.0, ?)",
            ((run, seq, sha256, at_utc, sha256) for _, run, seq, sha256 in names()),
        )
        raw.executemany(
            "INSERT INTO copies VALUES (?, ?, 8000000, ?, ?)",
            ((sha256, place, at_utc, at_utc) for number, _, _, sha256 in names() if number < count - _WAITING),
        )


def _report(about: dict[str, Any]) -> str:
    cpu = about["machine"]
    lines = [
        f"# What the fill level of the spool costs a page ({about['date']})",
        "",
        f"`python -m bench.record.spool_level`; commit {about['commit']}; {cpu['processor']}, {cpu['cores']} cores, "
        f"Python {cpu['python']}, load {about['load']};",
        f"a generated SQLite database; all artefacts but the newest {about['waiting']} are confirmed; medians.",
        "",
        f"| artefacts | {_COUNTED}, ms | {_PAGES}, ms |",
        "|---|---|---|",
    ]
    for row in about["rows"]:
        figures = row["median_ms"]
        lines.append(f"| {row['artefacts']} | {figures[_COUNTED]} | {figures[_PAGES]} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
