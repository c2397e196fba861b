"""Releases a camera's shutter, and finds out whether it was released if the camera does not confirm it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from drivers.errors import DeviceBusyError, DeviceError, DeviceRefusedError, DeviceUnavailableError
from drivers.gphoto.dials import Dials
from drivers.gphoto.link import AddedFile, Link

_LOG = logging.getLogger(__name__)
BUSY_ATTEMPTS = 5
SECOND_TRY_S = 6.0  # beyond twice the exposure time, which noise reduction may double
UNCONFIRMED_S = 5.0  # wait for a photograph, beyond its exposure, if the camera did not confirm the release


def release_shutter(
    link: Link, dials: Dials, check_space: Callable[[], None]
) -> tuple[float, *tuple[AddedFile, ...]]:
    """Release the shutter; returns the host's time.monotonic() before it, and the file if that alone confirms it.

    Raises what `check_space` raises, DeviceBusyError, DeviceRefusedError, or another DeviceError of the link.
    """
    for attempt in range(1, BUSY_ATTEMPTS + 1):
        trigger_s = time.monotonic()
        try:
            link.call("Releasing the shutter", lambda camera: camera.trigger_capture())
        except DeviceBusyError:
            if attempt == BUSY_ATTEMPTS:
                raise
            time.sleep(0.2 * attempt)
        except (DeviceUnavailableError, DeviceRefusedError) as error:
            # A full card, a wrong mode, a lost or damaged answer or a lost connection: ask the camera which it is.
            dials.refresh()  # values of the last two seconds do not count
            check_space()
            return trigger_s, *_photographs(link, dials, error)
        else:
            return (trigger_s,)
    raise AssertionError


def release_again(
    link: Link, dials: Dials, trigger_s: float, timeout_s: float
) -> tuple[float, *tuple[AddedFile, ...]]:
    """Release once more if no file came of the first release after opening, unless the camera is busy with it.

    Returns as release_shutter does. Waits no longer than `timeout_s` since the first release.
    """
    longest_s = min(2 * dials.exposure_s() + SECOND_TRY_S, timeout_s)
    if (files := _first_files(link, longest_s)) or longest_s >= timeout_s:
        return (trigger_s, *files)
    again_s = time.monotonic()
    try:
        link.call("Releasing the shutter", lambda camera: camera.trigger_capture())
    except DeviceBusyError:
        return (trigger_s,)
    _LOG.warning("no photograph came, so it was released once more; some bodies take none for 3 s after opening")
    return (again_s,)


def _first_files(link: Link, longest_s: float) -> list[AddedFile]:
    """Wait for the first file of an exposure; empty if none came in time."""
    deadline_s = time.monotonic() + longest_s
    while time.monotonic() < deadline_s:
        if added := link.next_event(200)[1]:
            return list(added)
    return []


def _photographs(link: Link, dials: Dials, unconfirmed: DeviceError) -> list[AddedFile]:
    """The files of an exposure that the camera did not confirm, as far as they came at once.

    Raises DeviceRefusedError if none comes.
    """
    longest_s = dials.exposure_s() + UNCONFIRMED_S
    announced = list(dials.announced)
    dials.announced.clear()
    if files := announced or _first_files(link, longest_s):
        _LOG.warning("the camera did not confirm the release, and took a photograph: %s", unconfirmed.what)
        return files
    raise DeviceRefusedError(
        f"the camera did not confirm that it released the shutter, and no photograph came within {longest_s:.0f} s: "
        f"{unconfirmed.what}",
        where=link.where,
        remedy="Check the camera's display; turn the dial to M, and do not save to the camera only. Then take the "
        "exposure again; if the shutter was released after all, that photograph is not used",
    ) from unconfirmed
