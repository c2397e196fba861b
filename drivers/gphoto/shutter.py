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
            check_space()
            return trigger_s, _photograph(link, dials.exposure_s() + UNCONFIRMED_S, error)
        else:
            return (trigger_s,)
    raise AssertionError


def _photograph(link: Link, longest_s: float, unconfirmed: DeviceError) -> AddedFile:
    """Wait for the file of an exposure that the camera did not confirm. Raises DeviceRefusedError if none comes."""
    deadline_s = time.monotonic() + longest_s
    while time.monotonic() < deadline_s:
        for added in link.next_event(200)[1]:
            _LOG.warning("the camera did not confirm the release, and took a photograph: %s", unconfirmed.what)
            return added
    raise DeviceRefusedError(
        f"the camera did not confirm that it released the shutter, and no photograph came within {longest_s:.0f} s: "
        f"{unconfirmed.what}",
        where=link.where,
        remedy="Check the camera's display; turn the dial to M, and do not save to the camera only. Then take the "
        "exposure again; if the shutter was released after all, that photograph is not used",
    ) from unconfirmed
