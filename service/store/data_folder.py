"""The name that stands for a data folder, and what the site's file within it names, if it has one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.store.site import ObjectStoreSection, SiteFile

SITE_FILE = "site.yaml"


def data_folder(named: Path) -> Path:
    """Return the data folder that `--data` names: a folder, or the folder of a site.yaml."""
    return named.parent if named.name == SITE_FILE and not os.path.isdir(named) else named


def site_of(data_dir: Path) -> SiteFile | None:
    """Return what the site.yaml of a data folder says; None, and nothing is loaded, without one.

    Raises ConfigurationError.
    """
    if not (data_dir / SITE_FILE).is_file():
        return None
    from service.store.site import load_site  # noqa: PLC0415 - for sites only

    return load_site(data_dir)


def object_store_of(data_dir: Path) -> ObjectStoreSection | None:
    """Return the object store that a data folder's site.yaml names; None without one. Raises ConfigurationError."""
    site = site_of(data_dir)
    return None if site is None else site.object_store
