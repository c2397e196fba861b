"""The fill level of the spool of a site's object store, for the pages; nothing is loaded or read for other sites."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.core.errors import OrthocaptureError
from service.store.data_folder import SITE_FILE

if TYPE_CHECKING:
    from service.store.objects.spool import SpoolLevel
    from service.web.site import Site


def spool_of(site: Site) -> SpoolLevel | None:
    """Return how full the spool is; None for a site without an object store, or whose site.yaml is wrong."""
    try:
        return _level(site)
    except OrthocaptureError:
        return None  # the page of the runs says what is wrong


def spool_sentence(site: Site) -> str:
    """Return how full the spool is, and what hinders it, as a sentence; "" for a site without an object store."""
    try:
        level = _level(site)
    except OrthocaptureError as error:
        return f"nothing is uploaded: {error}"
    return "" if level is None else level.sentence


def _level(site: Site) -> SpoolLevel | None:
    if not (site.data / SITE_FILE).is_file():
        return None
    from service.store.objects.spool import spool_level  # noqa: PLC0415 - for sites only

    return spool_level(site.store)
