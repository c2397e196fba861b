"""Reads a listing of a real body, as `gphoto2 --summary` prints it, into a recording that simulated cameras serve."""

from __future__ import annotations

from drivers.gphoto.listing import listing_of
from drivers.interfaces import DeviceAnswers
from drivers.recording import RecordedDevice, Recording
from drivers.recording.personal_data import without_personal_data

# GetSet and IsEnabled of an entry, where its bytes are public: a piece of the answer to 9209 in gphoto/gphoto2#641.
_BYTES = {("ILCE-7RM5", "5007"): "0/1"}


def transcribe(listing: str, source: str) -> Recording:
    """The recording of a listing. Raises ValueError if it names no body."""
    told = listing_of(listing)
    properties = tuple(
        one.model_copy(update={"access": _BYTES.get((told.model, one.code), one.access)}) for one in told.properties
    )
    answers = DeviceAnswers(listing=told.model_copy(update={"properties": properties}))
    recorded = RecordedDevice(kind="camera", driver="gphoto", answers=answers)
    return without_personal_data(Recording(by="gphoto2 --summary", source=source, devices={"camera": recorded}))
