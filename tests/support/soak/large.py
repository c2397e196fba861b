"""`large`: a run that grows to 10,000 viewpoints and 50 GB; the cost of every operation must stay linear.

Measured at each size: the cost of another viewpoint (store, runner), `status`, `audit show`, `audit verify` (with and
without the files), and the pages right after the server started, requested again, and while following the run.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.run_events import StepNote
from service.store.verification.verify import verify
from tests.support.pages.web import Browser, web_site
from tests.support.soak.fit import Duration, exponent
from tests.support.soak.large_record import STEP, TIMED, LargeRecord

MOST_EXPONENT = 1.15
PAGE_S = 1.0  # limit for a page of the largest run, requested again or following the run
FIRST_S = 5.0  # limit for the first page after the server started, which reads the whole run
SMALL_S = 0.05  # operations faster than this at the largest size need no order of growth
_LOOKS = 3  # repetitions; the fastest counts, since other load only adds time
_SHEET = 60

Times = dict[str, Duration]


def large(folder: Path, sizes: Sequence[int], gigabytes: float) -> dict[str, Any]:
    """Grow a run through these sizes to `gigabytes` of photographs.

    Returns the times at each size, and the faults.
    """
    record = LargeRecord(folder, sizes[-1] + 200, int(gigabytes * 1e9 / sizes[-1]))
    at: dict[int, Times] = {}
    try:
        for size in sizes:
            brought = record.grow(size)
            print(f"large: {size} viewpoints are there", flush=True)
            at[size] = {"ingest of a viewpoint": _middle(brought)}
            at[size] |= commands(record)
            at[size] |= pages(record)
            resumed, between = record.take(4)
            at[size] |= {"resume until the first exposure": resumed, "runner, one viewpoint": _middle(between)}
            print(json.dumps({name: [round(s, 4) for s in took] for name, took in at[size].items()}), flush=True)
        room = _room(folder / "data")
    finally:
        record.close()
    rows = judge(at)
    return {
        "sizes": list(sizes),
        "photograph_bytes": record.photograph_bytes,
        **room,
        "rows": rows,
        "faults": [fault for row in rows for fault in row["faults"]],
    }


def commands(record: LargeRecord) -> Times:
    """Times of the commands used at the terminal, without the start of Python."""
    data = str(record.folder / "data")
    runner = CliRunner()

    def command(*words: str) -> None:
        answer = runner.invoke(app, [*words, "--data", data, "--json"])
        assert answer.exit_code == 0, answer.output[-2000:]

    def verified(*, files: bool) -> None:
        report = verify(record.folder / "data", record.run_id, files=files)
        assert report.ok, report.first_fault

    return {
        "status": _shortest(lambda: command("status", "latest")),
        "audit show": _shortest(lambda: command("audit", "show", "latest")),
        "audit verify, records alone": _shortest(lambda: verified(files=False)),
        "audit verify": _shortest(lambda: verified(files=True), looks=1),
    }


def _addresses(record: LargeRecord) -> dict[str, str]:
    """Pages by their names."""
    run = record.run_id
    return {
        "home": "/",
        "run": f"/runs/{run}",
        "capture": f"/runs/{run}/capture?step={STEP}",
        "contact sheet, last page": f"/runs/{run}/capture?step={STEP}&page={max(1, record.taken // _SHEET)}",
        "audit": f"/audit/runs/{run}",
        "audit, timeline": f"/audit/runs/{run}/timeline?after={record.taken}",
        "audit, artefacts": f"/audit/runs/{run}/artefacts?kind=image&page=9",
        "audit, provenance": f"/audit/runs/{run}/provenance",
        "metrics": "/metrics",
    }


def _parts(run: str) -> dict[str, str]:
    """Parts of pages that screens ask for after each event."""
    return {
        "run": f"/runs/{run}/parts/banner,control,vitals,step,actions,side",
        "capture": f"/runs/{run}/capture/parts/image,plan,sheet?step={STEP}",
    }


def pages(record: LargeRecord) -> Times:
    """Times of every page: the first of a new server, requested again, and after one more event."""
    found: Times = {}
    run = record.run_id
    with web_site(record.folder) as web, web.browser("technician") as browser, web.browser("auditor") as auditor:
        assert isinstance(browser, Browser)
        assert isinstance(auditor, Browser)

        def get(address: str, who: Browser = browser) -> str:
            answer = who.get(address)
            assert answer.status_code == 200, (address, answer.status_code, answer.text[-500:])
            return answer.text

        began = Duration.now()
        get("/")
        found["first page of a server"] = Duration.now().since(began)
        get(f"/audit/runs/{run}", auditor)
        while "data-pending" in get(f"/audit/runs/{run}", auditor):
            time.sleep(0.05)
        found["auditor's first page filled in"] = Duration.now().since(began)
        for name, address in _addresses(record).items():
            who = auditor if address.startswith("/audit") else browser
            get(address, who)
            while "data-pending" in get(address, who):
                time.sleep(0.05)
            found[f"page: {name}"] = _shortest(lambda: get(address, who))  # noqa: B023 - called at once
        for name, address in _parts(run).items():

            def news(address: str = address) -> None:
                get(address)

            def happen() -> None:
                note = StepNote(step=STEP, attempt=1, note="soaked")
                record.store.record(run, [note], actor="runner")

            found[f"page follows: {name}"] = _shortest(news, before=happen)
    return found


def judge(at: dict[int, Times]) -> list[dict[str, Any]]:
    """One row per measured operation: seconds by size, order of growth, and its fault if any."""
    rows: list[dict[str, Any]] = []
    sizes = list(at)
    for name in at[sizes[-1]]:
        took = [at[size][name] for size in sizes]
        seconds = [one.cpu_s for one in took]  # wall time also contains other load
        order = exponent(sizes, seconds) if len(sizes) > 1 else float("nan")
        faults: list[str] = []
        if len(sizes) > 1 and order > MOST_EXPONENT and seconds[-1] > SMALL_S:
            faults.append(f"{name} grows with the power {order:.2f} of the viewpoints")
        limit_s = PAGE_S if name.startswith("page") else FIRST_S if name.startswith("first page") else None
        if limit_s is not None and seconds[-1] > limit_s:
            faults.append(f"{name} takes {seconds[-1]:.1f} s at {sizes[-1]} viewpoints, more than {limit_s:g} s")
        row = {"what": name, "seconds": [round(s, 5) for s in seconds], "order": round(order, 3), "faults": faults}
        rows.append({**row, "wall_s": [round(one.wall_s, 5) for one in took]})
    return rows


def table(found: dict[str, Any]) -> list[str]:
    """Format the findings as Markdown lines."""
    sizes = found["sizes"]
    gigabytes, written = found["artefact_bytes"] / 1e9, found["disk_bytes"] / 1e9
    lines = [
        f"One run of {sizes[-1]:,} viewpoints: {found['files']:,} files of {gigabytes:.1f} GB together, which take "
        f"{written:.2f} GB of the disk. Photographs are sparse ({found['photograph_bytes'] / 1e6:.0f} MB each: a "
        "small JPEG and a hole); the store, its hashes, fsyncs and transactions are the real ones, but that zeros "
        f"are not written and only the last {TIMED} viewpoints before each size sync their files one by one. So this "
        "says nothing of the disk's speed, of which the part `speed` tells. Seconds of the processor, the least "
        f"of {_LOOKS} (verification with the files: one; ingest: median of those {TIMED}); the wall's at the end.",
        "",
        "| what | " + " | ".join(f"{size:,}" for size in sizes) + " | on the wall | grows with the power | |",
        "|---|" + "---:|" * (len(sizes) + 2) + "---|",
    ]
    for row in found["rows"]:
        cells = " | ".join(f"{s:.3f}" if s < 10 else f"{s:.1f}" for s in row["seconds"])
        verdict = "; ".join(row["faults"]) or "ok"
        lines.append(f"| {row['what']} | {cells} | {row['wall_s'][-1]:.3f} | {row['order']:.2f} | {verdict} |")
    return lines


def _shortest(
    act: Callable[[], object], *, looks: int = _LOOKS, before: Callable[[], object] = lambda: None
) -> Duration:
    took: list[Duration] = []
    for _ in range(looks):
        before()
        began = Duration.now()
        act()
        took.append(Duration.now().since(began))
    return min(took, key=lambda one: one.cpu_s)


def _middle(took: Sequence[Duration]) -> Duration:
    return Duration(statistics.median(one.wall_s for one in took), statistics.median(one.cpu_s for one in took))


def _room(data: Path) -> dict[str, int]:
    files = [path.stat() for path in (data / "artefacts").rglob("*") if path.is_file()]
    return {
        "files": len(files),
        "artefact_bytes": sum(file.st_size for file in files),
        "disk_bytes": 512 * sum(file.st_blocks for file in files),
        "database_bytes": sum(os.path.getsize(path) for path in data.glob("orthocapture.sqlite*")),
    }
