"""Roll-backs: the record restored to each earlier commit, in part or together with the files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.torture.audit import outcome
from bench.torture.audit.outcome import Verdict, verdict
from bench.torture.audit.record import Record, State, put, put_back
from bench.torture.audit.tally import Tallies, Tally

# What is rolled back → whether the signature copy is compared.
WAYS = {
    "database rolled back": (("database",), False),
    "log of signatures rolled back": (("log",), False),
    "second place rolled back": (("copy",), True),
    "database and log rolled back": (("database", "log"), False),
    "database and log rolled back, second place compared": (("database", "log"), True),
    "database, log and second place rolled back": (("database", "log", "copy"), True),
}
_CODES = {"database rolled back": "commits after the last signature"}


class RollBacks:
    """Roll-backs to every earlier commit in each of the ways."""

    name = "roll-back"

    def __init__(self, record: Record) -> None:
        put_back(record)
        self._record = record
        self.all = [(way, number) for way in WAYS for number in range(len(record.states) - 1)]
        self.size = len(self.all)
        self._notes = outcome.audit.verify(record.data, signatures_copy=record.copy).notes

    def part(self, numbers: Sequence[int]) -> Tallies:
        """Make these roll-backs one at a time; returns the tallies by way."""
        tallies: Tallies = {}
        for number in numbers:
            way, commit = self.all[number]
            what, with_copy = WAYS[way]
            state = self._state(commit, what)
            if state == self._record.states[-1]:
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

    def _verdict(self, state: State, *, with_copy: bool) -> Verdict:
        if with_copy and state.copy is None:  # the named copy does not exist, so the command refuses
            return Verdict(True, place=True, text="there is no such copy of the log of signatures")
        return verdict(self._record, self._notes, with_copy=with_copy)
