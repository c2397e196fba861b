"""The web application: routers, safety headers, a sealed record, and errors that reveal no internals."""

from __future__ import annotations

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles

import service.web.calibration.pages
import service.web.capture.pages
import service.web.dataset.pages
import service.web.handheld.pages
import service.web.home.pages
import service.web.monitoring.pages
import service.web.run.pages
import service.web.scene.pages
import service.web.scene.region
from service.people.tries import failed_tries
from service.web.audit import corrections, devices, exports, gates, overview, runs, signatures
from service.web.capture import media
from service.web.evidence import artefacts, events
from service.web.home import checklist, compare, history, start
from service.web.monitoring.pages import install_metrics
from service.web.page.errors import install_errors
from service.web.people import account, badges
from service.web.run import actions, control, news, notes
from service.web.security.seal import sealed
from service.web.security.shield import TRIES_WINDOW_S, Limiter, Shield
from service.web.site import Site

_ROUTERS: tuple[APIRouter, ...] = (
    account.router,
    badges.router,
    service.web.home.pages.router,
    start.router,
    compare.router,
    history.router,
    service.web.run.pages.router,
    actions.router,
    control.router,
    notes.router,
    news.router,
    service.web.capture.pages.router,
    checklist.router,
    service.web.handheld.pages.router,
    media.router,
    service.web.scene.pages.router,
    service.web.scene.region.router,
    service.web.calibration.pages.router,
    service.web.dataset.pages.router,
    runs.router,
    overview.router,
    corrections.router,
    signatures.router,
    events.router,
    artefacts.router,
    gates.router,
    devices.router,
    exports.router,
    service.web.monitoring.pages.router,
)
# Put together once: FastAPI works out what a route depends on anew for every application that includes its router.
_PAGES = APIRouter(dependencies=[Depends(sealed, scope="function")])
for _router in _ROUTERS:
    _PAGES.include_router(_router)
_WITH_STATIC_FILES = ("audit", "calibration", "capture", "dataset", "handheld", "home", "people", "run", "scene")


def create_app(site: Site) -> FastAPI:
    """The application over one data folder."""
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
    install_metrics(app)
    for folder in _WITH_STATIC_FILES:
        files = StaticFiles(packages=[(f"service.web.{folder}", "static")])
        app.mount(f"/static/{folder}", files, name=f"static_{folder}")
    app.mount("/static", StaticFiles(packages=[("service.web.page", "static")]), name="static")  # used by every page
    return app
