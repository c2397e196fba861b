"""Every place that prints or stores a text from outside, and a record whose every text means harm."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import typer
from rich.table import Table
from typer.testing import CliRunner

from service.cli.common import print_document, print_json, print_table, reporting_errors
from service.cli.main import app
from service.cli.operators import Display
from service.cli.terminal_output import Terminal, bar_of_counts, bar_of_shares, listed, styled
from service.core.errors import ConfigurationError
from service.core.records.run_events import DeviceTrouble, OperatorAction, StepNote
from service.core.words import shown
from service.logs import EscapingFormatter
from service.store.database.tables import metadata
from service.store.records import NewArtefact, NewJob
from service.store.signatures.signing import checkpoint, rotate_key
from service.store.store import Store
from tests.support.hostile_text import HOSTILE
from tests.support.pages.web import Browser
from tests.support.processes.waiting import until
from tests.support.record.outsider import rows
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

# --- places that print ---------------------------------------------------------------------------------------------


def _in_a_table(terminal: Terminal, text: str) -> None:
    table = Table(text, title=text)
    table.add_row(text)
    table.add_row(styled((text, "bold")))
    table.add_row(listed(text, text))
    print_table(table, terminal)


def _in_a_bar(terminal: Terminal, text: str) -> None:
    for bar in (bar_of_shares(terminal), bar_of_counts(terminal)):
        bar.add_task(shown(text), total=2)
        terminal.print(bar.get_renderable())


class _Silent:
    """A reporter without screens."""

    def tell(self, message: str) -> None:
        """Nobody is told."""


ON_A_TERMINAL: dict[str, Callable[[Terminal, str], None]] = {
    "a line": lambda terminal, text: terminal.print(f"name: {text}"),
    "a line with styles": lambda terminal, text: terminal.tell(("name:", "bold"), f" {text}", (text, "red")),
    "a box": lambda terminal, text: terminal.boxed(text, title=text),
    "a table": _in_a_table,
    "a bar": _in_a_bar,
    "a line of a run": lambda terminal, text: Display(terminal, _Silent()).tell(text),  # type: ignore[arg-type]
}


def _error(text: str, *, as_json: bool) -> None:
    try:
        with reporting_errors(as_json):
            raise ConfigurationError(text, where=text, remedy=text)
    except typer.Exit:
        pass


def _log_message(text: str) -> None:
    record = logging.LogRecord("drivers", logging.WARNING, __file__, 1, "the device says %s", (text,), None)
    sys.stdout.write(EscapingFormatter("%(name)s %(message)s").format(record))


ELSEWHERE: dict[str, Callable[[str], None]] = {
    "JSON": lambda text: print_json({text: [text]}),
    "a document": lambda text: print_document(f"# {text}\n\nlast\n"),
    "an error": lambda text: _error(text, as_json=False),
    "an error as JSON": lambda text: _error(text, as_json=True),
    "a message of the log": _log_message,
}


def printed_at(place: str, text: str) -> str:
    """What a place prints of a text."""
    stream = io.StringIO()
    if place in ON_A_TERMINAL:
        ON_A_TERMINAL[place](Terminal(file=stream, width=300), text)
    else:
        with redirect_stdout(stream), redirect_stderr(stream):
            ELSEWHERE[place](text)
    return stream.getvalue()


# Commands in which something was typed that nobody wrote: {} is the text.
TYPED_IN: tuple[tuple[str, ...], ...] = (
    ("{}",),
    ("status", "--{}"),
    ("status", "{}", "--data", "nowhere"),
    ("status", "--data", "{}"),
    ("protocol", "check", "{}"),
    ("protocol", "check", "{}", "--json"),
    ("doctor", "--rig", "{}"),
    ("run", "{}", "--rig", "{}", "--json"),
    ("audit", "show", "{}", "--data", "{}"),
    ("audit", "verify", "{}", "--certificates", "{}"),
    ("audit", "report", "--pdf", "{}", "--data", "nowhere"),
    ("simulate", "rig", "--help", "{}"),
    ("serve", "--rig", "{}", "--json"),
    ("plan", "show", "{}"),
    ("replay", "{}", "--data", "nowhere", "--json"),
    ("export", "{}", "{}", "--data", "nowhere"),
    ("act", "{}"),
    ("act", "confirm", "--data", "{}"),
    ("store", "check", "--data", "{}"),
    ("import", "{}", "--json"),
)


def typed_in(words: Sequence[str], text: str) -> tuple[int, str, BaseException | None]:
    """Exit status, output and exception of a command in which a text was typed."""
    done = CliRunner().invoke(app, [word.format(text) for word in words], env={"COLUMNS": "300"})
    fault = None if isinstance(done.exception, SystemExit) else done.exception
    return done.exit_code, done.output, fault


# --- places that store ---------------------------------------------------------------------------------------------


def _as_a_note(store: Store, run: str, text: str) -> None:
    store.record(run, [StepNote(step=text, attempt=1, note=text, data={"x": [text], text: {text: text}})], actor=text)


def _as_a_file(store: Store, run: str, text: str) -> None:
    ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name=text)
    note = StepNote(step="s", attempt=1, note="n", data={"file": ref.model_dump()})
    store.record(run, [note], actor="Ada", artefacts=[NewArtefact(ref, text, step=text, viewpoint=text, who=text)])


def _as_a_name_of_a_file(store: Store, run: str, text: str) -> None:
    path = store.database_path.parent.parent / text
    path.write_bytes(b"x")
    ref = store.put_file(path, kind="image", media_type="image/jpeg")
    note = StepNote(step="s", attempt=1, note="n", data={"file": ref.model_dump()})
    store.record(run, [note], actor="Ada", artefacts=[NewArtefact(ref, "camera")])


def _as_a_job(store: Store, run: str, text: str) -> None:
    job = NewJob("detect", text, 1, text, {"of": text})
    store.record(run, [], actor=text, jobs=[job])
    store.record(run, [], actor=text, jobs=[job])
    assert len(store.jobs(run)) == 1


def _as_a_result(store: Store, run: str, text: str) -> None:
    store.record(run, [], actor="runner", jobs=[NewJob("detect", "s", 1, "k", {})])
    job = store.claim_job(text.replace("\x00", "").encode("utf-8", "ignore").decode(), 10)
    assert job is not None
    store.finish_job(job, measures={}, duration_s=1.0, result={"words": [text]})


def _in_the_sites_chain(store: Store, run: str, text: str) -> None:
    note = StepNote(step=run, attempt=1, note=text)
    store.record_site([note], actor=text, software={"orthocapture": text})


STORED_AS: dict[str, Callable[[Store, str, str], None]] = {
    "note": _as_a_note,
    "file": _as_a_file,
    "file's own name": _as_a_name_of_a_file,
    "job": _as_a_job,
    "result": _as_a_result,
    "site": _in_the_sites_chain,
}


def can_be_stored_as(place: str, text: str) -> bool:
    """Say whether there are such texts; in a file's name a surrogate stands for a byte that is not text."""
    if place != "file's own name":
        return True
    try:
        return b"\0" not in os.fsencode(text) and "/" not in text and len(os.fsencode(text)) < 256
    except UnicodeEncodeError:
        return False


