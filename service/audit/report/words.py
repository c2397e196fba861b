"""How a report writes times, names and numbers."""

from __future__ import annotations

from datetime import UTC, datetime

from service.audit.report.blocks import Cell
from service.core.gates.verdict import Standing, figure, limits, standing
from service.core.records.events import GateVerdict
from service.jobs.words import term


def utc(text: str) -> str:
    """2026-11-21 10:12:03 UTC, from ISO 8601."""
    moment = datetime.fromisoformat(text)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"


def moment(at: datetime) -> str:
    """The same of a time."""
    return utc(at.isoformat())


def clock(text: str) -> str:
    """The same without the date."""
    return utc(text).split()[1]


def duration(start: str, end: str) -> str:
    """3 min 5 s, between two times."""
    seconds = round((datetime.fromisoformat(end) - datetime.fromisoformat(start)).total_seconds())
    hours, rest = divmod(max(seconds, 0), 3600)
    minutes, seconds = divmod(rest, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def words(name: str) -> str:
    """A name of the records as words: viewpoint_skipped → viewpoint skipped."""
    return term(name)


def limit(verdict: GateVerdict) -> str:
    """What a gate allows: ≥ 0.2 and ≤ 1."""
    return limits(verdict.minimum, verdict.maximum)


def measured(verdict: GateVerdict) -> tuple[str, str]:
    """Name of what a gate judges without its unit, and the value with it."""
    name = verdict.measure
    for ending, unit in (("_mm", "mm"), ("_px", "px"), ("_deg", "°"), ("_min", "min")):
        if verdict.unit == unit:
            name = name.removesuffix(ending)
    return words(name), figure(verdict)


_JUDGED: dict[Standing, Cell] = {
    "within": Cell("✓ passed", "ok"),
    "not_decided": Cell("? not decided", "attention"),
    "accepted": Cell("! accepted", "attention"),
    "outside": Cell("✗ failed", "stop"),
}


def judged(verdict: GateVerdict, *, accepted: bool = False) -> Cell:
    """A word, a sign and a colour. `accepted`: a person let the step pass with its figures as they are."""
    return _JUDGED[standing(verdict, accepted=accepted)]


def mm(value: float | None, digits: int = 3) -> str:
    """Millimetres without the unit; – for none."""
    return "–" if value is None else f"{value:.{digits}f}"
