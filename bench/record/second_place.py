"""A second place of the signatures that goes away, in every way and at every moment of a run.

`python -m bench.record.second_place` runs a small protocol once for each way and each signature of the run before
which the place goes away, and once more where it comes back with the signature after. The run must complete, its
record must say once that the place was away, and the copy must be whole when the place is back.
"""

from __future__ import annotations

import datetime
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.machine import RESULTS, commit, machine
from service.core.records.run_events import DeviceTrouble
from service.store.durable_effects import SystemClock
from service.store.signatures.log import NAME
from service.store.signatures.second_place import Away, LogCopy, SecondPlace
from service.store.verification.verify import verify
from tests.support.processes.waiting import until
from tests.support.record.ailing_place import WAYS, Ailing
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run.

    Attributes:
        way: how the place is away.
        signature: before which signature of the run it goes away, from 1.
        back_after: after how many signatures it comes back; 0 for after the run.
        status: of the run.
        told: how often the record says that the place was away.
        faults: of the record and of the copy.
        longest_s: the longest that a signature waited for the place.
    """

    way: str
    signature: int
    back_after: int
    status: str
    told: int
    faults: tuple[str, ...]
    longest_s: float

    @property
    def well(self) -> bool:
        """Return whether the run did not mind."""
        return self.status == "completed" and self.told == 1 and not self.faults


class LeavingPlace(SecondPlace):
    """Goes away before a signature and may come back before a later one."""

    def __init__(self, ailing: Ailing, data: Path, *, at: int, way: str, back_after: int) -> None:
        super().__init__([LogCopy(data / NAME, ailing.copy, ailing.files)], SystemClock(), patience_s=0.2)
        self._ailing, self._at, self._way, self._back_after = ailing, at, way, back_after
        self.asked = 0
        self.longest_s = 0.0

    def update(self) -> Away | None:
        """As that of any second place, with what happens to this one before."""
        self.asked += 1
        if self.asked == self._at:
            self._ailing.go_away(self._way)
        if self._back_after and self.asked == self._at + self._back_after:
            self._ailing.mend()
        began_s = time.monotonic()
        away = super().update()
        self.longest_s = max(self.longest_s, time.monotonic() - began_s)
        return away


def one(folder: Path, way: str, at: int, back_after: int) -> tuple[Outcome, int]:
    """A run whose place goes away, and the number of its signatures."""
    with bench_store(folder / "data") as store:
        bench = begin_run(store, PROTOCOL, folder)
        ailing = Ailing("no folder", folder)
        ailing.mend()
        bench.second_place = place = LeavingPlace(
            ailing, store.database_path.parent, at=at, way=way, back_after=back_after
        )
        status = bench.run().status
        signatures = place.asked
        if not back_after or at + back_after > signatures:
            ailing.mend()
        until(lambda: SecondPlace.update(place) is None, "it is never up to date again")
        told = [e for e in store.events(bench.run_id) if isinstance(e.payload, DeviceTrouble)]
    report = verify(folder / "data", signatures_copy=ailing.copy)
    faults = [str(fault) for fault in report.faults]
    if ailing.copy.read_bytes() != (folder / "data" / NAME).read_bytes():
        faults.append("the copy is not the log")
    if any(report.unsigned_events.values()):
        faults.append("events are not signed")
    return Outcome(way, at, back_after, status, len(told), tuple(faults), round(place.longest_s, 3)), signatures


def main() -> int:
    """Run them all, print and write the table. Returns 1 if a run minded."""
    found: list[Outcome] = []
    for way in WAYS:
        at, signatures = 1, 1
        while at <= signatures:
            for back_after in (0, 1):
                with tempfile.TemporaryDirectory() as folder:
                    outcome, signatures = one(Path(folder), way, at, back_after)
                found.append(outcome)
                sys.stderr.write(f"{outcome}\n")
            at += 1
    about: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "runs": [asdict(outcome) for outcome in found],
    }
    text = table(about, found)
    sys.stdout.write(text)
    stem = RESULTS / f"second_place-{about['date']}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return int(not all(outcome.well for outcome in found))


def table(about: dict[str, Any], found: list[Outcome]) -> str:
    """The findings as Markdown."""
    lines = [
        f"# A second place that goes away, in every way and before every signature of a run ({about['date']})",
        "",
        f"`python -m bench.record.second_place`, commit {about['commit']}. A signature waits for the place for up to",
        "0.2 s here (3 s otherwise), and only the first one while it is away.",
        "",
        "| the place | runs | completed | told once in the record | copy whole afterwards | longest wait |",
        "|---|---|---|---|---|---|",
    ]
    for way in WAYS:
        runs = [outcome for outcome in found if outcome.way == way]
        completed = sum(outcome.status == "completed" for outcome in runs)
        told, whole = sum(outcome.told == 1 for outcome in runs), sum(not outcome.faults for outcome in runs)
        longest_s = max(outcome.longest_s for outcome in runs)
        lines.append(f"| {way} | {len(runs)} | {completed} | {told} | {whole} | {longest_s:.2f} s |")
    minded = [outcome for outcome in found if not outcome.well]
    lines += ["", "Problems: " + ("none." if not minded else ""), *(f"- {outcome}" for outcome in minded)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