def refused_by_other_databases(data: Path) -> bool:
    """Return whether any row holds NUL or a surrogate, because of which a copy to PostgreSQL would be refused."""
    # The index of words keeps no text that could be read back.
    found = "\n".join(repr(row) for table in metadata.tables for row in rows(data, f"SELECT * FROM {table}"))
    return "\\x00" in found.replace("\\\\x00", "") or "\\\\u0000" in found.replace("\\\\\\\\u0000", "")


# --- a record of nothing else --------------------------------------------------------------------------------------

READING: dict[str, list[str]] = {
    "show": ["audit", "show", "{run}"],
    "verify": ["audit", "verify", "{run}"],
    "verify all": ["audit", "verify", "all"],
    "keys": ["audit", "keys"],
    "status": ["status", "{run}"],
    "runs": ["runs"],
    "compare": ["compare", "{run}", "{other}"],
    "history": ["history"],
    "replay": ["replay", "{run}"],
    "leftovers": ["store", "gc"],
    "release": ["audit", "release", "{run}"],
    "plan": ["plan", "suggested", "{run}"],
}
NOT_AS_JSON = ("history", "plan")


def record_of_hostile_texts(folder: Path) -> tuple[Path, str, str]:
    """A completed run and an open one, with each text in the place of names, notes, reasons, messages and devices."""
    with bench_store(folder / "data") as store:
        completed, waiting = begin_run(store, PROTOCOL, folder), begin_run(store, PROTOCOL, folder)
        for text in HOSTILE.values():
            ref = store.put_bytes(text.encode("utf-8", "replace"), kind="log", media_type="x", original_name=text)
            said = [
                StepNote(step="capture", attempt=1, note=text, data={text: text, "file": ref.model_dump()}),
                DeviceTrouble(device=text, error=text, message=text),
                OperatorAction(action="redo", step=text, viewpoint=text, reason=text, meaning=text),
                OperatorAction(action="skip", step="fixation", reason=text),
            ]
            store.record(waiting.run_id, said, actor=text, artefacts=[NewArtefact(ref, text, step=text, who=text)])
        for text in HOSTILE.values():
            store.record(completed.run_id, [DeviceTrouble(device=text, error=text, message=text)], actor=text)
        assert completed.run().status == "completed"
        checkpoint(store, completed.run_id)
        checkpoint(store, waiting.run_id)
        for text in (HOSTILE["rows above erased"], HOSTILE["NUL"]):
            rotate_key(store, reason=text, actor=text)
    return folder / "data", completed.run_id, waiting.run_id


