"""Counting what became of changes to the record, in forked processes: one that dies or hangs is a finding too."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

from bench.torture.audit.outcome import Verdict

_A_CHANGE_S = 10.0


@dataclass
class Tally:
    """What became of the changes of one kind.

    `meaningless`: nothing that can be read differs. `untold`: code of what differs → how often, `noted` of them with
    a note that is no fault; `samples` by code. `anchors`: what outside the folder was seen to tell it → how often.
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
        """Count another part of the same kind too."""
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
        """One change. `codes`: what differs that nothing told; empty for nothing."""
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
        """Plain data."""
        return {**vars(self), "untold": dict(self.untold), "anchors": dict(self.anchors)}

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> Self:
        """From plain data."""
        made = cls(**data)
        made.untold, made.anchors = Counter(made.untold), Counter(made.anchors)
        return made


Tallies = dict[str, Tally]  # by kind of change


def add_all(total: Tallies, more: Mapping[str, Tally]) -> None:
    """Count another part too."""
    for kind, tally in more.items():
        total.setdefault(kind, Tally()).add(tally)


class Sweep(Protocol):
    """Numbered changes, each done to the record as it was, and judged."""

    name: str
    size: int

    def part(self, offsets: Sequence[int], /) -> Tallies:
        """Do the changes of these numbers, one at a time."""
        ...


def in_a_process(sweep: Sweep, numbers: Sequence[int]) -> Tallies:
    """What became of these changes, done in a forked process, whose memory of pure functions ends with it."""
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
