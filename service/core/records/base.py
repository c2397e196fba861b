"""The frozen base of all records, the reference to a content-addressed file, and moments in the host's clocks."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict


class Record(BaseModel):
    """Base of everything that is written down: frozen, no unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


def recorded(record: Record) -> dict[str, Any]:
    """Return a record as it is written into an event: all of its own fields, and the set fields of records in it.

    So a part that was read from an earlier event is written again exactly as it was.
    """
    return record.model_dump(mode="json") | record.model_dump(mode="json", exclude_unset=True)


class ArtefactRef(Record):
    """A reference to a content-addressed file, as events hold it."""

    sha256: str
    kind: str  # image, raw, board_image, scan, ct_slice, ct_mesh, pose_log, result, report, protocol, rig …
    media_type: str
    size_bytes: int
    original_name: str

    @property
    def is_picture(self) -> bool:
        """True if a browser can show the file."""
        return self.media_type in ("image/jpeg", "image/png")


_AGREE_S = 5.0  # by which the two clocks may differ over any time: UTC is stepped by less than this unnoticed
_AGREE_SHARE = 0.001  # and of the time that has passed: UTC is slewed by up to 500 ppm


def seconds_between(earlier_utc: str, later_utc: str) -> float:
    """Return the seconds from one recorded time (ISO 8601) to a later one; 0 if the clock was set back in between."""
    return max(0.0, (datetime.fromisoformat(later_utc) - datetime.fromisoformat(earlier_utc)).total_seconds())


@dataclass(frozen=True, slots=True)
class Moment:
    """The time of something that happened, in both clocks of the host.

    The monotonic clock starts again with each boot and stands still while the host sleeps; UTC can be set. Each of
    them supplies what the other cannot.
    """

    monotonic_s: float
    at_utc: str  # ISO 8601; "" where it was not recorded
    boot: str  # boot id; "" where the system has none, or where it was not recorded


@dataclass(frozen=True, slots=True)
class Elapsed:
    """The time between two moments; `seconds` is None where it is not known, and `why` says why not."""

    seconds: float | None
    why: str = ""


def elapsed(earlier: Moment, later: Moment) -> Elapsed:
    """Return the time from one moment to a later one, which is never negative.

    Within one boot it is that of the monotonic clock where UTC agrees with it, and that of UTC where more of it has
    passed: the host slept, or its clock was set forward; the longer time is then the safe one. Over a reboot it is
    that of UTC. It is not known if it would be negative, if less UTC than monotonic time has passed (the clock was
    set back), or if a record does not have what is needed.
    """
    if not earlier.at_utc or not later.at_utc:
        return Elapsed(None, "the record has the time of one boot only, as older versions wrote it")
    utc_s = (datetime.fromisoformat(later.at_utc) - datetime.fromisoformat(earlier.at_utc)).total_seconds()
    monotonic_s = later.monotonic_s - earlier.monotonic_s
    if earlier.boot and later.boot and earlier.boot != later.boot:
        why = f"after a restart the computer's clock is {-utc_s:.0f} s before the earlier time"
        return Elapsed(utc_s) if utc_s >= 0 else Elapsed(None, why)
    if monotonic_s >= 0 and abs(utc_s - monotonic_s) <= _AGREE_S + _AGREE_SHARE * monotonic_s:
        return Elapsed(monotonic_s)
    if not (earlier.boot and later.boot):
        return Elapsed(None, "the two clocks disagree, and whether the computer was restarted is not recorded")
    return _within_one_boot(utc_s, monotonic_s)


def age_s(since_utc_s: float, now_utc_s: float, *, if_set_back_s: float) -> float:
    """Return the time in seconds since a moment that was recorded in UTC alone, which is never negative.

    A moment later than now by more than `elapsed` tolerates shows that the clock was set back, so that its age is not
    known: `if_set_back_s` is then the answer, which the caller chooses on the safe side (infinity ends a sign-in; 0
    lets nobody claim to have waited).
    """
    age = now_utc_s - since_utc_s
    return if_set_back_s if age < -_AGREE_S else max(0.0, age)


def _within_one_boot(utc_s: float, monotonic_s: float) -> Elapsed:
    """Return the time where the two clocks disagree within one boot."""
    if monotonic_s < 0:
        return Elapsed(None, f"the monotonic clock ran back by {-monotonic_s:.0f} s within one boot")
    if utc_s > monotonic_s:
        return Elapsed(utc_s)
    return Elapsed(None, f"the computer's clock was set back by {monotonic_s - utc_s:.0f} s meanwhile")
