"""Compares what a sweep left undetected with what docs/explanation/evidence.md says is not detected."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase

from service.store.signatures.log import NAME as LOG_NAME
from tests.support.rig.rig import REPOSITORY
from tests.support.torture.audit.edits import Edits
from tests.support.torture.audit.flips import ArtefactFlips, DatabaseFlips, LineFlips
from tests.support.torture.audit.forger import Forgeries
from tests.support.torture.audit.record import Record
from tests.support.torture.audit.rollback import RollBacks
from tests.support.torture.audit.tally import Sweep, Tally

DOCUMENT = REPOSITORY / "docs" / "explanation" / "evidence.md"
SWEEPS: Mapping[str, Callable[[Record], Sweep]] = {
    "edits": Edits,
    "rollbacks": RollBacks,
    "forgeries": Forgeries,
    "log": lambda record: LineFlips(record, record.data / LOG_NAME, "end of the log of signatures"),
    "journal": lambda record: LineFlips(record, record.journal, "end of the journal"),
    "artefacts": ArtefactFlips,
    "wal": lambda record: DatabaseFlips(record, wal=True),
    "database": lambda record: DatabaseFlips(record, wal=False),
}


def documented_codes(text: str) -> dict[str, tuple[str, str]]:
    """Parse the documented undetected changes: pattern → the reason, and what reveals the change from outside."""
    found: dict[str, tuple[str, str]] = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("| `") and len(cells) == 3:
            for pattern in cells[0].split("`")[1::2]:
                found[pattern] = cells[1], cells[2]
    return found


def undetected_codes(total: Mapping[str, Tally]) -> Iterator[tuple[str, str, int]]:
    for kind, tally in total.items():
        for codes, number in tally.untold.items():
            for code in codes.split("; "):
                yield kind, code, number


def problems(total: Mapping[str, Tally], documented: Mapping[str, object], *, whole: bool) -> list[str]:
    """List crashes, faults reported without their place, and disagreements between documentation and findings."""
    found = [f"{kind}: {crash}" for kind, tally in total.items() for crash in tally.crashes]
    for kind, tally in total.items():
        if tally.placed < tally.told:
            example = tally.samples["told without a place"]
            found.append(f"{kind}: {tally.told - tally.placed} are detected without a place, such as {example}")
    seen = {code for _, code, _ in undetected_codes(total)}
    for code in sorted(seen):
        if not any(fnmatchcase(code, pattern) for pattern in documented):
            sample = next(t.samples[c] for t in total.values() for c in t.untold if code in c.split("; "))
            found.append(f"{code} is not detected, and {DOCUMENT.name} does not say so ({sample})")
    if whole:
        found += [
            f"{DOCUMENT.name} says that {pattern} is not detected, but it always was"
            for pattern in documented
            if not any(fnmatchcase(code, pattern) for code in seen)
        ]
    return found
