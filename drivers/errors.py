"""The DeviceError tree: vendor errors are wrapped here and stop here."""

from __future__ import annotations

from service.core.errors import OrthocaptureError


class DeviceError(OrthocaptureError):
    """Base of everything a device can do wrong; `where` names the device and its address."""


class DeviceUnavailableError(DeviceError):
    """Nobody answers, or the link dropped: reconnecting may help."""


class DriverMissingError(DeviceError):
    """The vendor's library is not installed: it has no ready-made package for this Python or this machine."""


class DeviceTimeoutError(DeviceError):
    """The device or its driver process did not answer in time."""


class DeviceBusyError(DeviceError):
    """The device asks to be left alone for a moment: the same call may succeed later."""


class DeviceRefusedError(DeviceError):
    """The device understood and said no (setting not available, out of range, wrong mode)."""


class ReleasedElsewhereError(DeviceRefusedError):
    """The software cannot release this camera: a person does, and its photographs come as files."""


class DeviceFaultError(DeviceError):
    """The device answers but is not fit for use (unsupported firmware, inconsistent read-back)."""


class DeviceStorageFullError(DeviceError):
    """No space left where the device stores its data."""


class SafetyStopError(DeviceError):
    """Protective, emergency or safeguard stop: only a person clears it."""


class LeaveNeededError(DeviceError):
    """Nobody has let the arm move since it was connected, or since its program ended unasked: a person confirms."""


class UnreachablePoseError(DeviceError):
    """The controller has no joint solution for this pose."""


class StaleImageError(DeviceError):
    """The file that arrived is not the one just taken: counter, EXIF time or hash did not advance."""


class UnreadableFileError(DeviceError):
    """A device file (scan, DICOM slice, photograph) is damaged, incomplete or not what it says."""


class IncompleteExportError(DeviceError):
    """A scan or series is still being written, or companions are missing."""
