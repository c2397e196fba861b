"""The installed software, for the record of a session."""

from __future__ import annotations

from importlib.metadata import distributions
from typing import Any


def software_versions() -> dict[str, str]:
    """Every installed distribution and its version, sorted by name."""
    found: dict[str, Any] = {d.metadata["Name"]: d.version for d in distributions()}
    return {name: str(version) for name, version in sorted(found.items()) if name}
