"""The interface of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from drivers.interfaces.device import Device


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """The camera settings that a protocol prescribes."""

    aperture_f: float
    exposure_s: float
    iso: int
    focus_mode: str = "Manual"
    image_quality: str = "JPEG"  # JPEG, RAW or RAW+JPEG


@dataclass(frozen=True, slots=True)
class CapturedFile:
    """One file of an exposure, byte for byte as the camera wrote it."""

    path: Path
    camera_name: str  # DSC00004.JPG
    sha256: str
    size_bytes: int
    media_type: str  # image/jpeg, image/x-sony-arw


@dataclass(frozen=True, slots=True)
class CapturedImage:
    """One exposure: its files, its EXIF data and its time on the host's monotonic clock."""

    files: tuple[CapturedFile, ...]  # JPEG first
    counter: int  # of the camera's file names; advances with each exposure
    exif_time: str  # DateTimeOriginal with sub-seconds, as in the file
    exif: CameraSettings
    lens: str
    focal_length_mm: float
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    width: int = 0  # px; this and the following are 0 or "" if the file does not state them
    height: int = 0
    lens_serial: str = ""
    body_serial: str = ""
    focus_distance_m: float = 0.0
    focus_position: int | None = None  # of the focus motor, in its own steps; None if the file does not state it
    model: str = ""  # of the body
    found_at: str = ""  # path at which the file was found; "" if it was downloaded from the camera

    @property
    def jpeg(self) -> CapturedFile:
        """The JPEG of the exposure."""
        return self.files[0]


class Camera(Device, Protocol):
    """A stills camera under remote control."""

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set each value, wait, and return what reads back; DeviceRefusedError if it differs.

        A camera without a cable only remembers the settings, which a person then dials in.
        """
        ...

    def settings(self) -> CameraSettings:
        """Return the current settings, read from the camera itself and not from a cache."""
        ...

    def capture(self, folder: Path) -> CapturedImage:
        """Take one exposure and download its undecoded files into `folder`.

        Raises:
            StaleImageError: the file that arrived is not new.
            ReleasedElsewhereError: only the camera's own button releases its shutter.
        """
        ...

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Download into `folder` the images released with the camera's own button, oldest first.

        Waits up to `timeout_s` for the first one; returns an empty tuple if the button was not pressed. The trigger
        time is when the camera announced the image, or when its file arrived. Images found as files are ignored if
        they were taken before `since_utc_s` (seconds since 1970); images announced by the camera are always new.
        """
        ...

    def preview(self) -> bytes:
        """Return one live-view frame as JPEG bytes."""
        ...
