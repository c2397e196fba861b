"""Every file of a data folder altered in every way at every moment: `python -m bench.journal.meddling`.

Each case is a process of its own: it records photographs and signs, the file is altered, and it goes on. The table
says what noticed the alteration first, and whether everything that had been recorded was there in the end, after
`store rebuild` where the folder did not verify.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import sqlite3
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from argon2 import PasswordHasher

from bench.machine import RESULTS, commit, machine
from service.audit.verifications import Verifications, keep_verification, verification_of
from service.core.errors import OrthocaptureError, StoreError
from service.people.sessions import People
from service.store.database.engine import DATABASE_NAME
from service.store.durable_effects import DurableFiles, SystemClock, utc_text
from service.store.journal import NAME as JOURNAL_NAME
from service.store.restoring import rebuild
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.second_place import SecondPlace, journal_copy
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.store import capture, start_run

# `verification` is the last result of `audit verify` that the pages show; the copies lie in the second place.
_OTHERS = ("key", "pepper", "photograph", "verification", "copy of the signatures", "copy of the journal")
FILES = (DATABASE_NAME, f"{DATABASE_NAME}-wal", f"{DATABASE_NAME}-shm", JOURNAL_NAME, LOG_NAME, *_OTHERS)
MOMENTS = ("idle", "between two captures", "while the run waits", "before a signature", "in a transaction")
_BEFORE = 6  # photographs that are recorded before the file is altered
_LONGEST_S = 120.0
COPY = Path("place") / "signatures.jsonl"
_PIN = "2468"
_QUICK = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


def _zeros(path: Path, _old: Path) -> None:
    size = path.stat().st_size
    with path.open("r+b") as stream:
        stream.write(bytes(size))


def _older_in_place(path: Path, old: Path) -> None:
    content = old.read_bytes()
    with path.open("r+b") as stream:
        stream.truncate(0)
        stream.write(content)


def _half(path: Path, _old: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


WAYS: Mapping[str, Callable[[Path, Path], object]] = {
    "truncated (: >)": lambda path, _old: os.truncate(path, 0),
    "cut in half": _half,
    "overwritten with zeros": _zeros,
    "older copy over it (cp, rsync --inplace)": _older_in_place,
    "older copy renamed over it (mv, rsync)": lambda path, old: old.replace(path),
    "deleted": lambda path, _old: path.unlink(),
}


@dataclass(frozen=True, slots=True)
class Result:
    """Holds what became of one case.

    Attributes:
        file: what was altered.
        way: how.
        moment: when.
        noticed: what noticed it first; "nobody" if everything verified all the same.
        whole: whether every photograph that was recorded is in the record at the end.
        after: how the folder ended: "as it was", "rebuilt", or what verification still says.
    """

    file: str
    way: str
    moment: str
    noticed: str
    whole: bool
    after: str


def main(words: Sequence[str] | None = None) -> int:
    """Try every case, print and write the table. Returns 1 if anything recorded was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--files", nargs="+", choices=FILES, default=list(FILES))
    options = parser.parse_args(words)
    found: list[Result] = []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as work:
        for number, (file, way, moment) in enumerate(_cases(options.files)):
            found.append(_in_a_process(Path(work) / str(number), file, way, moment))
            shutil.rmtree(Path(work) / str(number), ignore_errors=True)
    about = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "cases": [asdict(result) for result in found],
    }
    text = report(about, found)
    sys.stdout.write(text)
    stem = options.results / f"journal_meddling-{about['date']}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return int(any(not result.whole for result in found))


