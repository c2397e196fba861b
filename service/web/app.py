"""The web application: routers, safety headers, a sealed record, and errors that reveal no internals."""

from __future__ import annotations

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles

from service.people.credentials import failed_tries
from service.web import (
    accounts,
    audit,
    audit_exports,
    audit_overview,
    calibration,
    capture,
    dataset,
    handheld,
    home,
    media,
    monitoring,
    run,
    run_actions,
    scene,
)
from service.web.rendering import install_errors
from service.web.security import TRIES_WINDOW_S, Limiter, Shield, sealed
from service.web.site import Site

_ROUTERS: tuple[APIRouter, ...] = (
    accounts.router,
    home.router,
    run.router,
    run_actions.router,
    capture.router,
    handheld.router,
    media.router,
    scene.router,
    calibration.router,
    dataset.router,
    audit_overview.router,
    audit.router,
    audit_exports.router,
    monitoring.router,
)
# Put together once: FastAPI works out what a route depends on anew for every application that includes its router.
_PAGES = APIRouter(dependencies=[Depends(sealed, scope="function")])
for _router in _ROUTERS:
    _PAGES.include_router(_router)


def create_app(site: Site) -> FastAPI:
    """Return the application over one data folder."""
    app = FastAPI(
        title="orthocapture",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,  # the pages are for people; a list of all addresses would only help attackers
        routes=[*_PAGES.routes],
    )
    app.state.site = site
    app.state.limiter = Limiter(site.store.clock, failed_tries(site.store, TRIES_WINDOW_S))
    app.add_middleware(Shield, hosts=site.hosts)
    install_errors(app)
    monitoring.install_metrics(app)
    app.mount("/static", StaticFiles(packages=[("service.web", "static")]), name="static")
    return app
