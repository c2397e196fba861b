"""Response times of a run's pages of its data set and its exports, on the server, with 108 views."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench.machine import RESULTS, commit, machine
from service.dataset.preview_records import Preview, read_preview, write_preview
from tests.support.pages.web import Browser, web_site
from tests.support.recorded.unpacked_run import unpack_recorded_run

LIMIT_MS = 200.0
VIEWS = 108  # of the paper's protocol
_MAKING_S = 1800.0


def main(words: Sequence[str] | None = None) -> int:
    """Make the preview of the recorded run, repeat its views up to 108, and measure. Returns 1 if a page is slow."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=20, help="requests of each page after the first")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as scratch:
        unpack_recorded_run(Path(scratch))
        with web_site(Path(scratch)) as web, web.browser("supervisor") as browser:
            assert isinstance(browser, Browser)
            run = web.store.runs()[0].run_id
            here = f"/runs/{run}"
            begun = time.perf_counter()
            browser.get(f"{here}/dataset")
            asked_ms = 1e3 * (time.perf_counter() - begun)  # nothing is ready: this begins to make it
            web.app.state.previews.wait(run, _MAKING_S)
            made_s = time.perf_counter() - begun
            folder = next((web.site.data / "cache" / "dataset").iterdir())
            preview = read_preview(folder)
            if preview is None or not preview.whole:
                raise SystemExit(f"no preview was made: {web.app.state.previews.making(run)}")
            write_preview(folder, many(preview))
            browser.get(f"{here}/exports")
            web.app.state.formats.known(wait_s=_MAKING_S)
            pages = _pages(here, preview)
            rows = {name: measured(browser, path, options.repeat) for name, path in pages.items()}
    about = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "limit_ms": LIMIT_MS,
        "views": VIEWS,
        "first_request_ms": round(asked_ms, 1),
        "made_s": round(made_s, 1),
        "made_views": len(preview.views),
        "pages": rows,
    }
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / "data_set_pages.json").write_text(json.dumps(about, indent=1) + "\n")
    for name, row in rows.items():
        sys.stdout.write(f"{name:24} median {row['median_ms']:7.1f} ms, p95 {row['p95_ms']:7.1f} ms\n")
    return int(any(row["p95_ms"] > LIMIT_MS for row in rows.values()))


def _pages(here: str, preview: Preview) -> dict[str, str]:
    """Addresses of the pages and frames of a data set, by their names."""
    return {
        "data set": f"{here}/dataset",
        "data set, another view": f"{here}/dataset?split=train&view={preview.views[-1].name}",
        "coverage, frame": f"{here}/dataset/coverage/frame",
        "distances, frame": f"{here}/dataset/distances/frame",
        "picture": f"{here}/dataset/pictures/{preview.views[0].image}",
        "exports": f"{here}/exports",
    }


def many(preview: Preview) -> Preview:
    """The preview with its views repeated under other names."""
    views = [
        dataclasses.replace(preview.views[k % len(preview.views)], name=f"view_{k:03d}") for k in range(VIEWS - 1)
    ]
    return dataclasses.replace(preview, views=(*views, preview.views[-1]))


def measured(browser: Browser, path: str, repeat: int) -> dict[str, float]:
    """Milliseconds of some requests after the first."""
    took: list[float] = []
    for _ in range(repeat + 1):
        begun = time.perf_counter()
        answer = browser.get(path)
        took.append(1e3 * (time.perf_counter() - begun))
        if answer.status_code != 200:
            raise SystemExit(f"{path}: {answer.status_code}")
    later = sorted(took[1:])
    return {
        "first_ms": round(took[0], 1),
        "median_ms": round(statistics.median(later), 1),
        "p95_ms": round(later[min(len(later) - 1, int(0.95 * len(later)))], 1),
    }


if __name__ == "__main__":
    raise SystemExit(main())
