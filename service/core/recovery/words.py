"""Words for the ways on: what to do about each class of error."""

from __future__ import annotations

from collections.abc import Mapping

# Error class → what a person does before trying again. Every class in drivers/errors.py has an entry.
REMEDIES: Mapping[str, str] = {
    "DeviceError": "Check the device",
    "DeviceUnavailableError": "Check that the device is switched on and its cable or network is connected",
    "DeviceTimeoutError": "Check that the device is awake, or that the expected file has arrived",
    "MachineBusyError": "End what else this computer computes, or wait until it is done",
    "DriverKilledError": "End programs that are not needed on this computer, and look at the device",
    "DeviceChangedError": "Connect the device that was calibrated, or repeat the calibration with this one",
    "DeviceBusyError": "Wait until the device has finished what it is doing",
    "DeviceRefusedError": "Set the device as the message says",
    "DeviceFaultError": "Switch the device off and on; replace it if the fault remains",
    "DeviceStorageFullError": "Make room where the device stores its data, or insert another card",
    "SafetyStopError": "Check the robot and the people around it, then clear the stop at the robot",
    "LeaveNeededError": "Check that the robot stands as it should and nobody is within its reach",
    "ArmDepartedError": "Look at what moved the robot; from where it stands now its motions are planned anew",
    "ToolChangedError": "Ask who changed the tool or the payload at the pendant; the rig's own are set again",
    "UnreachablePoseError": "Move the obstacle, or the robot's base, so that the robot can reach the pose",
    "ReleasedElsewhereError": "Press the camera's own button, or connect a camera that the software can release",
    "StaleImageError": "Check the camera: it delivered an earlier image instead of a new one",
    "UnreadableFileError": "Export the file again, or use another one",
    "IncompleteExportError": "Wait until the export has ended, or export again with all files",
    "DriverMissingError": "Install the driver that the message names",
    "DataError": "Use another file; this one cannot be used",
    "ImagesSpoiltError": "Clean the lens, and check that its cap is off and the light is on",
    "ComputeError": "Put right what the message names, or take what is missing",
    "ConfigurationError": "Put right what the message names",
    "ProtocolError": "Put right what the message names",
    "StoreError": "Check the disk that holds the evidence: free space, cable, permissions",
    "SpaceShortError": "Make room on the disk of the data folder, as the message says",
    "UnforeseenError": "Put right what the message names; report it with the log",
    "IntegrityError": "Restore the damaged file from a copy; it is checked against its hash when it is read",
}
UNKNOWN_REMEDY = "Put right what the message names"
