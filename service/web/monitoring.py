"""Monitoring endpoints: `/health` for everybody, `/metrics` for this machine and for accounts that may read."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from ipaddress import ip_address
from typing import cast

from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.core.disk_space import Forecast
from service.core.errors import OrthocaptureError, StoreError
from service.core.recorded_devices import ClockReading, clock_readings
from service.monitor.figures import Figures, Health, read_figures, read_health
from service.store.disk_space import forecast_of
from service.web.security import Guard
from service.web.site import CurrentSite, Site

_SECONDS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
_log = logging.getLogger("orthocapture.web")
_METHODS = ("GET", "HEAD", "POST")


class RequestCounts:
    """Outermost, in plain ASGI. Streams are counted when they begin, as they last while somebody watches."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        self._answers = Counter(
            "orthocapture_web_requests", "Requests answered.", ("method", "route", "status"), registry=registry
        )
        self._seconds = Histogram(
            "orthocapture_web_request_seconds",
            "Time until an answer began.",
            ("route",),
            buckets=_SECONDS,
            registry=registry,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request and count it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun_s = time.monotonic()

        def count(status: str) -> None:
            # The pattern of the route, never the address of the request: a label for each run, or for
            # whatever a stranger types, would make the metrics grow without limit.
            unrouted = "/static" if scope["path"].startswith("/static/") else "other"
            route = str(getattr(scope.get("route"), "path", unrouted))
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self._answers.labels(method, route, status).inc()
            seconds = time.monotonic() - begun_s
            self._seconds.labels(route).observe(seconds)
            if method != "GET" or status >= "500":  # a stranger's guesses at addresses would fill the log
                said = {"method": method, "route": route, "status": int(status), "seconds": round(seconds, 3)}
                _log.info("answered", extra=said)

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(str(message["status"]))
            await send(message)

        try:
            await self._app(scope, receive, counted)
        except Exception:  # answered further out, with an error's page
            count("500")
            raise


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
        """Return nothing, so that registering the collector does not read the database."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Yield the metrics of one scrape."""
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


router = APIRouter(tags=["health"])
_FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")


class ReaderOrLocalRequest(Guard):
    """Lets requests from this machine pass if no proxy forwarded them; everybody else must be signed in to read.

    A scraping program cannot sign in, and whoever is on this machine could read the data folder anyway.
    """

    async def __call__(self, request: Request, site: CurrentSite) -> None:
        """Refuse the request unless it comes from this machine or from somebody who may read."""
        if not _is_this_machine(request):
            await super().__call__(request, site)


def _is_this_machine(request: Request) -> bool:
    if request.client is None or any(name in request.headers for name in _FORWARDED):
        return False
    try:
        return ip_address(request.client.host).is_loopback
    except ValueError:
        return False


def install_metrics(app: FastAPI) -> None:
    """Give this application a registry of its own. `app.state.site` must be set before."""
    site = cast(Site, app.state.site)
    registry = CollectorRegistry()
    registry.register(
        DataFolderMetrics(
            lambda: read_figures(site.store, site.data, site.launcher.driven_runs()),
            lambda: _forecasts(site),
            lambda run_ids: {run_id: clock_readings(site.run(run_id).events) for run_id in run_ids},
            lambda: read_health(site.store, site.data, _driven(site), site.second_place.away),
        )
    )
    ProcessCollector(namespace="orthocapture_web", registry=registry)
    app.state.metrics = registry
    app.add_middleware(RequestCounts, registry=registry)


def _forecasts(site: Site) -> dict[str, Forecast]:
    logs = {run_id: site.run(run_id) for run_id in site.launcher.driven_runs()}
    return {run_id: forecast_of(site.store, log.protocol, log.state) for run_id, log in logs.items()}


def _driven(site: Site) -> list[str]:
    try:
        return site.launcher.driven_runs()
    except StoreError:  # reported by the health check of the database
        return []


@router.get("/health", name="health")
def health(site: CurrentSite) -> JSONResponse:
    """Show the health of database, data folder, workers, runners and second place.

    Status 200 if all are well, else 503.
    """
    found = read_health(site.store, site.data, _driven(site), site.second_place.away)
    parts = {
        "database": found.database,
        "data_folder": found.data_folder,
        "worker": found.worker,
        "runners": found.runners,
        "second_place": found.second_place,
    }
    content = {"ok": found.ok} | {name: {"ok": not wrong, "what": wrong} for name, wrong in parts.items()}
    return JSONResponse(content, status_code=200 if found.ok else 503)


@router.get("/metrics", name="metrics", dependencies=[Depends(ReaderOrLocalRequest("read", while_locked=False))])
def metrics(request: Request) -> Response:
    """Show the figures for Prometheus."""
    content = generate_latest(cast(CollectorRegistry, request.app.state.metrics))
    return Response(content, media_type=CONTENT_TYPE_LATEST)
