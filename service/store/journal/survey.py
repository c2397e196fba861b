"""What a journal says on the whole: which of its lines were committed, which were interrupted, which are damaged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.store.journal.lines import Ending, JournalLine, Mark, RowImage, read_lines


@dataclass(frozen=True, slots=True)
class Survey:
    """A journal, read from its first line to its last.

    Attributes:
        last: number of the last line that can be read; 0 without a line.
        before_last: number of the line that the database held before the last line's transaction.
        void: numbers of the lines whose transaction was never committed, as the lines after them say.
        problems: (number, what is wrong) of each line that is not as it was written.
        mark: what the end says of the last line; None if it says nothing.
        torn_bytes: how many bytes at the end are no line, as after a power cut.
        earlier_events: how many events were recorded before the journal was begun.
    """

    last: int
    before_last: int
    void: frozenset[int]
    problems: tuple[tuple[int, str], ...]
    mark: Mark | None
    torn_bytes: int
    earlier_events: int

    def is_behind(self, held: int) -> bool:
        """Whether a database that holds line `held` lacks something that was committed."""
        committed = self.mark is not None and self.mark.word == "committed"
        return held < self.last and (held != self.before_last or committed)


def survey(path: Path) -> Survey:
    """Read a journal; one that does not exist is like an empty one. Raises StoreError if it cannot be read."""
    last = before_last = earlier_events = 0
    group: list[int] = []  # lines of the present transaction
    void: set[int] = set()
    problems: list[tuple[int, str]] = []
    ending = Ending(None, 0)
    before: list[int] = []  # lines of the transaction before it
    for item in read_lines(path):
        if isinstance(item, Ending):
            ending = item
            continue
        if item.problem:
            problems.append((item.number, item.problem))
        elif not group and before and item.after != before[-1]:
            if item.after == before_last:
                void.update(before)
            else:
                problems.append((item.number, "it does not come after the line that the database held"))
        group.append(item.number)
        earlier_events = earlier_events or item.earlier_events
        if not item.continued:
            last, before_last, before, group = item.number, item.after, group, []
    return Survey(last, before_last, frozenset(void), tuple(problems), ending.mark, ending.torn_bytes, earlier_events)


def committed_rows(path: Path, surveyed: Survey, until: int) -> Iterator[RowImage]:
    """The rows of all committed lines up to number `until` that are as they were written, in their order."""
    damaged = {number for number, _ in surveyed.problems}
    for item in read_lines(path):
        if isinstance(item, JournalLine) and item.number <= until and item.number not in surveyed.void | damaged:
            yield from item.rows
