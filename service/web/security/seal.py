"""The site's chain is signed to its end after every request that may have changed it."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator

from fastapi import Request
from fastapi.concurrency import run_in_threadpool

from service.core.errors import OrthocaptureError
from service.store.records import SITE, UnknownRunError
from service.store.signatures.signing import checkpoint
from service.web.site import CurrentSite, Site

_log = logging.getLogger("orthocapture.web")
_SAFE_METHODS = ("GET", "HEAD", "OPTIONS")


async def sealed(request: Request, site: CurrentSite) -> AsyncGenerator[None]:
    """Dependency of all routes (`scope="function"`): signs before the answer is sent, also for refused requests.

    Only requests such as POST need it: accounts, invitations, sign-ins and signatures, refused ones included.
    """
    try:
        yield
    finally:
        if request.method not in _SAFE_METHODS:
            await run_in_threadpool(seal, site)


def seal(site: Site) -> None:
    """Sign the unsigned end of the site's chain. A failure is logged; what was done stays done."""
    try:
        seq = site.store.head(SITE)
        if seq != site.sealed_seq:
            checkpoint(site.store, SITE)
            site.sealed_seq = seq
            site.second_place.update()
    except UnknownRunError:
        return  # nothing has happened here yet
    except OrthocaptureError as error:
        _log.error("the site's record could not be signed: %s", error)
