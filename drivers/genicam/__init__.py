"""Driver for industrial cameras with GenICam: by the library Aravis, or by a maker's GenTL producer and harvesters.

Each call makes the camera take one new frame. The exposure time is set
and read back; aperture and gain stay as rig.yaml states them, because the lens of such a camera is set by hand and a
protocol's ISO has no meaning to it. Why two ways: docs/decisions/0020-genicam-by-aravis.md.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    DriverMissingError,
    UnreadableFileError,
)
from drivers.genicam.aravis import AravisCamera
from drivers.genicam.link import CameraLink, LibraryMissingError, LinkError, NoImageError, NotInControlError
from drivers.genicam.pixels import picture
from drivers.genicam.producer import ProducerCamera
from drivers.interfaces import CameraSettings, CapturedImage, DeviceIdentity, DeviceReport
from drivers.photos.frames import FrameFiles, frame_jpeg
from drivers.plugin import DriverConfig, DriverSpec
from drivers.stated_settings import TOLERANCE, agrees, differences


class GenicamConfig(DriverConfig):
    """An industrial camera in rig.yaml."""

    camera: str = Field(
        min_length=1, description="its IP address, or its name in the list of arv-tool-0.8 or of the producer"
    )
    producer: str = Field(
        default="",
        description='file of a GenTL producer (.cti), for cameras that Aravis does not speak to; "": Aravis',
    )
    serial: str = Field(default="", description='serial number that it must have; "": any')
    aperture_f: float = Field(gt=0, description="as it is set on the lens")
    iso: int = Field(default=100, gt=0, description="what the protocol calls this gain")
    gain: float = Field(default=0.0, description="in the camera's own unit, usually dB")
    pixel_format: Literal["Mono8", "BayerGR8", "BayerRG8", "BayerGB8", "BayerBG8", "RGB8"] = Field(
        default="BayerRG8", description="by its GenICam name"
    )
    frame_timeout_s: float = Field(
        default=5.0, gt=0, le=30, description="longest wait for an image, beyond its exposure"
    )
    lens: str = ""  # for the record
    focal_length_mm: float = Field(default=0.0, ge=0, description="for the record; 0: not known")


class GenicamCamera:
    """drivers.interfaces.Camera on a GenICam camera. Libraries may crash: drivers.host gives it its own process."""

    def __init__(self, config: GenicamConfig) -> None:
        self._config = config
        self._where = f"GenICam camera {config.camera}"
        self._link: CameraLink | None = None
        self._identified: DeviceIdentity | None = None
        self._files = FrameFiles("camera", self._where)
        self._taken = 0

    # --- every device -----------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Connect, check the serial number, and set gain and pixel format.

        Raises DriverMissingError without the library, DeviceUnavailableError if no such camera answers,
        DeviceFaultError if it is another one or does not take the settings.
        """
        self.close()
        try:
            link = self._linked()
        except LibraryMissingError as error:
            raise DriverMissingError(
                f"{error} is not installed", where=self._where, remedy=f"Install it: {error.remedy}"
            ) from error
        except LinkError as error:
            raise self._unavailable(str(error)) from error
        self._link = link
        self._files.reopened()
        try:
            self._identified = self._checked_identity(link)
            self._set_up(link)
        except DeviceError:
            self.close()
            raise
        return self._identified

    def _set_up(self, link: CameraLink) -> None:
        """Set pixel format and gain. Raises DeviceFaultError, or DeviceUnavailableError if the connection is lost."""
        try:
            link.set_pixel_format(self._config.pixel_format)
            link.set_gain(self._config.gain)
            self._check_gain(link.gain)
        except NotInControlError as error:
            raise self._unavailable(str(error)) from error
        except LinkError as error:
            self.settings()  # the connection may be lost
            raise DeviceFaultError(
                f"it does not take a setting: {error}",
                where=self._where,
                remedy="Choose a pixel format and a gain that the camera has",
            ) from error

    def close(self) -> None:
        """Disconnect."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def report(self) -> DeviceReport:
        """Return what the camera reports about itself."""
        link = self._connected()
        try:
            details = {
                "pixel format": link.pixel_format,
                "exposure time": f"{link.exposure_s:g} s",
                "gain": f"{link.gain:g}",
                "images taken": str(self._taken),
            }
        except LinkError as error:
            raise self._unavailable(str(error)) from error
        return DeviceReport(identity=self._identity(), details=details)

    # --- settings ---------------------------------------------------------------------------------------------

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set the exposure time, and return what the camera then reports with what rig.yaml states.

        Raises DeviceRefusedError if the protocol wants another aperture, ISO, focus or file, or if the camera takes
        another exposure time.
        """
        stated = CameraSettings(self._config.aperture_f, settings.exposure_s, self._config.iso)
        differing = differences(settings, stated)
        if differing:
            raise DeviceRefusedError(
                f"the protocol wants {'; '.join(differing)}",
                where=self._where,
                remedy="Set the lens by hand and state it in rig.yaml, or change the protocol",
            )
        link = self._connected()
        try:
            link.set_exposure_s(settings.exposure_s)
        except LinkError as error:
            raise self._unavailable(str(error)) from error
        now = self.settings()
        if not agrees(now.exposure_s, settings.exposure_s):
            raise DeviceRefusedError(
                f"the camera exposes for {now.exposure_s:g} s instead of {settings.exposure_s:g} s",
                where=self._where,
                remedy="Choose an exposure time that the camera has",
            )
        return now

    def settings(self) -> CameraSettings:
        """Return the exposure time that the camera reports, with what rig.yaml states."""
        try:
            exposure_s = self._connected().exposure_s
        except LinkError as error:
            raise self._unavailable(str(error)) from error
        return CameraSettings(self._config.aperture_f, exposure_s, self._config.iso)

    # --- images -----------------------------------------------------------------------------------------------

    def capture(self, folder: Path) -> CapturedImage:
        """Take one image and write it into `folder` as JPEG of quality 100 without chroma subsampling.

        The file has no EXIF; `exif` has the settings and `exif_time` is empty.

        Raises:
            StaleImageError: the image equals an earlier one bit for bit; no sensor repeats its noise.
            UnreadableFileError: the image is of another format, or of another size than those before it.
            DeviceTimeoutError: no whole image in time. DeviceUnavailableError: the connection is lost.
        """
        settings = self.settings()
        triggered_s = time.monotonic()
        pixels = self._acquired(settings.exposure_s)
        arrived_s = time.monotonic()
        self._taken += 1
        file = self._files.write(self._taken, frame_jpeg(pixels, self._where), folder)
        size = int(pixels.shape[1]), int(pixels.shape[0])
        self._files.accept(file, size)
        return CapturedImage(
            files=(file,),
            counter=self._taken,
            exif_time="",
            exif=settings,
            lens=self._config.lens,
            focal_length_mm=self._config.focal_length_mm,
            trigger_monotonic_s=triggered_s,
            arrival_monotonic_s=arrived_s,
            width=size[0],
            height=size[1],
            body_serial=self._identity().serial,
        )

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Return no images after `timeout_s`: such a camera has no shutter button."""
        del folder, since_utc_s
        time.sleep(timeout_s)
        return ()

    def preview(self) -> bytes:
        """Take an image and return it as JPEG bytes."""
        return frame_jpeg(self._acquired(self.settings().exposure_s), self._where)

    def _acquired(self, exposure_s: float) -> NDArray[np.uint8]:
        try:
            frame = self._connected().acquire(exposure_s + self._config.frame_timeout_s)
        except NoImageError as error:
            raise DeviceTimeoutError(
                f"no whole image: {error}",
                where=self._where,
                remedy="Look at cable and network (packet size, no other traffic), then repeat the exposure",
            ) from error
        except LinkError as error:
            raise self._unavailable(str(error)) from error
        pixels = picture(frame, self._config.pixel_format)
        if pixels is None:
            raise UnreadableFileError(
                f"no whole image in {self._config.pixel_format} came: {frame.width} × {frame.height} px, "
                f"pixel format {frame.code:#010x}, {len(frame.data)} bytes",
                where=self._where,
                remedy="Repeat the exposure; if it comes again, close other programs that use the camera",
            )
        return pixels

    # --- the link ---------------------------------------------------------------------------------------------

    def _linked(self) -> CameraLink:
        if self._config.producer:
            return ProducerCamera(self._config.camera, Path(self._config.producer))
        return AravisCamera(self._config.camera)

    def _connected(self) -> CameraLink:
        if self._link is None:
            raise self._unavailable("It is not open")
        return self._link

    def _unavailable(self, what: str) -> DeviceUnavailableError:
        return DeviceUnavailableError(
            what,
            where=self._where,
            remedy="Close other programs that use it; check power, cable and name (arv-tool-0.8 or the maker's "
            "program lists cameras), then open it",
        )

    def _checked_identity(self, link: CameraLink) -> DeviceIdentity:
        try:
            serial, model = link.serial, f"{link.vendor} {link.model}"
        except LinkError as error:
            raise self._unavailable(f"It connects and then does not tell what it is: {error}") from error
        if self._config.serial not in ("", serial):
            raise DeviceFaultError(
                f"it has the serial number {serial}, not {self._config.serial}",
                where=self._where,
                remedy="State the camera's own serial number in rig.yaml, or connect the other camera",
            )
        return DeviceIdentity(
            kind="camera",
            model=model,
            serial=serial,
            firmware="",
            driver="genicam",
            driver_version=link.software,
            address=self._config.camera,
        )

    def _check_gain(self, gain: float) -> None:
        if abs(gain - self._config.gain) > TOLERANCE * max(1.0, abs(self._config.gain)):
            raise DeviceFaultError(
                f"it has the gain {gain:g} instead of {self._config.gain:g}",
                where=self._where,
                remedy="Choose a gain that the camera has",
            )

    def _identity(self) -> DeviceIdentity:
        if self._identified is None:
            raise self._unavailable("It is not open")
        return self._identified


DRIVER = DriverSpec(kind="camera", config=GenicamConfig, build=GenicamCamera, hosted=True, call_timeout_s=75.0)