def _cases(files: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    for file in files:
        for way in WAYS:
            for moment in MOMENTS:
                if moment != "idle" or file not in (f"{DATABASE_NAME}-wal", f"{DATABASE_NAME}-shm"):
                    yield file, way, moment


def _in_a_process(work: Path, file: str, way: str, moment: str) -> Result:
    """Try a case in a forked process, which an alteration may kill, and look at what it left."""
    work.mkdir()
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)

    def act() -> None:
        with open(os.devnull, "w") as silent:
            os.dup2(silent.fileno(), 2)
        there.send(_noticed_in_use(work, file, way, moment))
        os._exit(0)  # as a process that is killed: SQLite mends nothing at the end

    child = context.Process(target=act)
    child.start()
    there.close()
    noticed = ""
    if here.poll(_LONGEST_S):
        with suppress(EOFError):
            noticed = str(here.recv())
    child.join(5.0)
    if child.is_alive():
        child.kill()
        child.join()
    if not noticed:
        name = signal.Signals(-child.exitcode).name if child.exitcode and child.exitcode < 0 else child.exitcode
        noticed = f"the process died ({name})"
    return _afterwards(work, file, way, moment, "" if noticed == "-" else noticed)


def _noticed_in_use(work: Path, file: str, way: str, moment: str) -> str:
    """Return what the writing process notices, and where; "-" for nothing."""
    data = work / "data"
    store = Store.open(data)
    (work / "place").mkdir()
    place = SecondPlace.of(data, work / COPY, SystemClock(), DurableFiles(), patience_s=_LONGEST_S)
    people = People(store, _QUICK)
    people.accounts.set_up(people.first_link() or "", "ada", "Ada Lovelace", "a good password", _PIN)
    run_id = start_run(store)
    capture(store, run_id, "v0")
    checkpoint(store, run_id)
    place.update()
    _verified(store, run_id)
    _moved_into_the_database(data)
    capture(store, run_id, "v1")
    shutil.copytree(data, work / "old" / "data")
    shutil.copytree(work / "place", work / "old" / "place")
    for number in range(2, _BEFORE):
        capture(store, run_id, f"v{number}")
        if number == _BEFORE - 2:
            _moved_into_the_database(data)
            checkpoint(store, run_id)
            place.update()
            _verified(store, run_id)
    if moment == "idle":
        store.close()
    meddle = _meddling(work, file, way)
    acts: list[tuple[str, Callable[[], object]]] = [
        ("the next write", lambda: capture(store, run_id, "after")),
        ("the next look", store.database.require_record),
        ("the next signature", lambda: checkpoint(store, run_id)),
    ]
    order = {"between two captures": (0, 1, 2), "while the run waits": (1, 0, 2), "before a signature": (2, 1, 0)}
    # Files that the record does not need are noticed by those who do.
    needing: list[tuple[str, Callable[[], object]]] = [
        ("the second place", lambda: _up_to_date(place)),
        ("the next PIN", lambda: People(store, _QUICK).check_secret("ada", "pin", _PIN)),
        ("the next page", lambda: _read_verification(data, run_id)),
    ]
    if moment == "in a transaction":
        try:
            with store.database.writing() as connection:
                store.append_site(connection, [], actor="Ada")
                meddle()
        except OrthocaptureError as error:
            return f"the transaction: {type(error).__name__}"
    else:
        meddle()
    if moment == "idle":
        try:
            store = Store.open(data)
        except OrthocaptureError as error:
            return f"opening: {type(error).__name__}"
        place = SecondPlace.of(data, work / COPY, SystemClock(), DurableFiles(), patience_s=_LONGEST_S)
        acts = []
    for name, act in [*(acts[index] for index in order.get(moment, (0, 1, 2)) if acts), *needing]:
        try:
            act()
        except OrthocaptureError as error:
            return f"{name}: {type(error).__name__}"
    return "-"


def _verified(store: Store, run_id: str) -> None:
    """Keep the result of a verification as `audit verify` does."""
    report = verify(store.database_path.parent, run_id)
    found = verification_of(report, run_id, by="Ada", at_utc=utc_text(datetime.now(UTC)), duration_s=0.0)
    keep_verification(store.database_path.parent, run_id, found)


def _read_verification(data: Path, run_id: str) -> None:
    if Verifications(data, SystemClock()).last(run_id) is None:
        raise StoreError("the run was not verified yet")


