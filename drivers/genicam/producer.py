"""GenICam cameras by harvesters, which loads a maker's GenTL producer (a file .cti). Needs the extra `genicam`."""

from __future__ import annotations

import importlib
import logging
import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from drivers.genicam.link import Frame, LibraryMissingError, LinkError, NoImageError
from service.core.units import seconds_of_us, us

_LOG = logging.getLogger(__name__)
_POLL_MS = 20  # one wait of harvesters for an image
_NAMED_BY = ("id_", "serial_number", "user_defined_name", "display_name")
# By the Standard Features Naming Convention, and as older cameras have them.
_SERIAL, _EXPOSURE, _GAIN = (
    ("DeviceSerialNumber", "DeviceID"),
    ("ExposureTime", "ExposureTimeAbs"),
    ("Gain", "GainRaw"),
)
_SINGLE = "SingleFrame"


class ProducerCamera:
    """A camera that a GenTL producer has found; drivers.genicam.link.CameraLink."""

    def __init__(self, name: str, producer: Path) -> None:
        """Connect to the camera with this serial number, user-defined name, or id in the producer's list.

        Raises LibraryMissingError or LinkError.
        """
        try:
            core: Any = importlib.import_module("harvesters.core")
            errors: list[Any] = [
                importlib.import_module(f"genicam.{part}").GenericException for part in ("gentl", "genapi")
            ]
        except ImportError as error:
            raise LibraryMissingError("harvesters", 'pip install "orthocapture[genicam]"') from error
        self._errors: tuple[type[Exception], ...] = (*errors, AttributeError, ValueError)
        self._producer = producer
        self._acquirer: Any = None
        self._harvester: Any = core.Harvester()
        try:
            self._connect(name)
        except LinkError:
            self.close()
            raise

    def _connect(self, name: str) -> None:
        try:
            self._harvester.add_file(str(self._producer), check_existence=True, check_validity=True)
        except FileNotFoundError as error:
            raise LinkError(f"there is no GenTL producer {self._producer}") from error
        except OSError as error:
            raise LinkError(f"the GenTL producer cannot be loaded: {error}") from error
        with self._told(), _own_signals():
            self._harvester.update()
            listed = [
                {key: info.property_dict.get(key) or "" for key in _NAMED_BY}
                for info in self._harvester.device_info_list
            ]
            found = [index for index, names in enumerate(listed) if name in names.values()]
            if len(found) != 1:
                there = ", ".join(f"{names['id_']} ({names['serial_number']})" for names in listed) or "none"
                raise LinkError(f"the producer lists {len(found)} cameras with this name; there are: {there}")
            self._acquirer = self._harvester.create(found[0])
            self._acquirer.num_buffers = max(1, self._acquirer.min_num_buffers)
            self._acquirer.timeout_period_on_client_fetch_call = 1.0
            self._acquirer.timeout_period_on_update_event_data_call = _POLL_MS

    def close(self) -> None:
        """Disconnect, and unload the producer."""
        for release in (*([self._acquirer.destroy] if self._acquirer is not None else []), self._harvester.reset):
            try:
                release()
            except self._errors:
                _LOG.warning("the producer does not let go of the camera", exc_info=True)
        self._acquirer = None

    @property
    def software(self) -> str:
        """Versions of harvesters and of the binding, and the producer's file."""
        return f"harvesters {version('harvesters')}, genicam {version('genicam')}, {self._producer.name}"

    @property
    def vendor(self) -> str:
        """Name of the camera's maker."""
        return str(self._value("DeviceVendorName"))

    @property
    def model(self) -> str:
        """Name of the model."""
        return str(self._value("DeviceModelName"))

    @property
    def serial(self) -> str:
        """Serial number."""
        return str(self._value(*_SERIAL))

    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        return str(self._value("PixelFormat"))

    @property
    def exposure_s(self) -> float:
        """Exposure time that the camera reports."""
        return seconds_of_us(float(self._value(*_EXPOSURE)))

    @property
    def gain(self) -> float:
        """Gain that the camera reports, in its own unit, usually dB."""
        return float(self._value(*_GAIN))

    def set_exposure_s(self, exposure_s: float) -> None:
        """Set the exposure time; the camera may round it."""
        self._set_number(us(exposure_s), *_EXPOSURE)

    def set_gain(self, gain: float) -> None:
        """Set the gain, in the camera's own unit."""
        self._set_number(gain, *_GAIN)

    def set_pixel_format(self, name: str) -> None:
        """Set the pixel format by its GenICam name, such as BayerRG8."""
        with self._told():
            self._feature("PixelFormat").value = name

    def acquire(self, timeout_s: float) -> Frame:
        """Expose and receive one image. Raises NoImageError or LinkError."""
        acquirer = self._connected()
        with self._told():
            mode = self._feature("AcquisitionMode")
            if _SINGLE in mode.symbolics and mode.value != _SINGLE:
                mode.value = _SINGLE  # a camera without it exposes on, and the first image is the one
            acquirer.start()
            try:
                buffer = acquirer.try_fetch(timeout=timeout_s)
                if buffer is None:
                    raise NoImageError("no whole image came")
                try:
                    return _frame(buffer)
                finally:
                    buffer.queue()
            finally:
                acquirer.stop()

    def _value(self, *names: str) -> Any:
        with self._told():
            return self._feature(*names).value

    def _set_number(self, value: float, *names: str) -> None:
        """Set a real or whole number, within the camera's limits."""
        with self._told():
            feature = self._feature(*names)
            within = min(feature.max, max(feature.min, value))
            feature.value = type(feature.value)(within)

    def _feature(self, *names: str) -> Any:
        """The first of these features that the camera has. Raises LinkError."""
        nodes = self._connected().remote_device.node_map
        for name in names:
            feature = getattr(nodes, name, None)
            if feature is not None:
                return feature
        raise LinkError(f"the camera has no {' or '.join(names)}")

    def _connected(self) -> Any:
        if self._acquirer is None:
            raise LinkError("the camera is not connected")
        return self._acquirer

    @contextmanager
    def _told(self) -> Generator[None]:
        """Errors of the libraries become LinkError."""
        try:
            yield
        except self._errors as error:
            raise LinkError(str(error) or type(error).__name__) from error


def _frame(buffer: Any) -> Frame:
    """The image of a buffer, copied. Raises NoImageError if it has none."""
    parts = getattr(buffer.payload, "components", ())
    if not parts:
        raise NoImageError("something other than an image came")
    part = parts[0]
    return Frame(
        number=int(buffer.module.frame_id),
        width=int(part.width),
        height=int(part.height),
        code=int(part.data_format_value),
        data=part.data.tobytes(),
    )


@contextmanager
def _own_signals() -> Generator[None]:
    """Take back SIGINT, for which harvesters installs a handler of its own in the main thread."""
    main = threading.current_thread() is threading.main_thread()
    before: Callable[..., Any] | int | None = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if main:
            signal.signal(signal.SIGINT, before)
