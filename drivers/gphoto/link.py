"""The connection to libgphoto2: version check, ports, error codes, single widgets, events, file descriptor 0."""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from drivers.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    DeviceStorageFullError,
    DeviceTimeoutError,
    DeviceUnavailableError,
)
from drivers.host.doing import doing as said
from drivers.interfaces import PtpProperty

gp: Any = importlib.import_module("gphoto2")  # no types; see docs/decisions/0002-strict-typing.md
Gphoto = Any  # a gphoto2.Camera
_LOG = logging.getLogger(__name__)
T = TypeVar("T")
BROKEN_VERSIONS = ("2.5.31",)
LEAST_VERSION = (2, 5, 32)  # an older one gives the Alpha 7R V no list of ISO values
OPEN_ATTEMPTS = 3
PTPIP_MODEL = "PTP/IP Camera"
_TO_CARD = "ptp2=capturetarget=card"  # as libgphoto2 writes it
_NUMBER = re.compile(r"-?\d+")
_REPORTED = re.compile(r'PTP Property [0-9a-f]{4} changed, "(?P<name>[^"]+)"')

_ERRORS: dict[int, tuple[type[DeviceError], str]] = {
    gp.GP_ERROR_CAMERA_BUSY: (DeviceBusyError, "Wait a moment and repeat"),
    gp.GP_ERROR_BAD_PARAMETERS: (DeviceRefusedError, "Choose a value that the camera offers in its present mode"),
    gp.GP_ERROR_NOT_SUPPORTED: (DeviceRefusedError, "Set the camera to PC Remote and the dial to M"),
    gp.GP_ERROR_TIMEOUT: (DeviceTimeoutError, "Check cable and power, then open the camera again"),
    gp.GP_ERROR_NO_SPACE: (DeviceStorageFullError, "Change or empty the memory card"),
    gp.GP_ERROR_IO_USB_CLAIM: (
        DeviceUnavailableError,
        "Another program holds the camera: end gvfs-gphoto2-volume-monitor or the photo import program",
    ),
    gp.GP_ERROR_MODEL_NOT_FOUND: (DeviceUnavailableError, "Switch the camera on and check the cable"),
}
NOT_STATED = "Turn the mode dial to M and look at the camera's display and menu; not every body has every setting"
_UNAVAILABLE = "Check cable and power, then open the camera again; re-plug it if that does not help"


def check_library_version(version: str) -> None:
    """Raise DeviceFaultError for a libgphoto2 that is known not to work with the Alpha 7R V, or is too old for it."""
    try:
        numbers = tuple(int(part) for part in version.split(".")[:3])
    except ValueError as error:
        raise DeviceFaultError(
            f"libgphoto2 reports the version {version!r}", where="libgphoto2", remedy="Install libgphoto2 2.5.34"
        ) from error
    if version in BROKEN_VERSIONS or numbers < LEAST_VERSION:
        raise DeviceFaultError(
            f"libgphoto2 {version} does not work with this camera",
            where="libgphoto2",
            remedy="Install libgphoto2 2.5.34 or later (the gphoto2 package from PyPI brings it along)",
        )


def library_version() -> str:
    """The version of the loaded libgphoto2, such as 2.5.34."""
    return str(gp.gp_library_version(gp.GP_VERSION_SHORT)[0])


def translate(error: Any, doing: str, where: str) -> DeviceError:
    """Return the DeviceError for a libgphoto2 error; the unspecific code −1 counts as a lost link."""
    kind, remedy = _ERRORS.get(int(error.code), (DeviceUnavailableError, _UNAVAILABLE))
    return kind(f"{doing} failed: {error.string} ({error.code})", where=where, remedy=remedy)


def keep_descriptor_zero() -> None:
    """Reopen file descriptor 0 on /dev/null if it is closed.

    libgphoto2 closes descriptor 0 whenever it exits a PTP/IP camera, whatever the descriptor is used for.
    """
    try:
        os.fstat(0)
    except OSError:
        null = os.open(os.devnull, os.O_RDONLY)
        if null != 0:
            os.dup2(null, 0)
            os.close(null)


@cache
def keep_own_settings() -> None:
    """Give libgphoto2 a settings file of this program, instead of the one that it shares with the user's others.

    It keeps where Canon and Nikon bodies put files, and the identity with which cameras on the network are paired.
    """
    home = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    own = Path(home) / "orthocapture"
    file = own / "gphoto" / "settings"
    try:
        lines = file.read_text(encoding="ascii").splitlines() if file.exists() else []
        if _TO_CARD not in lines:
            file.parent.mkdir(parents=True, exist_ok=True)
            kept = [line for line in lines if not line.startswith(_TO_CARD.rpartition("=")[0])]
            partial = file.with_name(f"settings.{os.getpid()}")
            partial.write_text("\n".join([*kept, _TO_CARD]) + "\n", encoding="ascii")
            partial.replace(file)
    except (OSError, UnicodeDecodeError) as error:
        _LOG.warning("libgphoto2 uses the settings of the user: %s", error)
        return
    os.environ["XDG_CONFIG_HOME"] = str(own)


