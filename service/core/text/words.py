"""Words that people read everywhere: counts, times of day, and what a reason has to say."""

from __future__ import annotations

from datetime import datetime

from service.core.errors import OrthocaptureError

SIMULATED = "SIMULATED: made by a simulated rig, not by a camera in front of a specimen"  # in every file with room


def counted(number: int, one: str, more: str = "") -> str:
    """Return a count as text: `1 deviation`, `2 deviations`, `no deviation`. `more` is an irregular plural."""
    return f"{number or 'no'} {one if number in (0, 1) else more or one + 's'}"


def time_utc(at_utc: str) -> str:
    """Return the time of day of a recorded time (ISO 8601): `20:41:07 UTC`."""
    return f"{at_utc[11:19]} UTC"


def local_time(at_utc: str) -> str:
    """Return a recorded time on the clock of this machine and its site: `10:12:03 CET`; "" where that is UTC."""
    try:
        there = datetime.fromisoformat(at_utc).astimezone()
    except ValueError:
        return ""
    if not there.utcoffset():
        return ""
    day = f"{there:%Y-%m-%d} " if f"{there:%Y-%m-%d}" != at_utc[:10] else ""
    return f"{day}{there:%H:%M:%S} {there.tzname()}"


def time_here(at_utc: str) -> str:
    """Return the time of day of a recorded time on the clock on the wall, and in UTC only where that is the same."""
    return local_time(at_utc) or time_utc(at_utc)


REASON_CHARACTERS = 2000


def reason_of(typed: str, error: type[OrthocaptureError]) -> str:
    """Return the reason without outer blanks. Raises this error if it says nothing, or more than anybody reads."""
    plain = typed.strip()
    if not plain or len(plain) > REASON_CHARACTERS:
        raise error(
            f"the reason has {len(plain)} characters" if plain else "a reason is needed",
            where="reason",
            remedy=f"Say why, in up to {REASON_CHARACTERS} characters; it goes into the record",
        )
    return plain
