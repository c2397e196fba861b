"""The web application: routers, safety headers, a sealed record, and errors that reveal no internals."""

from __future__ import annotations

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles

from service.people.credentials import failed_tries
from service.web import monitoring
from service.web.audit import evidence, exports, overview
from service.web.audit import pages as audit
from service.web.calibration import pages as calibration
from service.web.capture import media
from service.web.capture import pages as capture
from service.web.dataset import pages as dataset
from service.web.handheld import pages as handheld
from service.web.home import history
from service.web.home import pages as home
from service.web.page.rendering import install_errors
from service.web.people import account
from service.web.run import actions
from service.web.run import pages as run
from service.web.scene import pages as scene
from service.web.security import TRIES_WINDOW_S, Limiter, Shield, sealed
from service.web.site import Site

_ROUTERS: tuple[APIRouter, ...] = (
    account.router,
    home.router,
    history.router,
    run.router,
    actions.router,
    capture.router,
    handheld.router,
    media.router,
    scene.router,
    calibration.router,
    dataset.router,
    overview.router,
    audit.router,
    evidence.router,
    exports.router,
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
