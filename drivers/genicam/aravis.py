"""The calls of Aravis (libaravis 0.8) that the driver needs: GenICam over GigE Vision and USB3 Vision.

Aravis is called by ctypes: the library comes with the operating system, and its Python package would have to be
compiled. Every call that can fail raises LinkError.
"""

from __future__ import annotations

import ctypes
import ctypes.util
from contextlib import ExitStack
from typing import Any

from drivers.genicam.link import Frame, LibraryMissingError, LinkError, NoImageError, NotInControlError
from service.core.units import seconds_of_us, us

LIBRARIES = ("aravis-0.8", "gobject-2.0", "glib-2.0")
_SUCCESS = 0  # of ArvBufferStatus
# Of the same: nothing of an image is in the buffer. Where a process may open packet sockets (as root), Aravis reads
# one that sees all traffic of the machine until its filter is set; a foreign packet ends the wait for the image.
_NOTHING_IN_IT = (1, 8)
_TRIES = 5  # exposures
_MOST_REQUESTS = 2.0  # for packets again, as a multiple of the packets of an image; Aravis takes no more
_SINGLE_FRAME = 1  # of ArvAcquisitionMode
_DENIED = "access-denied"  # GigE Vision's answer to who is not in control; what it lacks it calls otherwise
_NO_CONTROL = "the camera takes no settings from here: another program controls it, or the connection was lost"
_POINTER, _TEXT, _REAL = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_double


class _Error(ctypes.Structure):
    """GError."""

    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", _TEXT))


