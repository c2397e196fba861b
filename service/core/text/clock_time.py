"""Recorded times as people read them off a clock."""

from __future__ import annotations

from datetime import datetime


def time_utc(at_utc: str) -> str:
    """The time of day of a recorded time (ISO 8601): `20:41:07 UTC`."""
    return f"{at_utc[11:19]} UTC"


def local_time(at_utc: str) -> str:
    """A recorded time on the clock of this machine and its site: `10:12:03 CET`; "" where that is UTC itself."""
    try:
        there = datetime.fromisoformat(at_utc).astimezone()
    except ValueError:
        return ""
    if not there.utcoffset():
        return ""
    day = f"{there:%Y-%m-%d} " if f"{there:%Y-%m-%d}" != at_utc[:10] else ""
    return f"{day}{there:%H:%M:%S} {there.tzname()}"


def time_here(at_utc: str) -> str:
    """The time of day of a recorded time on the clock on the wall, and in UTC only where that is the same."""
    return local_time(at_utc) or time_utc(at_utc)
