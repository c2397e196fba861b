"""What a journal says on the whole: which of its lines were committed, which were interrupted, which are damaged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.store.journal import changes
from service.store.journal.lines import FIRST, Ending, JournalLine, Mark, RowImage, read_lines


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


class _Chain:
    """Follows the lines of a journal, and says of each damaged one what is wrong.

    A line that does not follow the one before it does not show which of the two was altered. The line after both, or
    the mark, vouches for the second one; then it was the first.
    """

    def __init__(self) -> None:
        self.problems: dict[int, str] = {}
        self._number, self._sha256 = 0, FIRST
        self._doubtful: int | None = None  # the line before the last one, or the last one, was altered

    def follow(self, line: JournalLine) -> int:
        """Look at the next line; returns its number, or 0 if it stands where it was not written."""
        expected, follows = self._number + 1, line.previous_sha256 == self._sha256
        number = expected
        if self._doubtful is not None:
            self._resolve(vouched=follows)
        if line.problem:
            self.problems[number] = line.problem
        elif follows and line.number != expected:
            self.problems[number] = "its number was altered"
        elif line.number > expected:
            number = line.number
            self.problems[expected] = _missing(expected, number - 1)
        elif line.number < expected:
            self.problems[expected] = f"line {line.number} stands here, out of its place"
            return 0
        elif not follows and self._number not in self.problems:
            self._doubtful = number
        if number not in self.problems and not all(map(changes.is_known, line.rows)):
            self.problems[number] = "it has a row that no version writes: its text was altered"
        self._number, self._sha256 = number, line.sha256
        return number

    def end(self, mark: Mark | None) -> None:
        """Look at the end of the file."""
        if self._doubtful is not None:
            self._resolve(vouched=mark is not None)

    def _resolve(self, *, vouched: bool) -> None:
        assert self._doubtful is not None
        if self._doubtful > 1:
            self.problems.setdefault(
                self._doubtful - 1, "it is not the line that the next one follows: it was altered"
            )
        if self._doubtful == 1 or not vouched:
            self.problems.setdefault(self._doubtful, "it does not follow the line before it")
        self._doubtful = None


def _missing(first: int, last: int) -> str:
    return "it is missing" if first == last else f"it and all up to line {last} are missing"


def survey(path: Path) -> Survey:
    """Read a journal; one that does not exist is like an empty one. Raises StoreError if it cannot be read."""
    chain = _Chain()
    last = before_last = earlier_events = 0
    group: list[int] = []  # lines of the present transaction
    before: list[int] = []  # lines of the transaction before it
    void: set[int] = set()
    ending = Ending(None, 0)
    for item in read_lines(path):
        if isinstance(item, Ending):
            ending = item
            continue
        number = chain.follow(item)
        if not number:
            continue
        after = last if item.problem else item.after
        if not group and before and after != before[-1]:
            if after == before_last:
                void.update(before)
            elif before[-1] not in chain.problems and number - 1 == before[-1]:
                chain.problems.setdefault(number, "it does not come after the line that the database held")
        group.append(number)
        earlier_events = earlier_events or item.earlier_events
        if not item.continued:
            last, before_last, before, group = number, after, group, []
    chain.end(ending.mark)
    problems = tuple(sorted(chain.problems.items()))
    return Survey(last, before_last, frozenset(void), problems, ending.mark, ending.torn_bytes, earlier_events)


def committed_rows(path: Path, surveyed: Survey, until: int) -> Iterator[RowImage]:
    """The rows of all committed lines up to number `until` that are as they were written, in their order."""
    left_out = surveyed.void | {number for number, _ in surveyed.problems}
    for item in read_lines(path):
        if isinstance(item, JournalLine) and 0 < item.number <= until and item.number not in left_out:
            yield from item.rows
