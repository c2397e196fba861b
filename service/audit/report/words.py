"""Times, names and numbers as text in a report."""

from __future__ import annotations

from datetime import UTC, datetime

from service.audit.report.blocks import TableCell
from service.core.gates.measure_names import measure_name
from service.core.gates.verdict import Standing, figure, limits, standing
from service.core.records.events import GateVerdict
from service.jobs.words import term


def utc(text: str) -> str:
    """A time in ISO 8601 as `2026-11-21 10:12:03 UTC`."""
    moment = datetime.fromisoformat(text)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"


def moment(at: datetime) -> str:
    """A datetime as `2026-11-21 10:12:03 UTC`."""
    return utc(at.isoformat())


def clock(text: str) -> str:
    """A time in ISO 8601 as `10:12:03`, in UTC."""
    return utc(text).split()[1]


def duration(start: str, end: str) -> str:
    """The time between two times in ISO 8601, as `3 min 5 s`."""
    seconds = round((datetime.fromisoformat(end) - datetime.fromisoformat(start)).total_seconds())
    hours, rest = divmod(max(seconds, 0), 3600)
    minutes, seconds = divmod(rest, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def words(name: str) -> str:
    """A name in the records as words: viewpoint_skipped → viewpoint skipped."""
    return term(name)


def limit(verdict: GateVerdict) -> str:
    """The limits of a gate, as `≥ 0.2 and ≤ 1`."""
    return limits(verdict.minimum, verdict.maximum)


def measured(verdict: GateVerdict) -> tuple[str, str]:
    """Return the name of a gate's measure, and its value with the unit."""
    return measure_name(verdict.measure), figure(verdict)


_JUDGED: dict[Standing, TableCell] = {
    "within": TableCell("✓ passed", "ok"),
    "not_decided": TableCell("? not decided", "attention"),
    "accepted": TableCell("! accepted", "attention"),
    "outside": TableCell("✗ failed", "stop"),
}


def judged(verdict: GateVerdict, *, accepted: bool = False) -> TableCell:
    """The verdict of a gate as a sign and a word with a tone. `accepted`: a person accepted the step's figures."""
    return _JUDGED[standing(verdict, accepted=accepted)]


def mm(value: float | None, digits: int = 3) -> str:
    """Millimetres without the unit; `–` for None."""
    return "–" if value is None else f"{value:.{digits}f}"
