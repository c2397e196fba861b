"""What each scanner's software exports: one small file for each, found by its entry point."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from drivers.scan_profiles.profile import ScanProfile

GROUP = "orthocapture.scan_profiles"


@cache
def profile_names() -> tuple[str, ...]:
    """The names of the installed profiles, sorted."""
    return tuple(sorted(point.name for point in entry_points(group=GROUP)))


def profile_named(name: str) -> ScanProfile:
    """The profile of this name. Raises ValueError, which lists the installed ones, if there is none."""
    for point in entry_points(group=GROUP, name=name):
        profile = point.load()
        if isinstance(profile, ScanProfile):
            return profile
    raise ValueError(f"there is no scan profile {name!r}; installed are {', '.join(profile_names())}")
