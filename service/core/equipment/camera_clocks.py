"""How far the clock of one camera is ahead of another's, from the photographs that both took in a run. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean, stdev

from service.core.equipment.recorded_devices import recorded_optics
from service.core.records.events import FurtherExposure, ViewpointCaptured

_UNLIKE_S = 0.1  # sigma of the difference between two models' delays, from the command to the exposure
_FORMS = ("%Y:%m:%d %H:%M:%S.%f%z", "%Y:%m:%d %H:%M:%S.%f", "%Y:%m:%d %H:%M:%S%z", "%Y:%m:%d %H:%M:%S")


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The mean offset of a further camera's clock.

    Attributes:
        offset_s: of the further camera's clock minus the first one's.
        sigma_s: of the mean: by the scatter of the photographs, or by the resolution of their times if that is more;
            for cameras of two models, with what their delays may differ by.
        photographs: pairs of them that state their times alike.
        unlike: whether the cameras are of two models.
    """

    offset_s: float
    sigma_s: float
    photographs: int
    unlike: bool = False


def clock_offset(captures: Sequence[ViewpointCaptured], device: str) -> ClockOffset | None:
    """The offset of a further camera's clock from the first one's; None if no two photographs state their times.

    Between the two exposures at a viewpoint the host's clock tells how much time passed. What the time that both
    photographs state differs from that is the offset. A difference between the cameras' delays, from the command to
    the exposure, is part of it. Two bodies of one model have the same delay. Those of two models may differ by some
    tenths of a second, which no number of photographs averages out.
    """
    pairs = [(c, exposure) for c in captures for exposure in c.further if exposure.device == device]
    found = [offset for capture, exposure in pairs if (offset := _of_pair(capture, exposure)) is not None]
    if not found:
        return None
    offsets = [offset for offset, _ in found]
    coarse_s = max(resolution for _, resolution in found) / math.sqrt(6)  # two rounded times, each r / sqrt(12)
    scatter_s = stdev(offsets) if len(offsets) > 1 else 0.0
    sigma_s = max(coarse_s, scatter_s) / math.sqrt(len(offsets))
    unlike = any(recorded_optics(capture.camera).model != recorded_optics(one.camera).model for capture, one in pairs)
    return ClockOffset(fmean(offsets), math.hypot(sigma_s, _UNLIKE_S if unlike else 0.0), len(offsets), unlike)


def _of_pair(capture: ViewpointCaptured, exposure: FurtherExposure) -> tuple[float, float] | None:
    """Offset and resolution of the stated times, in seconds."""
    first, second = (_time(recorded_optics(camera).exif_time) for camera in (capture.camera, exposure.camera))
    if first is None or second is None or (first[0].tzinfo is None) != (second[0].tzinfo is None):
        return None
    stated_s = (second[0] - first[0]).total_seconds()
    return stated_s - (exposure.trigger_monotonic_s - capture.trigger_monotonic_s), max(first[1], second[1])


def _time(stated: str) -> tuple[datetime, float] | None:
    """The time that a photograph states, and its resolution in seconds."""
    for form in _FORMS:
        try:
            found = datetime.strptime(stated, form)  # noqa: DTZ007 - compared only with one that has no zone either
        except ValueError:
            continue
        _, _, after = stated.partition(".")
        digits = len(after) - len(after.lstrip("0123456789"))
        return found, 10.0**-digits
    return None
