"""Response times of the auditor's pages on the server, for a run of 100 000 events and 10 000 artefacts."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import os
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import quote

from bench.machine import RESULTS, commit, machine
from service.core.records.run_events import StepNote
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import Browser, web_site
from tests.support.record.store import captured
from tests.support.record.store import start_run as start_small_run
from tests.support.recorded.large_run import Sizes, write_large_run

LIMIT_MS = 200.0


def main(words: Sequence[str] | None = None) -> int:
    """Write the run, verify it, measure every page, and print and write the table.

    Returns 1 if a page is too slow.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=100_000)
    parser.add_argument("--repeat", type=int, default=20, help="requests of each page after the first")
    parser.add_argument(
        "--work", type=Path, help="folder in which to keep the run for reuse; default: a temporary folder"
    )
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    with contextlib.ExitStack() as stack:
        folder = options.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        about = prepare(folder, options.events)
        about["append_ms"] = appending(folder)
        with web_site(folder) as web, web.browser("auditor") as browser:
            assert isinstance(browser, Browser)
            about["pages"] = measure(browser, about["run"], web.store, options.repeat)
            about["filled_in_s"] = about["pages"].pop("filled_in_s")
    about |= {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "limit_ms": LIMIT_MS,
    }
    sys.stdout.write(table(about))
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / "audit_scale.json").write_text(json.dumps(about, indent=1) + "\n")
    return int(any(row["p95_ms"] > LIMIT_MS or row["first_ms"] > LIMIT_MS for row in about["pages"].values()))


def prepare(folder: Path, events: int) -> dict[str, Any]:
    """Write the run and verify its chain and every file."""
    data = folder / "data"
    begun = time.perf_counter()
    note = folder / "written_s"
    if not data.exists():
        part = events / 100_000
        whole = Sizes()
        sizes = {name: int(getattr(whole, name) * part) for name in Sizes.__dataclass_fields__}
        write_large_run(data, Sizes(**sizes))
        note.write_text(f"{time.perf_counter() - begun:.1f}")
    begun = time.perf_counter()
    report = verify(data)
    if not report.ok:
        raise SystemExit(f"the run does not verify: {report.first_fault}")
    run = next(name for name in report.runs if name != "site")
    return {
        "run": run,
        "events": report.events,
        "artefacts": report.artefacts,
        "jobs": report.jobs,
        "written_s": float(note.read_text()),
        "verified_s": round(time.perf_counter() - begun, 1),
    }


def appending(folder: Path) -> dict[str, dict[str, float]]:
    """Milliseconds to append one event in its own transaction, with and without the index of events."""
    found: dict[str, dict[str, float]] = {}
    for name, indexed in (("without_index", False), ("with_index", True), ("with_index_in_large", True)):
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            store = Store.open(folder / "data" if name.endswith("large") else Path(scratch))
            index = contextlib.nullcontext() if indexed else mock.patch("service.store.events.index_events")
            with store, index:
                run = start_small_run(store)
                found[name] = _append_ms(store, run)
    return found


def _append_ms(store: Store, run: str) -> dict[str, float]:
    note = StepNote(step="s", attempt=1, note="something happened here", data={"word": "of some length"})
    ref = store.put_bytes(b"x", kind="rig", media_type="text/yaml", original_name="rig.yaml")
    view = captured(ref, "v1").model_copy(update={"artefacts": ()})
    return {
        "note": _median_ms(lambda: store.record(run, [note], actor="Ada"), 300),
        "viewpoint": _median_ms(lambda: store.record(run, [view], actor="Ada"), 300),
    }


def _median_ms(act: Callable[[], object], times: int) -> float:
    return round(statistics.median(_times_ms(act, times)), 3)


def _times_ms(act: Callable[[], object], times: int) -> list[float]:
    taken: list[float] = []
    for _ in range(times):
        begun = time.perf_counter()
        act()
        taken.append((time.perf_counter() - begun) * 1000)
    return taken


