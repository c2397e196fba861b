"""The figures of a data folder in the format of Prometheus, read again at each scrape."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.registry import Collector

from service.core.clocks import ClockReading
from service.core.disk_space import Forecast
from service.core.errors import OrthocaptureError
from service.monitor.figures import Figures, Health

_PREFIX = "orthocapture_"


class DataFolderMetrics(Collector):
    """A collector over one data folder. If the record cannot be read, it gives only the health."""

    def __init__(
        self,
        figures: Callable[[], Figures],
        forecasts: Callable[[], Mapping[str, Forecast]],
        clocks: Callable[[Sequence[str]], Mapping[str, Sequence[ClockReading]]],
        health: Callable[[], Health],
    ) -> None:
        self._figures = figures
        self._forecasts = forecasts
        self._clocks = clocks
        self._health = health

    def describe(self) -> Iterable[Metric]:
        """Nothing, so that registering the collector does not read the database."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """One scrape."""
        health = self._health()
        parts = {
            "database": health.database,
            "data_folder": health.data_folder,
            "worker": health.worker,
            "runners": health.runners,
            "second_place": health.second_place,
        }
        yield _gauge(
            "healthy", "1 if nothing is wrong with a part.", ("part",), {(p,): not w for p, w in parts.items()}
        )
        try:
            figures, forecasts = self._figures(), self._forecasts()
            clocks = self._clocks(figures.shown)
        except (OrthocaptureError, OSError):
            return
        yield from _record(figures)
        yield from _processes(figures)
        yield from _devices(figures)
        yield from _clocks(clocks)
        yield _gauge(
            "forecast_bytes",
            "Bytes that an active run will still write.",
            ("run",),
            {(run_id,): space.needed_bytes for run_id, space in forecasts.items()},
        )
        yield _gauge(
            "forecast_views",
            "Photographs that an active run will still take.",
            ("run",),
            {(run_id,): space.views_left for run_id, space in forecasts.items()},
        )


def _record(figures: Figures) -> Iterable[Metric]:
    yield _gauge("runs", "Runs by state.", ("state",), {(state,): n for state, n in figures.runs.items()})
    yield _total("captures", "Photographs recorded in all runs.", figures.captures)
    yield _gauge("jobs", "Jobs by kind and state.", ("kind", "state"), figures.jobs)
    seconds = SummaryMetricFamily(_PREFIX + "job_seconds", "Computing time of finished jobs.", labels=("kind",))
    for kind, (count, total_s) in figures.job_seconds.items():
        seconds.add_metric((kind,), count, total_s)
    yield seconds
    yield _gauge(
        "queue_length",
        "Jobs that no worker has claimed yet: those that a step waits for, and those in the background.",
        ("lane",),
        {(lane,): n for lane, n in figures.queue.items()},
    )
    yield _gauge("database_bytes", "Size of the database with its log.", (), {(): figures.database_bytes})
    yield _gauge("free_bytes", "Free space on the data folder's disk.", (), {(): figures.free_bytes})


def _processes(figures: Figures) -> Iterable[Metric]:
    yield _gauge("workers", "Workers that are running.", (), {(): figures.workers})
    yield _gauge("driven_runs", "Runs that are driven by a process now.", (), {(): len(figures.driven)})
    yield _gauge(
        "runner_silent_seconds",
        "Time since the main loop of a runner last reported.",
        ("run",),
        {(run.run_id,): run.silent_s for run in figures.driven if math.isfinite(run.silent_s)},
    )
    yield _gauge(
        "viewpoint_seconds",
        "Median time between the last exposures of a run.",
        ("run",),
        {(run.run_id,): run.viewpoint_s for run in figures.driven if run.viewpoint_s is not None},
    )
    yield _gauge(
        "robot_state",
        "1 for the current state of the arm of a run.",
        ("run", "state"),
        {(r.run_id, r.robot): 1 for r in figures.driven},
    )


def _devices(figures: Figures) -> Iterable[Metric]:
    labels = ("run", "device", "kind")
    yield _gauge(
        "device_up",
        "1 for a device that was opened and has had no fault since; of the driven runs, or else of the newest.",
        labels,
        {(d.run_id, d.device, d.kind): d.answers for d in figures.devices},
    )
    yield _gauge(
        "device_problems",
        "Problems that a device reported about itself when it was opened.",
        labels,
        {(d.run_id, d.device, d.kind): d.problems for d in figures.devices},
    )


def _clocks(clocks: Mapping[str, Sequence[ClockReading]]) -> Iterable[Metric]:
    known = {(run_id, clock.device, clock.against): clock for run_id, found in clocks.items() for clock in found}
    within: dict[tuple[str, ...], bool] = {}
    for (run_id, device, _), clock in known.items():
        if clock.within is not None:
            within[run_id, device] = within.get((run_id, device), True) and clock.within
    yield _gauge(
        "clock_offset_seconds",
        "Offset of a clock: a device's minus the host's, or the host's minus the network's.",
        ("run", "device", "against"),
        {of: clock.offset_s for of, clock in known.items() if clock.offset_s is not None},
    )
    yield _gauge(
        "clock_within_limit",
        "0 for a clock beyond its limit.",
        ("run", "device"),
        within,
    )


def _gauge(
    name: str, text: str, labels: tuple[str, ...], values: Mapping[tuple[str, ...], float]
) -> GaugeMetricFamily:
    family = GaugeMetricFamily(_PREFIX + name, text, labels=labels)
    for of, value in values.items():
        family.add_metric(of, value)
    return family


def _total(name: str, text: str, value: float) -> Metric:
    family = CounterMetricFamily(_PREFIX + name, text)
    family.add_metric((), value)
    return family
