"""Driver for whatever OpenCV's VideoCapture opens: a webcam or microscope, a named pipe, a recording.

A source that delivers JPEG (most USB cameras, MJPEG streams and recordings) gives its images byte for byte; others
are decoded and written as JPEG of quality 100 without chroma subsampling. A video source cannot be asked for its
aperture, exposure time and ISO: rig.yaml states what a person has set, and a protocol that wants something else is
refused.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.errors import (
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    UnreadableFileError,
)
from drivers.interfaces import CameraSettings, CapturedFile, CapturedImage, DeviceIdentity, DeviceReport
from drivers.photos.frames import FrameFiles, frame_jpeg
from drivers.plugin import DriverConfig, DriverSpec
from drivers.stated_settings import differences

_LOG = logging.getLogger(__name__)
_MJPEG = cv2.VideoWriter.fourcc(*"MJPG")
_CLOSE_TIMEOUT_S = 2.0
_CALL_S = 60.0  # usual longest call; opening a pipe waits for its writer


class VideoConfig(DriverConfig):
    """A video source in rig.yaml, with the settings that the source cannot report."""

    port: str = Field(min_length=1, description="a device such as /dev/video0, a named pipe, or a recording")
    aperture_f: float = Field(gt=0, description="as it is set or built in")
    exposure_s: float = Field(gt=0, description="as it is set, with automatic exposure off")
    iso: int = Field(default=100, gt=0, description="100 if the device has no such scale")
    width: int = Field(default=0, ge=0, description="px, asked of a device; 0: its own choice")
    height: int = Field(default=0, ge=0, description="px, asked of a device; 0: its own choice")
    latency_s: float = Field(
        default=0.5, ge=0, le=5, description="longest time from the end of an exposure until its image arrives"
    )
    frame_timeout_s: float = Field(default=5.0, gt=0, le=30, description="longest wait for an image")
    model: str = ""  # of the device, for the record
    serial: str = ""  # of the device, for the record
    lens: str = ""  # for the record
    focal_length_mm: float = Field(default=0.0, ge=0, description="for the record; 0: not known")

    @property
    def stated(self) -> CameraSettings:
        """Return what the device is set to, as a person states it."""
        return CameraSettings(self.aperture_f, self.exposure_s, self.iso)


@dataclass(frozen=True, slots=True)
class _Frame:
    """One image of the source: a JPEG file (1, N), or decoded BGR pixels (H, W, 3); uint8."""

    number: int  # of the images received since the driver was made
    arrival_s: float  # time.monotonic()
    pixels: NDArray[np.uint8]

    def jpeg(self, where: str) -> bytes:
        """The image as a file. Raises UnreadableFileError if it cannot be encoded."""
        if self.pixels.shape[0] == 1:
            return self.pixels.tobytes()
        return frame_jpeg(self.pixels, where)


class VideoCamera:
    """drivers.interfaces.Camera on a video source. Its calls may block, so drivers.host gives it its own process.

    Devices and pipes are read all the time, by a thread, so that no image waits in a buffer; `capture` takes the
    first one whose exposure began after the call. A recording is read on demand: each `capture` takes the next image.
    """

    def __init__(self, config: VideoConfig) -> None:
        self._config = config
        self._where = f"video source {config.port}"
        self._source: cv2.VideoCapture | None = None
        self._reader: threading.Thread | None = None
        self._stop = threading.Event()
        self._arrived = threading.Condition()
        self._newest: _Frame | None = None
        self._ended = False
        self._unused: _Frame | None = None  # of a recording: read ahead for a preview
        self._received = 0
        self._files = FrameFiles("source", self._where)

    # --- every device -----------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Open or reopen the source; a recording starts again at its first image.

        Raises DeviceUnavailableError if the source cannot be opened, DeviceFaultError if it refuses the wanted size.
        """
        self.close()
        if self._reader is not None:
            raise self._unavailable("The last connection still waits for an image")
        source = self._open_source()
        self._prepare(source)
        self._source, self._newest, self._unused, self._ended = source, None, None, False
        self._files.reopened()
        self._stop.clear()
        if not self._is_recording():
            self._reader = threading.Thread(target=self._read_on, args=(source,), name="video", daemon=True)
            self._reader.start()
        return self._identity()

    def close(self) -> None:
        """Release the source. A thread that waits for a silent pipe is left to end with this process."""
        self._stop.set()
        if self._reader is not None:
            self._reader.join(_CLOSE_TIMEOUT_S)
            if self._reader.is_alive():
                _LOG.warning("%s still waits for an image", self._where)
                return  # to release the source while it is being read would crash
            self._reader = None
        source, self._source = self._source, None
        if source is not None:
            source.release()

    def report(self) -> DeviceReport:
        """Return how images come and how many did; a source that has gone silent is a problem."""
        source = self._connected()
        newest = self._newest
        silent_s = 0.0 if newest is None else time.monotonic() - newest.arrival_s
        problems: tuple[str, ...] = ()
        if self._ended:
            problems = ("The source has ended: open it again",)
        elif self._reader is not None and silent_s > self._config.frame_timeout_s:
            problems = (f"No image for {silent_s:.0f} s: look at cable and program of the source",)
        return DeviceReport(
            identity=self._identity(),
            details={
                "images": "the source's own JPEG files" if _sends_jpeg(source) else "decoded, written as JPEG",
                "received": str(self._received),
                "settings": "as rig.yaml states them",
            },
            problems=problems,
        )

    # --- settings ---------------------------------------------------------------------------------------------

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Return the stated settings. Raises DeviceRefusedError if the wanted ones differ."""
        stated = self._config.stated
        differing = differences(settings, stated)
        if differing:
            raise DeviceRefusedError(
                f"the protocol wants {'; '.join(differing)}, and software cannot set this source",
                where=self._where,
                remedy="Set the device with its own program, then state it in rig.yaml; or change the protocol",
            )
        return stated

    def settings(self) -> CameraSettings:
        """Return the settings that rig.yaml states: the source cannot be asked."""
        return self._config.stated

    # --- images -----------------------------------------------------------------------------------------------

    def capture(self, folder: Path) -> CapturedImage:
        """Write the first image whose exposure began after this call, or a recording's next one, into `folder`.

        The file has no EXIF unless the source wrote it; `exif` has the stated settings and `exif_time` is empty.

        Raises:
            StaleImageError: the image equals an earlier one bit for bit; no sensor repeats its noise.
            UnreadableFileError: the image is damaged, or of another size than those before it.
            DeviceTimeoutError: no image in time. DeviceUnavailableError: the source ended.
            DeviceRefusedError: the recording has no more images.
        """
        called_s = time.monotonic()
        # What arrives earlier than this may have been exposed before the call.
        delay_s = self._config.latency_s + self._config.exposure_s
        frame = self._next() if self._is_recording() else self._live_after(called_s + delay_s)
        file, size = self._written(frame, folder)
        self._files.accept(file, size)
        return CapturedImage(
            files=(file,),
            counter=frame.number,
            exif_time="",
            exif=self._config.stated,
            lens=self._config.lens,
            focal_length_mm=self._config.focal_length_mm,
            trigger_monotonic_s=called_s if self._is_recording() else frame.arrival_s - delay_s,
            arrival_monotonic_s=frame.arrival_s,
            width=size[0],
            height=size[1],
            body_serial=self._config.serial,
        )

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Return no images after `timeout_s`: a video source has no shutter button."""
        del folder, since_utc_s
        time.sleep(timeout_s)
        return ()

    def preview(self) -> bytes:
        """Return the newest image as JPEG bytes, of a recording the one that `capture` takes next."""
        if self._is_recording():
            self._unused = self._next()
            return self._unused.jpeg(self._where)
        return self._live_after(0.0).jpeg(self._where)

    # --- the source -------------------------------------------------------------------------------------------

    def _is_recording(self) -> bool:
        return Path(self._config.port).is_file()

    def _open_source(self) -> cv2.VideoCapture:
        path = Path(self._config.port)
        if not path.exists():
            raise self._unavailable("There is no such device or file")
        # FFmpeg would look at five seconds of a stream before it delivers its first image.
        os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "analyzeduration;200000|probesize;5000000")
        with self._written_to(path) if path.is_fifo() else nullcontext():
            source = cv2.VideoCapture(str(path), cv2.CAP_V4L2 if path.is_char_device() else cv2.CAP_FFMPEG)
        if not source.isOpened():
            raise self._unavailable("OpenCV cannot open it: it is busy, or of a format that OpenCV does not know")
        return source

    @contextmanager
    def _written_to(self, pipe: Path) -> Generator[None]:
        """Wait until somebody writes into a pipe, for which OpenCV would wait for ever; hold it open meanwhile."""
        descriptor = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
        try:
            if not select.select([descriptor], [], [], self._config.frame_timeout_s)[0]:
                raise self._unavailable("Nobody writes into this pipe")
            yield
        finally:
            os.close(descriptor)

    def _prepare(self, source: cv2.VideoCapture) -> None:
        """Ask for JPEG files instead of pixels, and for the wanted size."""
        if Path(self._config.port).is_char_device():
            source.set(cv2.CAP_PROP_FOURCC, _MJPEG)
            if self._config.width and self._config.height:
                source.set(cv2.CAP_PROP_FRAME_WIDTH, self._config.width)
                source.set(cv2.CAP_PROP_FRAME_HEIGHT, self._config.height)
            source.set(cv2.CAP_PROP_CONVERT_RGB, 0 if _sends_jpeg(source) else 1)
        elif _sends_jpeg(source):
            source.set(cv2.CAP_PROP_FORMAT, -1)  # packets of the stream, which are the files
        wanted = (self._config.width, self._config.height)
        offered = (round(source.get(cv2.CAP_PROP_FRAME_WIDTH)), round(source.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if all(wanted) and wanted != offered:
            source.release()
            raise DeviceFaultError(
                f"it delivers {offered[0]} × {offered[1]} px instead of {wanted[0]} × {wanted[1]}",
                where=self._where,
                remedy="Choose a size that the device has, or leave width and height out of rig.yaml",
            )

    def _read_on(self, source: cv2.VideoCapture) -> None:
        """Keep the newest image, until the source ends or is closed."""
        while not self._stop.is_set():
            frame = self._read(source)
            with self._arrived:
                self._newest, self._ended = frame or self._newest, frame is None
                self._arrived.notify_all()
            if frame is None:
                return

    def _read(self, source: cv2.VideoCapture) -> _Frame | None:
        done, pixels = source.read()
        if not done:
            return None
        self._received += 1
        return _Frame(self._received, time.monotonic(), np.asarray(pixels, dtype=np.uint8))

    def _live_after(self, earliest_s: float) -> _Frame:
        """Wait for the first image that arrives after `earliest_s` on the host's monotonic clock."""
        self._connected()
        deadline_s = max(earliest_s, time.monotonic()) + self._config.frame_timeout_s
        with self._arrived:
            while self._newest is None or self._newest.arrival_s < earliest_s:
                if self._ended:
                    raise self._unavailable("It has ended")
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    raise DeviceTimeoutError(
                        f"no image for {self._config.frame_timeout_s:g} s",
                        where=self._where,
                        remedy="Look at cable and program of the source, then repeat the exposure",
                    )
                self._arrived.wait(left_s)
            return self._newest

    def _next(self) -> _Frame:
        source = self._connected()
        frame, self._unused = self._unused or self._read(source), None
        if frame is None:
            raise DeviceRefusedError(
                f"the recording has no more images after {self._received}",
                where=self._where,
                remedy="Use a longer recording: each exposure takes one image",
            )
        return frame

    # --- files ------------------------------------------------------------------------------------------------

    def _written(self, frame: _Frame, folder: Path) -> tuple[CapturedFile, tuple[int, int]]:
        """Write an image; returns its file and its size (width, height) in px."""
        data = frame.jpeg(self._where)
        file = self._files.write(frame.number, data, folder)
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if picture is None:  # pyright: ignore[reportUnnecessaryComparison] - wrong in OpenCV's types
            file.path.unlink()
            raise UnreadableFileError(
                "the image cannot be decoded", where=str(file.path), remedy="Repeat the exposure"
            )
        return file, (int(picture.shape[1]), int(picture.shape[0]))

    def _connected(self) -> cv2.VideoCapture:
        if self._source is None:
            raise self._unavailable("It is not open")
        return self._source

    def _unavailable(self, what: str) -> DeviceUnavailableError:
        return DeviceUnavailableError(
            what, where=self._where, remedy="Check cable, path and the program that writes, then open it again"
        )

    def _identity(self) -> DeviceIdentity:
        return DeviceIdentity(
            kind="camera",
            model=self._config.model or "video source",
            serial=self._config.serial,
            firmware="",
            driver="video",
            driver_version=f"OpenCV {cv2.__version__}",
            address=self._config.port,
        )


def _sends_jpeg(source: cv2.VideoCapture) -> bool:
    return int(source.get(cv2.CAP_PROP_FOURCC)) == _MJPEG


DRIVER = DriverSpec(kind="camera", config=VideoConfig, build=VideoCamera, hosted=True, call_timeout_s=_CALL_S)