def _up_to_date(place: SecondPlace) -> None:
    away = place.update()
    if away is not None:
        raise StoreError(away.why)


def _moved_into_the_database(data: Path) -> None:
    """Have SQLite move what is in the write-ahead log into the database, as it does from time to time."""
    with closing(sqlite3.connect(data / DATABASE_NAME)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def _meddling(work: Path, file: str, way: str) -> Callable[[], object]:
    def largest(folder: Path) -> Path:
        return max(folder.glob("??/*"), key=lambda path: path.stat().st_size)

    found: Callable[[Path], Path] = {
        "key": lambda folder: next((folder / "data" / "keys").glob("*.pem")),
        "pepper": lambda folder: folder / "data" / "keys" / "pepper",
        "photograph": lambda folder: largest(folder / "data" / "artefacts"),
        "verification": lambda folder: next((folder / "data" / "monitor").glob("*.verification.json")),
        "copy of the signatures": lambda folder: folder / COPY,
        "copy of the journal": lambda folder: journal_copy(folder / COPY),
    }.get(file, lambda folder: folder / "data" / file)

    def meddle() -> None:
        path, earlier = found(work), found(work / "old")
        path.chmod(0o600)
        WAYS[way](path, earlier)

    return meddle


def _afterwards(work: Path, file: str, way: str, moment: str, noticed: str) -> Result:
    data = work / "data"
    noticed = noticed or ("audit verify" if _faults(data, work / COPY) else "nobody")
    faults = _faults(data, None)
    after = "as it was"
    if faults:
        try:
            made = rebuild(data, actor=lambda _: "Ada")
            after = f"{made.made} rebuilt" if made.made else "not rebuilt"
        except OrthocaptureError as error:
            after = f"not rebuilt: {error.what}"
        left = _faults(data, None)
        after += f"; {left[0].split(':', 1)[-1].strip()[:60]}" if left else ""
    return Result(file, way, moment, noticed, _photographs(data) >= _BEFORE, after)


def _faults(data: Path, copy: Path | None) -> list[str]:
    """Return what `audit verify` finds wrong; with the copy in the second place, also what it notes of that."""
    try:
        report = verify(data, signatures_copy=copy)
        return [str(fault) for fault in report.faults] + [note for note in report.notes if copy and str(copy) in note]
    except OrthocaptureError as error:
        return [str(error)]


def _photographs(data: Path) -> int:
    try:
        with Store.open(data, create=False) as store:
            run_id = store.find_run("latest")
            taken = {e.payload.viewpoint for e in store.events(run_id) if e.payload.kind == "viewpoint_captured"}
            return len(taken & {f"v{number}" for number in range(_BEFORE)})
    except OrthocaptureError:
        return 0


def report(about: Mapping[str, Any], found: Sequence[Result]) -> str:
    """Format the findings as Markdown."""
    cpu = about["machine"]
    lost = sum(not result.whole for result in found)
    unnoticed = Counter(result.file for result in found if result.noticed == "nobody")
    same = ", ".join(f"{file} {number}" for file, number in unnoticed.items()) or "none"
    lines = [
        f"# Files of a data folder altered at every moment ({about['date']})",
        "",
        f"`python -m bench.journal.meddling`; commit {about['commit']}; {cpu['processor']}, Python {cpu['python']}.",
        f"{len(found)} cases; in {lost} of them something recorded was lost. Noticed by nobody, and verified all the",
        "same (SQLite or the next signature makes the file again, in the second place as well; or it was the same",
        f"file, or an older result of a verification, which says when it was made): {same}.",
        "",
        "| file | how it was altered | when | noticed by | all events there | the folder afterwards |",
        "|---|---|---|---|---|---|",
    ]
    for one in found:
        cells = one.file, one.way, one.moment, one.noticed, "yes" if one.whole else "**no**", one.after
        lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
