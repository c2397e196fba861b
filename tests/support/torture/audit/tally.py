"""Counts the outcomes of changes to the record, made in forked processes, so that crashes and hangs count too."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

from tests.support.torture.audit.outcome import Verdict

_A_CHANGE_S = 10.0


@dataclass
class Tally:
    """The outcomes of the changes of one kind.

    `meaningless`: nothing readable differs. `untold`: code of an undetected difference → count, `noted` of them with
    a remark; `samples` by code. `anchors`: what outside the folder revealed the change → count.
    """

    number: int = 0
    told: int = 0
    placed: int = 0
    meaningless: int = 0
    noted: int = 0
    untold: Counter[str] = field(default_factory=Counter[str])
    crashes: list[str] = field(default_factory=list[str])
    samples: dict[str, str] = field(default_factory=dict[str, str])
    anchors: Counter[str] = field(default_factory=Counter[str])

    def add(self, other: Tally) -> None:
        """Add the counts of another tally of the same kind."""
        self.number += other.number
        self.told += other.told
        self.placed += other.placed
        self.meaningless += other.meaningless
        self.noted += other.noted
        self.untold += other.untold
        self.crashes += other.crashes
        self.samples = other.samples | self.samples
        self.anchors += other.anchors

    def count(self, found: Verdict, name: str, codes: Callable[[], set[str]]) -> None:
        """Count one change. `codes` returns what differs without having been detected; empty if nothing."""
        self.number += 1
        if found.crashed:
            self.crashes.append(f"{name}: {found.text}")
        elif found.told:
            self.told += 1
            self.placed += found.place
            if not found.place:
                self.samples.setdefault("told without a place", f"{name}: {found.text}")
        else:
            different = codes()
            if not different:
                self.meaningless += 1
            else:
                self.noted += bool(found.noted)
                code = "; ".join(sorted(different))
                self.untold[code] += 1
                self.samples.setdefault(code, name)

    def as_json(self) -> dict[str, Any]:
        """Convert to JSON data."""
        return {**vars(self), "untold": dict(self.untold), "anchors": dict(self.anchors)}

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> Self:
        """Create from JSON data."""
        made = cls(**data)
        made.untold, made.anchors = Counter(made.untold), Counter(made.anchors)
        return made


Tallies = dict[str, Tally]  # by kind of change


def add_all(total: Tallies, more: Mapping[str, Tally]) -> None:
    """Add the tallies of another part."""
    for kind, tally in more.items():
        total.setdefault(kind, Tally()).add(tally)


class Sweep(Protocol):
    """Numbered changes, each applied to the original record and judged."""

    name: str
    size: int

    def part(self, offsets: Sequence[int], /) -> Tallies:
        """Make the changes of these numbers one at a time; returns the tallies."""
        ...


def in_a_process(sweep: Sweep, numbers: Sequence[int]) -> Tallies:
    """Run these changes in a forked process, whose caches of pure functions end with it; returns the tallies."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)

    def work() -> None:
        there.send(sweep.part(numbers))

    child = context.Process(target=work)
    child.start()
    there.close()
    try:
        if here.poll(60.0 + _A_CHANGE_S * len(numbers)):
            found: Tallies = here.recv()
            child.join()
            return found
    except EOFError:
        pass
    child.kill()
    child.join()
    if len(numbers) == 1:
        what = f"change {numbers[0]}: the process died or hung (status {child.exitcode})"
        return {sweep.name: Tally(number=1, crashes=[what])}
    middle = len(numbers) // 2
    found = in_a_process(sweep, numbers[:middle])
    add_all(found, in_a_process(sweep, numbers[middle:]))
    return found
