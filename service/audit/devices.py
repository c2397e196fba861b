"""The devices of a run: camera bodies, clocks, and the starts of the program that drove them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.audit.queries import EventRow, plain, read_rows
from service.core.recorded_devices import CameraBodies, RecordedReport, bodies_of, recorded_report
from service.core.records.run_events import DeviceOpened, SessionStarted, ViewpointCaptured

_LOOKED_AT = 500  # newest photographs; one that states another body is judged as a departing image anyway


@dataclass(frozen=True, slots=True)
class OpenedDevice:
    """A device as it answered when it was opened."""

    row: EventRow  # its device_opened event
    name: str  # the name in rig.yaml
    report: RecordedReport


def opened_devices(rows: Iterable[EventRow]) -> list[OpenedDevice]:
    """Return the devices of some device_opened events, read with their payloads."""
    opened = ((row, row.record(DeviceOpened)) for row in rows)
    return [
        OpenedDevice(row, known.device, recorded_report(known.report)) for row, known in opened if known is not None
    ]


def bodies_of_run(connection: Connection, run_id: str, opened: Iterable[OpenedDevice]) -> CameraBodies:
    """Return serial numbers of the cameras among the opened devices."""
    rows = connection.execute(
        text(
            "SELECT DISTINCT f.value AS body FROM (SELECT seq FROM event_index WHERE run_id = :run "
            "AND kind IN ('viewpoint_captured', 'view_held', 'view_imported') "
            "ORDER BY seq DESC LIMIT :most) AS i JOIN event_facets AS f ON f.run_id = :run AND f.seq = i.seq "
            "AND f.name = 'body_serial' ORDER BY 1"
        ),
        {"run": plain(run_id), "most": _LOOKED_AT},
    ).all()
    identities = ((device.name, device.report.identity) for device in opened)
    return bodies_of(identities, (str(row.body or "") for row in rows))


@dataclass(frozen=True, slots=True)
class ClockSeries:
    """The offset of a device's clock from the host's over a step, as far as one start of the runner did it."""

    step: str
    start: int  # the runner's start in this run, counted from 1
    captures: int
    first_s: float
    last_s: float
    smallest_s: float
    largest_s: float
    over_s: float  # host time between the first and the last

    @property
    def drift_s(self) -> float:
        """Change from the first capture to the last."""
        return self.last_s - self.first_s


def clock_offsets(connection: Connection, run_id: str) -> list[ClockSeries]:
    """Return the robot controller's clock minus the host's monotonic one, as every capture recorded it.

    Each start of the runner has a series of its own: the host's monotonic clock starts again with every boot.
    """
    rows = connection.execute(
        text(
            "WITH i AS (SELECT run_id, seq, step, kind, "
            "sum(CASE WHEN kind = 'session_started' THEN 1 ELSE 0 END) OVER (ORDER BY seq) AS start "
            "FROM event_index WHERE run_id = :run AND kind IN ('viewpoint_captured', 'session_started')), "
            "c AS (SELECT i.step, i.start, i.seq, e.monotonic_s AS at, CAST(f.value AS DOUBLE PRECISION) AS o "
            "FROM i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq "
            "LEFT JOIN event_facets AS f ON f.run_id = i.run_id AND f.seq = i.seq AND f.name = 'clock_offset_s' "
            "WHERE i.kind = 'viewpoint_captured') "
            "SELECT step, start, count(*) AS n, min(seq) AS first, max(seq) AS last, min(o) AS low, max(o) AS high, "
            "max(at) - min(at) AS over FROM c GROUP BY step, start ORDER BY min(seq)"
        ),
        {"run": plain(run_id)},
    ).all()
    ends = [row.first for row in rows] + [row.last for row in rows]
    offsets = {
        event.seq: captured.clock_offset_s
        for event in read_rows(connection, run_id, ends, whole=True)
        if (captured := event.record(ViewpointCaptured)) is not None
    }
    return [
        ClockSeries(
            row.step or "",
            row.start,
            row.n,
            offsets.get(row.first, 0.0),
            offsets.get(row.last, 0.0),
            float(row.low or 0.0),
            float(row.high or 0.0),
            float(row.over or 0.0),
        )
        for row in rows
    ]


@dataclass(frozen=True, slots=True)
class Session:
    """One start of the runner's process."""

    row: EventRow
    software: Mapping[str, str]
    changed: Mapping[str, tuple[str, str]]  # changes since the session before: distribution → before, now


def sessions(rows: Sequence[EventRow]) -> list[Session]:
    """Return the starts of a runner, each compared with the one before."""
    found: list[Session] = []
    before: dict[str, str] | None = None
    for row in rows:
        started = row.record(SessionStarted)
        software = {} if started is None else started.software
        names = sorted({*software, *before}) if before is not None else []
        earlier = before or {}
        changed = {
            name: (earlier.get(name, ""), software.get(name, ""))
            for name in names
            if earlier.get(name) != software.get(name)
        }
        found.append(Session(row, software, changed))
        before = software
    return found
