"""The name that stands for a data folder: its own, or that of the site's file within it."""

from __future__ import annotations

import os
from pathlib import Path

SITE_FILE = "site.yaml"


def data_folder(named: Path) -> Path:
    """Return the data folder that `--data` names: a folder, or the folder of a site.yaml."""
    return named.parent if named.name == SITE_FILE and not os.path.isdir(named) else named
