"""The folder of the protocols that come with orthocapture, in a checkout or an installed wheel."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def shipped_protocols() -> Path:
    """The folder of the protocols that come with orthocapture."""
    return Path(str(files("protocols")))
