"""What the driver needs of a library for GenICam cameras: Aravis, or harvesters with a maker's producer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class LinkError(Exception):
    """A call failed; the message is the library's."""


class NotInControlError(LinkError):
    """The camera takes no settings from here: another program controls it, or control was lost."""


class LibraryMissingError(Exception):
    """A library is not installed; `remedy` says how to install it."""

    def __init__(self, library: str, remedy: str) -> None:
        super().__init__(library)
        self.remedy = remedy


class NoImageError(Exception):
    """No whole image came in time."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One image as the camera sent it: its number, size in px, pixel format by its GenICam code, and bytes."""

    number: int
    width: int
    height: int
    code: int
    data: bytes


class CameraLink(Protocol):
    """A connected camera. Not thread-safe; calls may block and raise LinkError, and a fault may end the process."""

    def close(self) -> None:
        """Disconnect."""
        ...

    @property
    def software(self) -> str:
        """Name and version of the library."""
        ...

    @property
    def vendor(self) -> str:
        """Name of the camera's maker."""
        ...

    @property
    def model(self) -> str:
        """Name of the model."""
        ...

    @property
    def serial(self) -> str:
        """Serial number."""
        ...

    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        ...

    @property
    def exposure_s(self) -> float:
        """Exposure time that the camera reports."""
        ...

    @property
    def gain(self) -> float:
        """Gain that the camera reports, in its own unit, usually dB."""
        ...

    def set_exposure_s(self, exposure_s: float) -> None:
        """Set the exposure time; the camera may round it."""
        ...

    def set_gain(self, gain: float) -> None:
        """Set the gain, in the camera's own unit."""
        ...

    def set_pixel_format(self, name: str) -> None:
        """Set the pixel format by its GenICam name, such as BayerRG8."""
        ...

    def acquire(self, timeout_s: float) -> Frame:
        """Expose and receive one image. Raises NoImageError or LinkError."""
        ...
