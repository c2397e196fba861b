"""Detects creeping growth: lines fitted over the captures of an hour, each compared with its bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tests.support.soak.fit import Growth, growth

WARM_UP = 0.25  # fraction of the time that is left out
FEWEST = 8  # minimum number of samples after the warm-up
JUDGED_S = 300.0  # shorter runs are not judged, because buffers and caches are still filling


@dataclass(frozen=True, slots=True)
class Sample:
    """All figures at one moment."""

    at_s: float
    captured: int
    processes: Mapping[str, Mapping[str, float]]  # by role
    sizes: Mapping[str, int]  # in bytes


@dataclass(frozen=True, slots=True)
class Bound:
    """The largest allowed growth per 1000 captures, or with `total` the largest allowed value, and its reason."""

    most: float
    why: str
    total: bool = False


_FLAT = "nothing in it is kept for each capture"
_HOLDS = "it holds the events of the run"
CHILD = "worker's child"
MEMORY_MB: Mapping[str, Bound] = {
    "runner": Bound(60.0, _HOLDS),
    "web": Bound(60.0, _HOLDS),
    CHILD: Bound(60.0, f"{_HOLDS} of which it has jobs"),
    "simulated rig": Bound(5.0, "it notes where the camera was at each exposure"),
    "simulated camera": Bound(15.0, "its card fills"),
}
_OTHERS_MB = Bound(3.0, _FLAT)
_COUNT = Bound(1.0, _FLAT)
#: The log's index and, for each of at most 15 connections (5 kept, 10 more), database and log; and those of the fresh
#: connection that looks before a write, which SQLite keeps for its next use while others are open. One is made
#: when several threads read at once for the first time, so their number rises in steps and then stays.
DATABASE_DESCRIPTORS = Bound(33.0, "15 connections at most, whose number rises in steps, and the look", total=True)
SIZES_MB: Mapping[str, Bound] = {
    "database": Bound(60.0, "it holds every event and row for ever; the same for each capture"),
    "write-ahead log": Bound(1.0, "SQLite uses it again after each checkpoint"),
    "logs": Bound(5.0, "one line an event, up to 100 MB, then the oldest go"),
    "monitor": Bound(1.0, "each file replaces the one before"),
}


def warmed_up(samples: Sequence[Sample]) -> list[Sample]:
    """The samples after the warm-up."""
    return [s for s in samples if s.at_s >= samples[0].at_s + WARM_UP * (samples[-1].at_s - samples[0].at_s)]


def judge(samples: Sequence[Sample]) -> dict[str, Any]:
    """Return rows with the growth per 1000 captures, and the faults."""
    warm = warmed_up(samples)
    if len(warm) < FEWEST:
        return {
            "rows": [],
            "judged": False,
            "faults": [f"{len(warm)} samples after the warm-up say nothing; take {FEWEST} or more"],
        }
    judged = warm[-1].at_s - warm[0].at_s >= JUDGED_S
    rows = [row for name in sorted({n for s in warm for n in s.processes}) for row in _process(name, warm)]
    for name, bound in SIZES_MB.items():
        y = [(s.captured, s.sizes[name] / 1e6) for s in warm]
        rows.append(_row(f"{name}, MB", y, bound))
    return {"rows": rows, "judged": judged, "faults": [row["fault"] for row in rows if row["fault"] and judged]}


def _process(name: str, samples: Sequence[Sample]) -> list[dict[str, Any]]:
    mine = [s for s in samples if name in s.processes]
    rows: list[dict[str, Any]] = []
    for figure, words, bound in (
        ("own_mb", "memory of its own, MB", MEMORY_MB.get(name.rstrip(" 0123456789"), _OTHERS_MB)),
        ("rss_mb", "resident memory, MB", MEMORY_MB.get(name.rstrip(" 0123456789"), _OTHERS_MB)),
        ("descriptors", "descriptors, but for the database", _COUNT),
        ("database_descriptors", "descriptors of the database", DATABASE_DESCRIPTORS),
        ("threads", "threads", _COUNT),
    ):
        rows.append(_row(f"{name}: {words}", [(s.captured, s.processes[name][figure]) for s in mine], bound))
    return rows


def _row(what: str, points: Sequence[tuple[int, float]], bound: Bound) -> dict[str, Any]:
    """One row; a fault if even the lower end of the growth's 95 % interval, or a value itself, exceeds the bound."""
    values = [y for _x, y in points]
    line: Growth | None = growth([x / 1000 for x, _y in points], values)
    fault = ""
    if bound.total:
        fault = f"{what}: {max(values):g}, more than {bound.most:g}" if max(values) > bound.most else ""
    elif line is not None and line.least > bound.most:
        fault = (
            f"{what}: grows by {line.slope:.2f} ± {line.half_width:.2f} in 1000 captures, more than {bound.most:g}"
        )
    return {
        "what": what,
        "first": round(values[0], 2),
        "last": round(values[-1], 2),
        "most": round(max(values), 2),
        "per_1000": None if line is None else round(line.slope, 3),
        "half_width": None if line is None else round(line.half_width, 3),
        "bound": bound.most,
        "total": bound.total,
        "why": bound.why,
        "fault": fault,
    }


def table(found: Mapping[str, Any]) -> list[str]:
    """Format the findings as Markdown lines."""
    stops = "The arm's watchdog never stopped it."
    if found["stops"]:
        stops = (
            f"Because the machine was busy, the arm's watchdog stopped it {found['stops']} times, and a simulated "
            "person let it go on."
        )
    lines = [
        f"{found['minutes']:g} minutes of captures with the arm at 20 times its speed: {found['captured']:,} "
        f"viewpoints, {found['events']:,} events, {found['jobs']:,} jobs, {found['pages']:,} rounds of pages, "
        f"{found['samples']:,} samples; the first quarter is warm-up. {stops} Growth per 1000 "
        "captures with its 95 % interval; a fault is what exceeds its bound for certain."
        + ("" if found["judged"] else " **This was too short to judge**, and nothing below is a fault yet."),
        "",
        "| what | first | last | most | growth in 1000 captures | may grow by | why it may | |",
        "|---|---:|---:|---:|---:|---:|---|---|",
    ]
    for row in found["rows"]:
        bound = f"up to {row['bound']:g} in all" if row["total"] else f"{row['bound']:g}"
        grows = "–" if row["per_1000"] is None else f"{row['per_1000']:.2f} ± {row['half_width']:.2f}"
        lines.append(
            f"| {row['what']} | {row['first']} | {row['last']} | {row['most']} | {grows} | {bound} | "
            f"{row['why']} | {'**fault**' if row['fault'] else 'ok'} |"
        )
    return lines
