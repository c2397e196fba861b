"""The web application: routers, safety headers, a sealed record, and errors that say nothing of the inside."""

from __future__ import annotations

from fastapi import Depends, FastAPI
from fastapi.staticfiles import StaticFiles

from service.web import (
    account_pages,
    acting,
    audit_pages,
    badge_pages,
    calibration_pages,
    capture_pages,
    checklist_pages,
    compare_pages,
    devices_pages,
    export_pages,
    gates_pages,
    health_pages,
    held_pages,
    history_pages,
    home_pages,
    media,
    note_pages,
    run_pages,
    scene_pages,
    start_pages,
    stream,
)
from service.web.seal import sealed
from service.web.security import install_security
from service.web.site import Site

_PAGES = (
    account_pages,
    badge_pages,
    home_pages,
    start_pages,
    compare_pages,
    history_pages,
    run_pages,
    acting,
    note_pages,
    stream,
    capture_pages,
    checklist_pages,
    held_pages,
    media,
    scene_pages,
    calibration_pages,
    audit_pages,
    gates_pages,
    devices_pages,
    export_pages,
    health_pages,
)


def create_app(site: Site) -> FastAPI:
    """The application over one data folder."""
    app = FastAPI(
        title="orthocapture",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,  # the pages are for people; a list of all addresses helps strangers only
        dependencies=[Depends(sealed, scope="function")],
    )
    app.state.site = site
    install_security(app)
    health_pages.install_metrics(app)
    for page in _PAGES:
        app.include_router(page.router)
    app.mount("/static", StaticFiles(packages=[("service.web", "static")]), name="static")
    return app