def read_by(name: str, data: Path, run: str, other: str) -> Iterator[tuple[int, str, BaseException | None]]:
    """Exit status, output and exception of a command that reads the record, as words and as JSON."""
    words = [word.format(run=run, other=other) for word in READING[name]] + ["--data", str(data)]
    for more in ([],) if name in NOT_AS_JSON else ([], ["--json"]):
        done = CliRunner().invoke(app, [*words, *more], env={"COLUMNS": "250"})
        fault = None if isinstance(done.exception, SystemExit) else done.exception
        if more:
            json.loads(done.stdout)
        yield done.exit_code, done.output, fault


_OF_A_RUN = (
    "/runs/{run}",
    "/runs/{run}/checklist",
    "/runs/{run}/dataset",
    "/runs/{run}/exports",
    "/runs/{run}/scene",
)
_TABS = ("timeline", "artefacts", "provenance", "corrections", "signatures", "devices", "verification", "deviations")
PAGES = (
    *("/", "/history", "/audit", "/audit/site", "/compare", "/metrics", "/accounts"),
    *("/runs/{run}", *(f"/runs/{{run}}/{part}" for part in ("checklist", "dataset", "exports", "scene"))),
    *("/audit/runs/{run}", *(f"/audit/runs/{{run}}/{tab}" for tab in _TABS)),
)
_ELEMENTS = re.compile(r"<img src=x|onmouseover=alert\(1\) '\"")


def elements_made(page: str) -> list[str]:
    """What of the texts became elements or attributes of a page."""
    return _ELEMENTS.findall(page)


def settled(browser: Browser, address: str) -> tuple[int, str]:
    """Status and text of a page once nothing of it is still being computed."""
    status, text = 0, ""

    def complete() -> bool:
        nonlocal status, text
        answer = browser.get(address)
        status, text = answer.status_code, answer.text
        return "data-pending" not in text

    until(complete, f"{address} is still being computed", every_s=0.05)
    return status, text