def measure(browser: Browser, run: str, store: Store, repeat: int) -> dict[str, Any]:
    """Time of the first request, median and 95th percentile for every page."""
    here = f"/audit/runs/{run}"

    def get(address: str) -> str:
        answer = browser.get(address, headers={"accept": "text/html"})
        if answer.status_code != 200:
            raise SystemExit(f"{address} answers {answer.status_code}")
        return answer.text

    rows: dict[str, Any] = {}
    begun = time.perf_counter()
    # The first request of this process: nothing is computed yet, and the page says so.
    cold = _times_ms(lambda: get(here), 1)[0]
    while "data-pending" in get(here):
        time.sleep(0.1)
    filled_in_s = time.perf_counter() - begun
    cold_graph = _times_ms(lambda: get(f"{here}/provenance"), 1)[0]
    while "data-pending" in get(f"{here}/provenance"):
        time.sleep(0.1)
    for name, address in pages(here, get).items():
        first = {here: cold, f"{here}/provenance": cold_graph}.get(address) or _times_ms(lambda: get(address), 1)[0]  # noqa: B023 - called at once
        cpu = time.process_time()
        taken = sorted(_times_ms(lambda: get(address), repeat))  # noqa: B023 - called at once
        cpu = (time.process_time() - cpu) * 1000 / repeat
        rows[name] = {
            "address": address.replace(run, "RUN"),
            "first_ms": round(first, 1),
            "median_ms": round(statistics.median(taken), 1),
            "p95_ms": round(taken[min(len(taken) - 1, round(0.95 * len(taken)))], 1),
            "cpu_ms": round(cpu, 1),  # of this process, client included; independent of other load
            "kilobytes": round(len(get(address)) / 1000),
        }
    return rows | {"filled_in_s": round(filled_in_s, 1)}


def pages(here: str, get: Callable[[str], str]) -> dict[str, str]:
    """URLs of every page, including demanding filters and searches."""
    files = re.findall(r"/artefacts/([0-9a-f]{64})", get(f"{here}/artefacts?kind=image&page=20"))
    results = re.findall(r"/artefacts/([0-9a-f]{64})", get(f"{here}/artefacts?kind=live_view&page=20"))
    return {
        "runs": "/audit",
        "runs, filtered": "/audit?deviations=1&unverified=1&status=completed&q=demo",
        "first page": here,
        "deviations": f"{here}/deviations",
        "deviations, last page": f"{here}/deviations?page=99999",
        "deviations, one group": f"{here}/deviations?group=redone&page=3",
        "timeline": f"{here}/timeline",
        "timeline, in the middle": f"{here}/timeline?after=50000",
        "timeline, end": f"{here}/timeline?before=999999",
        "timeline, common kind": f"{here}/timeline?kind=step_note&after=60000",
        "timeline, rare kind": f"{here}/timeline?kind=run_completed",
        "timeline, step": f"{here}/timeline?step=viewpoint_capture_1&after=40000",
        "timeline, rare step": f"{here}/timeline?step=evaluation",
        "timeline, person": f"{here}/timeline?person=Grace&before=90000",
        "timeline, device": f"{here}/timeline?device=camera",
        "timeline, device and kind": f"{here}/timeline?device=robot&kind=device_trouble&after=9000",
        "timeline, search a view": f"{here}/timeline?q=v01234",
        "timeline, search common words": f"{here}/timeline?q=station+light&after=60000",
        "timeline, search one letter": f"{here}/timeline?q=s",
        "timeline, search nothing there": f"{here}/timeline?q=zzz",
        "timeline, search hostile": f"{here}/timeline?q={quote(chr(34) + '* OR NOT ( % _ ' + 'a' * 10_000)}",
        "timeline, everything at once": f"{here}/timeline?q=station&kind=step_note&step=viewpoint_capture_1"
        "&person=runner&device=camera",
        "event": f"{here}/events/50000",
        "event, long": f"{here}/events/2",
        "artefacts": f"{here}/artefacts",
        "artefacts, last page": f"{here}/artefacts?page=99999",
        "artefacts, kind and step": f"{here}/artefacts?kind=image&step=viewpoint_capture_1&page=9",
        "artefacts, search": f"{here}/artefacts?q=DSC012",
        "artefacts, search a hash": f"{here}/artefacts?q={files[0][:20]}",
        "artefact, image": f"{here}/artefacts/{files[0]}",
        "artefact, result": f"{here}/artefacts/{results[0]}",
        "provenance": f"{here}/provenance",
        "corrections": f"{here}/corrections",
        "corrections, page 4": f"{here}/corrections?page=4",
        "signatures": f"{here}/signatures",
        "devices": f"{here}/devices",
        "verification": f"{here}/verification",
        "site": "/audit/site",
        "site, searched": "/audit/site?kind=sign_in_recorded&q=lise",
    }


def table(about: dict[str, Any]) -> str:
    """Format the table as Markdown."""
    lines = [
        f"{about['events']} events, {about['artefacts']} artefacts, {about['jobs']} jobs; written in "
        f"{about['written_s']} s, verified in {about['verified_s']} s; deviations filled in after "
        f"{about['filled_in_s']} s.",
        f"Load of the machine: {about['load']}",
        f"Appending one event, median ms: {about['append_ms']}",
        "",
        "| page | first (ms) | median (ms) | p95 (ms) | processor (ms) | size (kB) |",
        "|---|---|---|---|---|---|",
        *(
            f"| {name} | {r['first_ms']} | {r['median_ms']} | {r['p95_ms']} | {r['cpu_ms']} | {r['kilobytes']} |"
            for name, r in about["pages"].items()
        ),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
