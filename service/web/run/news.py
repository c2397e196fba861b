"""News for the pages as server-sent events: that something changed, never what."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from service.core.errors import OrthocaptureError
from service.monitor.snapshot import STALE_S, read_snapshot
from service.people.control import Control
from service.people.person import Person
from service.web.page.run_frame import coats_of
from service.web.security.guards import SignedInPerson, requires, token_of
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["stream"])

_LOOK_S = 0.3
_BEAT_S = 1.5  # a page that hears nothing for twice this says that the connection is lost
_CHECK_S = 5.0
RunId = Annotated[str, Path(max_length=64)]


@router.get("/runs/{run_id}/stream", name="stream", dependencies=[Depends(requires("read"))])
async def stream(request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId) -> StreamingResponse:
    """`changed` with {"seq", "monitor", "locked"} whenever one of them has changed.

    `replaced` ends the stream: the sign-in has opened more streams than it may have, and this is the oldest.
    """
    await run_in_threadpool(site.store.head, run_id)  # an unknown run is refused before the stream begins
    return StreamingResponse(
        _news(request, site, person.screen, run_id),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _news(request: Request, site: Site, screen: str, run_id: str) -> AsyncGenerator[str]:
    told: tuple[int, int, bool] | None = None
    clock = site.store.clock
    beat_s = checked_s = clock.monotonic_s()
    token, locked = token_of(request, site), False
    with site.streams.opened(screen) as place:
        while not await request.is_disconnected():
            now_s = clock.monotonic_s()
            if place.replaced:
                yield "event: replaced\ndata: {}\n\n"
                return
            if now_s - checked_s > _CHECK_S:
                checked_s = now_s
                person = await run_in_threadpool(_signed_in, site, token)
                if person is None:
                    yield "event: signed_out\ndata: {}\n\n"
                    return
                locked = person.locked
            news = (*await run_in_threadpool(newest, site, run_id), locked)
            if news != told:
                told, beat_s = news, now_s
                data = {"seq": news[0], "monitor": news[1], "locked": locked}
                yield f"event: changed\ndata: {json.dumps(data)}\n\n"
            elif now_s - beat_s > _BEAT_S:
                beat_s = now_s
                yield "event: beat\ndata: {}\n\n"
            await asyncio.sleep(_LOOK_S)


def _signed_in(site: Site, token: str) -> Person | None:
    """Who sits there; a screen that was left alone is locked by this look."""
    return site.people.person(token, idle_lock_s=site.idle_lock_s, deliberate=False)


def newest(site: Site, run_id: str) -> tuple[int, int]:
    """The last event, and a number that changes with the runner's reports, its silence, control, and a coat's age.

    Who asks for control, and whether that was refused, are no events of the run: they are rows of the site.
    """
    now_utc_s = site.store.clock.utc_s()
    snapshot = read_snapshot(site.data, run_id, now_utc_s)
    silent = snapshot.age_s(now_utc_s) // STALE_S if snapshot.stale(now_utc_s) else 0
    shown = (silent, Control(site.store).holder(run_id), *_ages(site, run_id), *snapshot.shown())
    return site.store.head(run_id), hash(shown)


def _ages(site: Site, run_id: str) -> list[str]:
    """What the pages say of a coat's age; nothing of a run that cannot be read, which its pages say themselves."""
    try:
        return [coat.title for coat in coats_of(site, site.run(run_id))]
    except OrthocaptureError:
        return []
