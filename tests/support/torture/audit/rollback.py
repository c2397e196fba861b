"""Roll-backs: the record restored to each earlier commit, in part or together with the files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from service.store.journal import parse_mark
from tests.support.torture.audit import outcome
from tests.support.torture.audit.outcome import Verdict, verdict
from tests.support.torture.audit.record import Record, State, put, put_back
from tests.support.torture.audit.tally import Tallies, Tally

# What is rolled back → whether the signature copy is compared.
_RECORD = "database", "journal"
_SECOND_PLACE = "copy", "journal_copy"
WAYS = {
    "database rolled back": (("database",), False),
    "journal rolled back": (("journal",), False),
    "database and journal rolled back": (_RECORD, False),
    "database and journal rolled back, second place compared": (_RECORD, True),
    "log of signatures rolled back": (("log",), False),
    "second place rolled back": (_SECOND_PLACE, True),
    "database, journal and log rolled back": ((*_RECORD, "log"), False),
    "database, journal and log rolled back, second place compared": ((*_RECORD, "log"), True),
    "database, journal, log and second place rolled back": ((*_RECORD, "log", *_SECOND_PLACE), True),
}
# The journal is gone, and the database has forgotten the number of its line, as one of an older version.
FORGOTTEN = "journal removed"
_CODES = {
    "database and journal rolled back": "commits after the last signature",
    "database and journal rolled back, second place compared": "commits after the last signature",
}


_NUMBER_AT = 60  # offset of user_version in the header of a database: https://www.sqlite.org/fileformat2.html


def _without_mark(state: State) -> State:
    lines = (state.journal or b"").splitlines(keepends=True)
    return replace(state, journal=b"".join(line for line in lines if parse_mark(line) is None))


class RollBacks:
    """Roll-backs to every earlier commit in each of the ways."""

    name = "roll-back"

    def __init__(self, record: Record) -> None:
        put_back(record)
        self._record = record
        self.all = [(way, number) for way in WAYS for number in range(len(record.states) - 1)]
        self.all += [(FORGOTTEN, len(record.states) - 1)]
        self.size = len(self.all)
        self._notes = outcome.audit.verify(record.data, signatures_copy=record.copy).notes

    def part(self, numbers: Sequence[int]) -> Tallies:
        """Make these roll-backs one at a time; returns the tallies by way."""
        tallies: Tallies = {}
        for number in numbers:
            way, commit = self.all[number]
            what, with_copy = WAYS.get(way, ((), False))
            state = self._forgotten() if way == FORGOTTEN else self._state(commit, what)
            if _without_mark(state) == _without_mark(self._record.states[-1]):
                continue
            put(self._record, state)
            found = self._verdict(state, with_copy=with_copy)
            tally = tallies.setdefault(way, Tally())
            tally.count(found, f"after commit {commit + 1}", lambda way=way: {_CODES.get(way, way)})
        put_back(self._record)
        return tallies

    def _state(self, commit: int, what: Sequence[str]) -> State:
        then = self._record.states[commit]
        return replace(self._record.states[-1], **{name: getattr(then, name) for name in what})

    def _forgotten(self) -> State:
        final = self._record.states[-1]
        header, rest = final.database[:_NUMBER_AT], final.database[_NUMBER_AT + 4 :]
        return replace(final, database=header + bytes(4) + rest, journal=None)

    def _verdict(self, state: State, *, with_copy: bool) -> Verdict:
        if with_copy and state.copy is None:  # the named copy does not exist, so the command refuses
            return Verdict(True, place=True, text="there is no such copy of the log of signatures")
        return verdict(self._record, self._notes, with_copy=with_copy)
