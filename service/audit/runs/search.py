"""A search for runs of a data folder by what people wrote about them, by time and by result."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import ValidationError
from sqlalchemy import Connection, text

from service.audit.filters import Result, RunSearch
from service.audit.record.rows import RunBasics, plain_payload, runs
from service.core.records.run_events import GatesEvaluated
from service.store.runs import read_open_runs
from service.store.store import Store

RESULT_WORDS: Mapping[Result, str] = {
    "open": "not ended",
    "completed": "completed",
    "aborted": "ended early",
    "within": "accuracy within its limit",
    "outside": "accuracy outside its limit",
    "released": "released",
}
_ERROR = "mean_radial_error_mm"  # the measure of an evaluation that is shown as the accuracy of the run


@dataclass(frozen=True, slots=True)
class Accuracy:
    """The mean radial error on the control spheres, as it was last judged."""

    error_mm: float
    most_mm: float | None
    within: bool | None  # None: not decided, because a limit lies within its uncertainty

    @property
    def words(self) -> str:
        """`0.213 mm (within)`."""
        how = {True: "within", False: "outside", None: "not decided"}[self.within]
        return f"{self.error_mm:.3f} mm ({how})"


@dataclass(frozen=True, slots=True)
class FoundRun:
    """A run in a list."""

    basics: RunBasics
    notes: tuple[str, ...]
    status: Literal["open", "completed", "aborted"]
    released: bool
    accuracy: Accuracy | None

    def has(self, result: str) -> bool:
        """Return whether the run has this result, one of RESULTS."""
        if result == "released":
            return self.released
        if result in ("within", "outside"):
            return self.accuracy is not None and self.accuracy.within is (result == "within")
        return self.status == result

    @property
    def words(self) -> str:
        """The text that is searched, in lower case."""
        run, said = self.basics, self.basics.about.model_dump().values()
        parts = (run.run_id, run.protocol, run.version, run.operator, *said, *self.notes)
        return "\n".join(map(str, parts)).casefold()


def find_runs(store: Store, wanted: RunSearch) -> list[FoundRun]:
    """Return the runs that match, newest first. If a first event cannot be read, its fields are empty."""
    with store.database.reading() as connection:
        every = _every(connection)
    terms = wanted.q.casefold().split()
    return [
        run
        for run in every
        if (not wanted.since or wanted.since <= run.basics.created_utc[:10])
        and (not wanted.until or run.basics.created_utc[:10] <= wanted.until)
        and (not wanted.result or run.has(wanted.result))
        and (not terms or all(term in run.words for term in terms))
    ]


def _every(connection: Connection) -> list[FoundRun]:
    still_open = read_open_runs(connection)
    ended = {run for run, _ in _of_kind(connection, "run_completed")}
    released = {run for run, _ in _of_kind(connection, "run_released")}
    notes: dict[str, list[str]] = defaultdict(list)
    for run, payload in _of_kind(connection, "note_taken"):
        said = plain_payload(payload).get("text")
        if isinstance(said, str):
            notes[run].append(said)
    judged = dict(_of_kind(connection, "gates_evaluated", _ERROR))
    return [
        FoundRun(
            basics=run,
            notes=tuple(notes.get(run.run_id, ())),
            status="open" if run.run_id in still_open else "completed" if run.run_id in ended else "aborted",
            released=run.run_id in released,
            accuracy=_accuracy(judged.get(run.run_id, "")),
        )
        for run in runs(connection)
    ]


def _of_kind(connection: Connection, kind: str, word: str = "") -> Sequence[tuple[str, str]]:
    """Return run and payload of each event of a kind whose payload has this word, in order."""
    rows = connection.execute(
        text(
            # Run by run, in the order of the index, to avoid reading every event of the folder.
            "SELECT i.run_id, e.payload FROM runs AS r CROSS JOIN event_index AS i CROSS JOIN events AS e "
            "WHERE i.run_id = r.run_id AND i.kind = :kind AND e.run_id = i.run_id AND e.seq = i.seq "
            "AND e.payload LIKE :word ORDER BY i.run_id, i.seq"
        ),
        {"kind": kind, "word": f"%{word}%"},
    )
    return [(str(row.run_id), str(row.payload)) for row in rows]


def _accuracy(payload: str) -> Accuracy | None:
    try:
        verdicts = GatesEvaluated.model_validate_json(payload).verdicts if payload else ()
    except ValidationError:  # the verification reports it
        return None
    for judged in verdicts:
        if judged.measure.endswith(_ERROR) and judged.value is not None:
            return Accuracy(judged.value, judged.maximum, None if judged.undecided else judged.passed)
    return None