class AravisCamera:
    """A connected camera; drivers.genicam.link.CameraLink."""

    def __init__(self, name: str) -> None:
        """Connect to a camera by IP address or by the name that `arv-tool-0.8` lists.

        Raises LibraryMissingError or LinkError.
        """
        self._aravis, self._gobject, self._glib = (_library(name) for name in LIBRARIES)
        self._camera: int | None = self._call("arv_camera_new", _POINTER, name.encode(), of=(_TEXT,))
        if not self._controls():
            self.close()
            raise NotInControlError(_NO_CONTROL)

    def close(self) -> None:
        """Disconnect."""
        camera, self._camera = self._camera, None
        if camera is not None:
            self._unref(camera)

    def _controls(self) -> bool:
        """Say whether the camera takes settings from here: with GigE Vision one program controls, others read."""
        device, is_controller = (
            getattr(self._aravis, f"arv_{name}") for name in ("camera_get_device", "gv_device_is_controller")
        )
        for function, gives in ((device, _POINTER), (is_controller, ctypes.c_int)):
            function.restype, function.argtypes = gives, (_POINTER,)
        return not self._is_network() or bool(is_controller(device(self._camera)))

    def _is_network(self) -> bool:
        """Return whether it is a camera of GigE Vision, whose images come in packets."""
        is_network = self._aravis.arv_camera_is_gv_device
        is_network.restype, is_network.argtypes = ctypes.c_int, (_POINTER,)
        return bool(is_network(self._camera))

    @property
    def software(self) -> str:
        """Name and version of the library."""
        return f"Aravis {version()}"

    @property
    def vendor(self) -> str:
        """Name of the camera's maker."""
        return self._text("vendor_name")

    @property
    def model(self) -> str:
        """Name of the model."""
        return self._text("model_name")

    @property
    def serial(self) -> str:
        """Serial number."""
        return self._text("device_serial_number")

    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        return self._text("pixel_format_as_string")

    @property
    def exposure_s(self) -> float:
        """Exposure time that the camera reports."""
        return seconds_of_us(float(self._of_camera("arv_camera_get_exposure_time", _REAL)))

    @property
    def gain(self) -> float:
        """Gain that the camera reports, in its own unit, usually dB."""
        return float(self._of_camera("arv_camera_get_gain", _REAL))

    def set_exposure_s(self, exposure_s: float) -> None:
        """Set the exposure time; the camera may round it."""
        self._of_camera("arv_camera_set_exposure_time", None, us(exposure_s), of=(_REAL,))

    def set_gain(self, gain: float) -> None:
        """Set the gain, in the camera's own unit."""
        self._of_camera("arv_camera_set_gain", None, gain, of=(_REAL,))

    def set_pixel_format(self, name: str) -> None:
        """Set the pixel format by its GenICam name, such as BayerRG8."""
        self._of_camera("arv_camera_set_pixel_format_from_string", None, name.encode(), of=(_TEXT,))

    def acquire(self, timeout_s: float) -> Frame:
        """Expose and receive one image; if foreign traffic was taken for it, expose again.

        Raises NoImageError or LinkError.
        """
        for _ in range(_TRIES):
            frame = self._acquired(timeout_s)
            if frame is not None:
                return frame
        raise NoImageError("other traffic of this machine is taken for images")

    def _acquired(self, timeout_s: float) -> Frame | None:
        """One image; None if there is nothing of an image in the buffer."""
        with ExitStack() as until_the_end:
            stream = self._of_camera("arv_camera_create_stream", _POINTER, None, None, of=(_POINTER, _POINTER))
            until_the_end.callback(self._unref, stream)
            if self._is_network():
                self._wait_for_packets(stream, timeout_s / 2)
            self._give_buffer(stream)
            self._of_camera("arv_camera_set_acquisition_mode", None, _SINGLE_FRAME, of=(ctypes.c_int,))
            self._of_camera("arv_camera_start_acquisition", None)
            pop = self._aravis.arv_stream_timeout_pop_buffer
            pop.restype, pop.argtypes = _POINTER, (_POINTER, ctypes.c_uint64)
            buffer = pop(stream, round(us(timeout_s)))
            if buffer:
                until_the_end.callback(self._unref, buffer)
            self._of_camera("arv_camera_stop_acquisition", None)
            if not buffer:
                raise NoImageError("no image came")
            status = self._of_buffer(buffer, "status", ctypes.c_int)
            if status in _NOTHING_IN_IT:
                return None
            if status != _SUCCESS:
                raise NoImageError(f"an image is incomplete (Aravis' status {status})")
            return self._frame(buffer)

    def _wait_for_packets(self, stream: int, longest_s: float) -> None:
        """Let an image be whole that much later than its last packet, after which it counts as incomplete.

        By itself Aravis gives up after 0.1 s, measured when its own thread is run, and asks for no more than a
        quarter of an image's packets again, repeated requests included: on a busy machine an image was called
        incomplete whose packets lay in the socket, or had found it full, or were asked for again too often.
        """
        set_property = self._gobject.g_object_set
        set_property.restype, set_property.argtypes = None, (_POINTER, _TEXT)  # and what a property takes, and NULL
        set_property(stream, b"frame-retention", ctypes.c_uint(round(us(longest_s))), ctypes.c_void_p(None))
        set_property(stream, b"packet-request-ratio", ctypes.c_double(_MOST_REQUESTS), ctypes.c_void_p(None))

    def _give_buffer(self, stream: int) -> None:
        """Give the stream, which then owns it, a buffer for one image."""
        size = int(self._of_camera("arv_camera_get_payload", ctypes.c_uint))
        allocate, push = self._aravis.arv_buffer_new_allocate, self._aravis.arv_stream_push_buffer
        allocate.restype, allocate.argtypes = _POINTER, (ctypes.c_size_t,)
        push.restype, push.argtypes = None, (_POINTER, _POINTER)
        push(stream, allocate(size))

    def _text(self, what: str) -> str:
        """The text that `arv_camera_get_…` gives."""
        value = self._of_camera(f"arv_camera_get_{what}", _TEXT)
        return value.decode("utf-8", "replace") if value else ""

    def _frame(self, buffer: int) -> Frame:
        size = ctypes.c_size_t()
        read = self._aravis.arv_buffer_get_data
        read.restype, read.argtypes = _POINTER, (_POINTER, ctypes.POINTER(ctypes.c_size_t))
        place = read(buffer, ctypes.byref(size))
        return Frame(
            number=self._of_buffer(buffer, "frame_id", ctypes.c_uint64),
            width=self._of_buffer(buffer, "image_width", ctypes.c_int),
            height=self._of_buffer(buffer, "image_height", ctypes.c_int),
            code=self._of_buffer(buffer, "image_pixel_format", ctypes.c_uint32),
            data=ctypes.string_at(place, size.value),
        )

    def _of_buffer(self, buffer: int, what: str, gives: Any) -> int:
        function = getattr(self._aravis, f"arv_buffer_get_{what}")
        function.restype, function.argtypes = gives, (_POINTER,)
        return int(function(buffer))

    def _of_camera(self, name: str, gives: Any, *arguments: Any, of: tuple[Any, ...] = ()) -> Any:
        if self._camera is None:
            raise LinkError("the camera is not connected")
        return self._call(name, gives, self._camera, *arguments, of=(_POINTER, *of))

    def _call(self, name: str, gives: Any, *arguments: Any, of: tuple[Any, ...]) -> Any:
        """Call a function whose last argument is a GError."""
        function = getattr(self._aravis, name)
        function.restype, function.argtypes = gives, (*of, ctypes.POINTER(ctypes.POINTER(_Error)))
        error = ctypes.POINTER(_Error)()
        value = function(*arguments, ctypes.byref(error))
        if error:
            message = (error.contents.message or b"").decode("utf-8", "replace")
            free = self._glib.g_error_free
            free.restype, free.argtypes = None, (ctypes.POINTER(_Error),)
            free(error)
            raise NotInControlError(_NO_CONTROL) if _DENIED in message else LinkError(message)
        return value

    def _unref(self, thing: int) -> None:
        release = self._gobject.g_object_unref
        release.restype, release.argtypes = None, (_POINTER,)
        release(thing)


def version() -> str:
    """The library's version. Raises LibraryMissingError."""
    library = _library(LIBRARIES[0])
    return ".".join(str(getattr(library, f"arv_get_{part}_version")()) for part in ("major", "minor", "micro"))


def _library(name: str) -> ctypes.CDLL:
    found = ctypes.util.find_library(name)
    try:
        return ctypes.CDLL(found or f"lib{name}.so.0")
    except OSError as error:
        raise LibraryMissingError(f"lib{name}", "apt-get install libaravis-0.8-0") from error
