"""Counts requests by route and status, and measures the time until each answer begins."""

from __future__ import annotations

import logging
import time

from prometheus_client import CollectorRegistry, Counter, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
        """One request."""
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
