"""The DeviceError tree: drivers translate every vendor error into one of these."""

from __future__ import annotations

from service.core.errors import OrthocaptureError


class DeviceError(OrthocaptureError):
    """Base class of all device errors; `where` names the device and its address."""


class DeviceUnavailableError(DeviceError):
    """The device does not answer, or the link dropped. Reconnecting may help."""


class DriverKilledError(DeviceUnavailableError):
    """The system or a person ended the driver's process: for want of memory, say. A person decides what follows."""


class DeviceChangedError(DeviceError):
    """Another device answers than the one that answered before: what was calibrated was calibrated with that one."""


class DriverMissingError(DeviceError):
    """The vendor's library is not installed, because it has no wheel for this Python or this machine."""


class DeviceTimeoutError(DeviceError):
    """The device or its driver process did not answer in time."""


class MachineBusyError(DeviceTimeoutError):
    """A time limit ran out because this computer had no processor or memory to spare; the device may be sound."""


class DeviceBusyError(DeviceError):
    """The device is busy: the same call may succeed later."""


class DeviceRefusedError(DeviceError):
    """The device rejected the request (setting not available, value out of range, wrong mode)."""


class ReleasedElsewhereError(DeviceRefusedError):
    """The software cannot release this camera's shutter: a person does, and its photographs arrive as files."""


class DeviceFaultError(DeviceError):
    """The device answers but cannot be used (unsupported firmware, inconsistent read-back)."""


class DeviceStorageFullError(DeviceError):
    """No space left where the device stores its data."""


class SafetyStopError(DeviceError):
    """Protective, emergency or safeguard stop: only a person clears it."""


class LeaveNeededError(DeviceError):
    """A person must confirm motion first: the arm was just connected, or its program ended unexpectedly."""


class ArmDepartedError(DeviceError):
    """The arm does not stand where it was sent: somebody or something moved it."""


class ToolChangedError(DeviceError):
    """The tool centre point or the payload that the controller holds was changed by somebody else."""


class UnreachablePoseError(DeviceError):
    """The controller has no joint solution for this pose."""


class StaleImageError(DeviceError):
    """The file that arrived is not from the last exposure: its counter, EXIF time or hash is not new."""


class UnreadableFileError(DeviceError):
    """A device file (scan, DICOM slice, photograph) is damaged, incomplete or of another format than it claims."""


class IncompleteExportError(DeviceError):
    """A scan or series is still being written, or companions are missing."""