@cache
def _library() -> ctypes.CDLL:
    """libgphoto2 itself, through the part of python-gphoto2 that was linked with it."""
    return ctypes.CDLL(str(importlib.import_module("gphoto2._widget").__file__))


def text_of(widget: Gphoto) -> str | None:
    """The value of a widget; None if the camera states none for it.

    python-gphoto2 ends the process with SIGSEGV where a widget of words has no value: a f-number without a lens.
    """
    if widget.get_type() not in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU, gp.GP_WIDGET_TEXT):
        return str(widget.get_value())
    value = ctypes.c_char_p()
    code = _library().gp_widget_get_value(ctypes.c_void_p(int(widget.this)), ctypes.byref(value))
    if code != gp.GP_OK:
        raise gp.GPhoto2Error(code)
    return None if value.value is None else value.value.decode(errors="replace")


@dataclass(frozen=True, slots=True)
class AddedFile:
    """A file that the camera announced."""

    folder: str
    name: str


class Link:
    """One libgphoto2 camera; its methods raise only DeviceError."""

    def __init__(self, port: str, model: str) -> None:
        self.where = f"camera at {port or 'USB'}"
        self._port = port
        self._model = model
        self._camera: Gphoto | None = None
        self.reported: set[str] = set()  # widgets whose values the camera itself has reported

    def open(self) -> None:
        """Connect, with back-off, because cameras need a moment after a lost session."""
        check_library_version(library_version())
        keep_own_settings()
        self.close()
        for attempt in range(1, OPEN_ATTEMPTS + 1):
            keep_descriptor_zero()
            try:
                camera = self._select()
                camera.init()
            except gp.GPhoto2Error as error:
                keep_descriptor_zero()
                if attempt == OPEN_ATTEMPTS:
                    raise translate(error, "Connecting", self.where) from error
                _LOG.warning("connecting to %s: %s; attempt %d", self.where, error, attempt)
                time.sleep(0.5 * attempt)
            else:
                self._camera = camera
                return

    def _select(self) -> Gphoto:
        camera = gp.Camera()
        if not self._port.startswith("ptpip:"):
            found = [(name, port) for name, port in gp.Camera.autodetect() if self._fits(name, port)]
            if len(found) != 1:
                names = ", ".join(f"{name} at {port}" for name, port in found) or "none"
                raise DeviceUnavailableError(
                    f"One camera on USB is needed, found: {names}",
                    where=self.where,
                    remedy="Switch the camera on (USB mode PC Remote), or give port or model in the rig file",
                )
            model, port = found[0]
        else:
            # Without the second port libgphoto2 opens its event connection on 15740, whatever the first port is.
            parts = self._port.split(":")
            port = f"{self._port}:{parts[2]}" if len(parts) == 3 else self._port
            model = PTPIP_MODEL
        ports = gp.PortInfoList()
        ports.load()
        camera.set_port_info(ports[ports.lookup_path(port)])
        abilities = gp.CameraAbilitiesList()
        abilities.load()
        camera.set_abilities(abilities[abilities.lookup_model(model)])
        return camera

    def _fits(self, name: str, port: str) -> bool:
        return (self._port in ("", "usb", "usb:") or port == self._port) and self._model in name

    def close(self) -> None:
        """Disconnect; an error is logged and not raised."""
        camera, self._camera = self._camera, None
        if camera is None:
            return
        try:
            camera.exit()
        except gp.GPhoto2Error as error:
            _LOG.warning("closing %s: %s", self.where, error)
        del camera
        keep_descriptor_zero()

    def call(self, doing: str, function: Callable[[Gphoto], T], *, optional: bool = False) -> T:
        """Run a function on the camera and translate its errors; `doing` says what it does, for messages.

        Raises DeviceRefusedError for what is optional and has crashed or stopped this driver twice.
        """
        if self._camera is None:
            raise DeviceUnavailableError("the camera is not open", where=self.where, remedy="Open it first")
        try:
            with said(doing, where=self.where, optional=optional):
                return function(self._camera)
        except gp.GPhoto2Error as error:
            raise translate(error, doing, self.where) from error

    def refresh(self, wait_ms: int = 1) -> list[AddedFile]:
        """Drain pending events, which also makes libgphoto2 reread all properties; returns the announced files."""
        added: list[AddedFile] = []
        while True:
            event, announced = self.next_event(wait_ms)
            if event == gp.GP_EVENT_TIMEOUT:
                return added
            added += announced

    def next_event(self, wait_ms: int) -> tuple[int, tuple[AddedFile, ...]]:
        """Wait for the next event of the camera; returns its type, or GP_EVENT_TIMEOUT, and the file it announces."""
        event, data = self.call("Waiting for the camera", lambda camera: camera.wait_for_event(wait_ms))
        if event == gp.GP_EVENT_UNKNOWN and (found := _REPORTED.match(str(data))):
            self.reported.add(found["name"])
        return event, (AddedFile(str(data.folder), str(data.name)),) if event == gp.GP_EVENT_FILE_ADDED else ()

    def names(self) -> frozenset[str]:
        """The names of all widgets that the camera has."""
        return self.call("Listing the settings", lambda camera: frozenset(str(n) for n, _ in camera.list_config()))

    def _widget(self, camera: Gphoto, name: str) -> Gphoto:
        """Read a setting. Where a Canon lacks it, libgphoto2 answers with nothing instead of an error."""
        missing = DeviceRefusedError(f"the camera has no setting {name}", where=self.where, remedy=NOT_STATED)
        try:
            widget = camera.get_single_config(name)
        except gp.GPhoto2Error as error:
            if int(error.code) != gp.GP_ERROR_BAD_PARAMETERS:
                raise
            raise missing from error
        if widget is None:
            raise missing
        return widget

    def value(self, name: str) -> str:
        """Return the value of one widget. Raises DeviceRefusedError if the camera has or states none."""
        word = self.call(
            f"Reading the setting {name}", lambda camera: text_of(self._widget(camera, name)), optional=True
        )
        if word is None:
            raise DeviceRefusedError(f"the camera states no {name}", where=self.where, remedy=NOT_STATED)
        return word

    def is_fixed(self, name: str) -> bool:
        """Return whether the camera says that this setting cannot be changed now."""
        doing = f"Reading whether {name} can be set"
        return self.call(doing, lambda camera: bool(self._widget(camera, name).get_readonly()), optional=True)

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that the camera currently offers for a widget; empty for free text and ranges."""

        def read(camera: Gphoto) -> tuple[str, ...]:
            widget = self._widget(camera, name)
            if widget.get_type() not in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
                return ()
            return tuple(str(choice) for choice in widget.get_choices())

        return self.call(f"Reading the choices of {name}", read, optional=True)

    def put(self, name: str, value: str) -> None:
        """Set a single widget, because libgphoto2 reports no refusal when the whole tree is sent."""

        def write(camera: Gphoto) -> None:
            widget = self._widget(camera, name)
            widget.set_value(value)
            camera.set_single_config(name, widget)

        self.call(f"Setting {name} to {value}", write)

    def summary(self) -> str:
        """Return what libgphoto2 prints of the body with all its properties."""
        return self.call("Listing all properties", lambda camera: str(camera.get_summary().text), optional=True)

    def unlisted(self, code: str) -> PtpProperty:
        """Read one property by its code, where the summary does not show it.

        Raises DeviceRefusedError if it has no value.
        """

        def read(camera: Gphoto) -> PtpProperty:
            widget = self._widget(camera, code)
            kind, word = widget.get_type(), text_of(widget) or ""
            access = "ro" if widget.get_readonly() else "rw"
            if kind == gp.GP_WIDGET_RANGE:
                low, high, step = (int(number) for number in widget.get_range())
                numbers = (low, high - (high in (1 << 32, 1 << 64)), step)  # a float holds one more than a u32 or u64
                return PtpProperty(
                    code=code, type="int", access=access, form="range", numbers=numbers, value=int(float(word))
                )
            listed = kind in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU)
            choices = [str(choice) for choice in widget.get_choices()] if listed else []
            if all(map(_NUMBER.fullmatch, (word, *choices))):
                return PtpProperty(
                    code=code,
                    type="int",
                    access=access,
                    form="enum" if listed else "none",
                    numbers=tuple(map(int, choices)),
                    value=int(word),
                )
            return PtpProperty(code=code, type="str", access=access, form="none", value=word)

        return self.call(f"Reading the property {code}", read, optional=True)

    def free_bytes(self) -> int | None:
        """Free space of the camera's storage in bytes; None if the camera lists none (usual in PC Remote mode)."""
        stores = self.call("Reading the free space", lambda camera: list(camera.get_storageinfo()), optional=True)
        known = [int(store.freekbytes) * 1024 for store in stores if store.fields & gp.GP_STORAGEINFO_FREESPACEKBYTES]
        return sum(known) if known else None
