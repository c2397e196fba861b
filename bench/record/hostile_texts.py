"""Texts that mean harm, at every place that prints or stores them: `python -m bench.record.hostile_texts`.

Texts with brackets, escapes, NUL, surrogates, turned directions and elements of pages (tests/support/hostile_text.py)
are printed and typed at every place, stored as everything that a record names, read again by every command and page,
and exported (tests/support/hostile_places.py). Nothing of them may be obeyed by a terminal or a page, end a command
otherwise than in words, or make a record that another database would refuse. Figures go to
bench/results/hostile_texts-DATE. Exit status: 1 if anything of this happened.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import chdir
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from bench.machine import RESULTS, commit, machine
from service.audit import bundle_verifier
from service.cli.main import app
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.hostile_places import (
    ELSEWHERE,
    ON_A_TERMINAL,
    PAGES,
    READING,
    STORED_AS,
    TYPED_IN,
    can_be_stored_as,
    elements_made,
    printed_at,
    read_by,
    record_of_hostile_texts,
    refused_by_other_databases,
    settled,
    typed_in,
)
from tests.support.hostile_text import HOSTILE, obeyed
from tests.support.pages.web import web_site
from tests.support.record.store import start_run


@dataclass(frozen=True, slots=True)
class Attempt:
    """A text at a place, and what was wrong with what came of it; "" if nothing was."""

    kind: str
    place: str
    text: str
    wrong: str


def main() -> int:
    """Try every text everywhere, print and write the table."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as work:
        found = [*_printed(), *_typed(Path(work)), *_stored(Path(work)), *_read(Path(work))]
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "attempts": [asdict(attempt) for attempt in found],
    }
    text = _table(about, found)
    sys.stdout.write(text)
    stem = RESULTS / f"hostile_texts-{about['date']}"
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return int(any(attempt.wrong for attempt in found))


def _printed() -> Iterator[Attempt]:
    for place in (*ON_A_TERMINAL, *ELSEWHERE):
        for name, text in HOSTILE.items():
            printed = printed_at(place, text)
            yield Attempt("printed", place, name, _obeyed(printed) or _verdict(printed, place))


def _typed(work: Path) -> Iterator[Attempt]:
    """In commands; a shell gives them no NUL."""
    for words in TYPED_IN:
        for name, text in HOSTILE.items():
            if "\x00" not in text:
                with tempfile.TemporaryDirectory(dir=work) as empty, chdir(empty):
                    status, printed, fault = typed_in(words, text)
                    wrong = repr(fault) if fault else _obeyed(printed) or _verdict(printed, "")
                    wrong = wrong or ("" if status in (0, 1, 2) else f"it ended with {status}")
                    wrong = wrong or ("it made files" if any(Path().iterdir()) else "")
                yield Attempt("typed", f"orthocapture {' '.join(words).replace('{}', '…')}", name, wrong)


def _stored(work: Path) -> Iterator[Attempt]:
    for place, store_it in STORED_AS.items():
        for name, text in HOSTILE.items():
            if can_be_stored_as(place, text):
                with tempfile.TemporaryDirectory(dir=work) as folder:
                    data = Path(folder) / "data"
                    with Store.open(data) as store:
                        store_it(store, start_run(store), text)
                    report = verify(data)
                    wrong = "" if report.ok else str(report.first_fault)
                    wrong = wrong or ("another database would refuse it" if refused_by_other_databases(data) else "")
                yield Attempt("stored", place, name, wrong)


def _read(work: Path) -> Iterator[Attempt]:
    """A record of all of them at once, by every command and page, and exported."""
    (work / "record").mkdir()
    data, *runs = record_of_hostile_texts(work / "record")
    for run, other, state in ((*runs, "completed"), (*reversed(runs), "open")):
        for name, words in READING.items():
            wrong = ""
            for status, printed, fault in read_by(name, data, run, other):
                wrong = wrong or (repr(fault) if fault else _obeyed(printed) or _verdict(printed, name))
                wrong = wrong or ("" if status in (0, 1, 2) else f"it ended with {status}")
            yield Attempt("read", f"orthocapture {' '.join(word for word in words if '{' not in word)}", state, wrong)
    yield from _exported(data, runs[0], work)
    with web_site(data.parent) as site:
        browser = site.browser("administrator")
        for run, state in zip(runs, ("completed", "open"), strict=True):
            for page in PAGES:
                status, text = settled(browser, page.format(run=run))
                made = elements_made(text)
                wrong = f"it made {made[0]}" if made else ""
                wrong = wrong or ("" if status in (200, 404) else f"it answered {status}")
                yield Attempt("read", f"page {page.format(run='…')}", state, wrong)


def _exported(data: Path, run: str, work: Path) -> Iterator[Attempt]:
    for words in (
        ["audit", "report", run, "--html", str(work / "r.html"), "--pdf", str(work / "r.pdf")],
        ["audit", "export", run, str(work / "b.zip")],
    ):
        done = CliRunner().invoke(app, [*words, "--data", str(data), "--operator", "Ada"])
        wrong = "" if done.exit_code == 0 else repr(done.exception)
        yield Attempt("read", f"orthocapture {' '.join(words[:2])}", "completed", wrong or _obeyed(done.output))
    made = elements_made((work / "r.html").read_text(encoding="utf-8"))
    yield Attempt("read", "the report as a page", "completed", f"it made {made[0]}" if made else "")
    check = bundle_verifier.Check()
    check.run(work / "b-SIMULATED.zip", None, None)
    wrong = str(check.faults[0]) if check.faults else _obeyed(bundle_verifier.report(check))
    yield Attempt("read", "the verifier of the bundle", "completed", wrong)


def _obeyed(printed: str) -> str:
    found = obeyed(printed)
    return f"a terminal would obey {found[0]!r}" if found else ""


def _verdict(printed: str, place: str) -> str:
    """Say whether a text made a line of its own. Documents keep their lines; `audit verify` has one verdict."""
    most = 1 if place.startswith("verify") or place == "a document" else 0
    made = sum(line.startswith("Verified") for line in printed.splitlines())
    return "a line of a text reads like a verdict" if made > most else ""


def _table(about: dict[str, Any], found: Sequence[Attempt]) -> str:
    cpu = about["machine"]
    places: dict[tuple[str, str], list[Attempt]] = defaultdict(list)
    for attempt in found:
        places[attempt.kind, attempt.place].append(attempt)
    wrong = [attempt for attempt in found if attempt.wrong]
    lines = [
        f"# Texts that mean harm, at every place that prints or stores them ({about['date']})",
        "",
        f"`python -m bench.record.hostile_texts`; commit {about['commit']}; {cpu['processor']}, "
        f"Python {cpu['python']}.",
        f"{len(HOSTILE)} texts, {len(places)} places, {len(found)} attempts, {len(wrong)} with a fault.",
        "What is read has all texts at once, in a completed run and in an open one.",
        "",
        f"Texts: {', '.join(HOSTILE)}.",
        "",
        "| | place | attempts | with a fault |",
        "|---|---|---:|---:|",
    ]
    for (kind, place), attempts in places.items():
        faults = sum(bool(attempt.wrong) for attempt in attempts)
        lines.append(f"| {kind} | {place.replace('|', '/')} | {len(attempts)} | {faults} |")
    lines += ["", *(f"- {one.kind}, {one.place}, {one.text}: {one.wrong}" for one in wrong)] if wrong else []
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
