"""The words of the ways on: what doing a kind of step again means, and what to do about each class of error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Again:
    """What trying a kind of step again does after its figures were outside their limits.

    Attributes:
        words: what to do, and what happens then.
        same: it gives the same figures as long as nothing that it rests on is done again.
        device: whether a device can fail in it.
        computes: whether a computation can fail in it.
    """

    words: str
    same: bool = False
    device: bool = True
    computes: bool = True


OTHERWISE = Again("Put right what the figures show, then try this step again")
AGAIN: Mapping[str, Again] = {
    "checklist": Again("Do what is open, tick it, and confirm again", device=False, computes=False),
    "layout_check": Again("Move the spheres as it says, then take another photograph"),
    "ct_import": Again("Put another series into the CT folder and import that"),
    "calibration": Again("Take the board images that are missing and compute again; the others are kept"),
    "viewpoint_capture": Again("Take the views that are missing or would help; the others are kept"),
    "manual_capture": Again("Take the images that are missing or would help; the others are kept"),
    "scan_import": Again("Scan again, export it, and import that"),
    "timed_application": Again(
        "Count it as it is; the clock of the coat runs on", same=True, device=False, computes=False
    ),
    "registration": Again("Compute it again; the same images give the same figures", same=True, device=False),
    "evaluation": Again("Compute it again; the same registration gives the same figures", same=True, device=False),
}

# Class of an error → what a person does before trying again. Every class of drivers/errors.py has a line.
REMEDIES: Mapping[str, str] = {
    "DeviceError": "Look at the device",
    "DeviceUnavailableError": "Look whether the device is switched on and its cable or network is in place",
    "DeviceTimeoutError": "Look whether the device is awake, or the file it waits for has arrived",
    "DeviceBusyError": "Wait until the device has finished what it does",
    "DeviceRefusedError": "Set the device as the message says",
    "DeviceFaultError": "Switch the device off and on; put another one in its place if it stays so",
    "DeviceStorageFullError": "Make room where the device stores its data, or put in another card",
    "SafetyStopError": "Look at the robot and the people around it, then clear the stop at the robot",
    "LeaveNeededError": "Look whether the robot stands as it should and nobody is in reach",
    "UnreachablePoseError": "Move what stands in the way, or the robot's foot, so that it reaches the pose",
    "ReleasedElsewhereError": "Press the camera's own button, or connect a camera that the software can release",
    "StaleImageError": "Look at the camera: it delivered an earlier image instead of a new one",
    "UnreadableFileError": "Export the file again, or another one",
    "IncompleteExportError": "Wait until the export has ended, or export it again with all its files",
    "DriverMissingError": "Install the driver that the message names",
    "DataError": "Put in another file; this one cannot be used",
    "ImagesSpoiltError": "Clean the lens, and look whether its cap is off and the light is on",
    "ComputeError": "Put right what the message names, or take what is missing",
    "ConfigurationError": "Put right what the message names",
    "ProtocolError": "Put right what the message names",
    "StoreError": "Look at the disk that holds the evidence: room, cable, permissions",
    "SpaceShortError": "Make room on the disk of the data folder, as the message says",
    "IntegrityError": "Put the damaged file back from a copy: what is read is checked against its hash",
}
UNKNOWN_REMEDY = "Put right what the message names"
