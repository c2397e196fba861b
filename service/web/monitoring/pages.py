"""Monitoring endpoints: `/health` for everybody, `/metrics` for this machine and for accounts that may read."""

from __future__ import annotations

from ipaddress import ip_address
from typing import cast

from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, ProcessCollector, generate_latest

from service.core.equipment.clocks import clock_readings
from service.core.equipment.disk_space import Forecast
from service.core.errors import StoreError
from service.monitor.figures import read_figures, read_health
from service.store.disk_space import forecast_of
from service.web.monitoring.metrics import DataFolderMetrics
from service.web.monitoring.request_counts import RequestCounts
from service.web.security.guards import Guard
from service.web.site import CurrentSite, Site

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
    """Health of database, data folder, workers, runners and second place. Status 200 if all are well, else 503."""
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
    """The figures for Prometheus."""
    content = generate_latest(cast(CollectorRegistry, request.app.state.metrics))
    return Response(content, media_type=CONTENT_TYPE_LATEST)
