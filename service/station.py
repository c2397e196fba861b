"""The composition root: opens the concrete drivers of a rig; no other module names them."""

from __future__ import annotations

import math
import os
import socket
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from pydantic import ValidationError

from drivers.errors import DeviceError, DeviceUnavailableError, SafetyStopError
from drivers.host.device_lock import DeviceLock
from drivers.host.hosted_device import Ending, hosted
from drivers.interfaces import (
    Abandoned,
    Camera,
    CtSource,
    Device,
    DeviceAnswers,
    DeviceReport,
    Lightbox,
    Payload,
    RobotArm,
    Scanner,
    Transform,
    answers_of,
)
from drivers.plugin import DriverConfig, DriverSpec
from drivers.recording import RecordedDevice
from drivers.recording.personal_data import Secrets, named
from service.core.checked_yaml import problem_of, refuse
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.loading import plug_ins
from service.core.records.import_list import ImportList
from service.rig import CollisionSection, FurtherCameraSection, LensSection, OpticsSection, Rig, RigDevice
from service.steps.context import ConnectionEnd, FurtherCamera, LeaveToMove, StationLayout

GROUP = "orthocapture.drivers"
INTERFACES: Mapping[str, type[Any]] = {
    "robot": RobotArm,
    "camera": Camera,
    "scanner": Scanner,
    "ct": CtSource,
    "lightbox": Lightbox,
}
_PATH_FIELDS = ("folder", "port", "path")
_PLACE_FIELDS = (*_PATH_FIELDS, "host", "camera")  # what they say is not for strangers
_ADDRESS_FIELDS = ("host", "port", "camera", "model")  # the first that a device has says which one it is
_ANY_PORT = ("usb", "usb:")
_ACTING = ("robot", "camera", "lightbox")

D = TypeVar("D", bound=Device)


@cache
def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in plug_ins(GROUP)}


class Station:
    """The devices of one rig, opened on first use and left open until `close`."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._open: dict[str, Device] = {}
        self._locks: dict[str, DeviceLock] = {}
        self._on_open: Callable[[str, DeviceReport], None] | None = None
        self._before_open: Callable[[str], None] | None = None
        self._leave: LeaveToMove | None = None
        self._ended: deque[ConnectionEnd] = deque()  # of arms; drivers add to it from any thread
        self._told: dict[str, int] = {}  # arm → seq of the last leave to move that it was given

    def names(self) -> tuple[str, ...]:
        """Return the names of the devices, in the order of the rig file."""
        return tuple(self.rig.section.devices)

    def device(self, name: str) -> Device:
        """Return the device of this name, opened if need be. Raises ConfigurationError or DeviceError."""
        if name not in self._open:
            device = self._build(name)
            try:
                self._lock(name)
                self._connect(name, device)
            except BaseException as error:
                self._unlock(name)
                self._refused(name, error)
                raise
            self._open[name] = device
        return self._open[name]

    def report(self, name: str) -> DeviceReport:
        """Return the report of a device, also of an arm that stands stopped and takes no payload.

        Raises ConfigurationError or DeviceError.
        """
        try:
            return self.device(name).report()
        except SafetyStopError:
            if name in self._open:
                raise
        device = self._build(name)
        self._lock(name)
        try:
            device.open()
            return device.report()
        finally:
            device.close()
            self._unlock(name)

    def heard(self, name: str) -> tuple[RecordedDevice, Secrets]:
        """Return all that a device says of itself, opened for this alone, and texts that must not leave with it.

        One that cannot be opened is given with the error and with what can be heard nevertheless. No arm's payload is
        set. Raises ConfigurationError if its section of the rig file is wrong.
        """
        spec, _ = self._spec(name)
        config = self._config(name, spec)
        device = self._build(name)
        report: DeviceReport | None = None
        error, answers = "", DeviceAnswers()
        try:
            self._lock(name)
            try:
                device.open()
                report = device.report()
            except DeviceError as refusal:
                error = _words_of(refusal)
            try:
                answers = answers_of(device)
            except DeviceError as refusal:
                answers = DeviceAnswers(silent=(_words_of(refusal),))
        except DeviceError as refusal:
            error = _words_of(refusal)
        finally:
            device.close()
            self._unlock(name)
        driver = str(self.rig.section.devices[name]["driver"])
        said = RecordedDevice(kind=spec.kind, driver=driver, report=report, error=error, answers=answers)
        return said, _secrets_of(config)

    def opened(self, kind: str) -> dict[str, Device]:
        """Return the open devices of a kind, by name."""
        # Copied first, because the reporter's thread calls this while devices are being opened.
        return {name: device for name, device in tuple(self._open.items()) if self.kind_of(name) == kind}

    def watch(self, on_open: Callable[[str, DeviceReport], None], before_open: Callable[[str], None]) -> None:
        """Call `before_open` with a device's name before it is opened, and `on_open` with name and report after."""
        self._on_open, self._before_open = on_open, before_open

    def _connect(self, name: str, device: Device) -> None:
        """Open a device and prepare it; it is closed again if that fails."""
        if self._before_open is not None:
            self._before_open(name)
        try:
            device.open()
            payload = self.rig.section.payload
            if self.kind_of(name) == "robot" and payload is not None:
                cast(RobotArm, device).configure(Payload(payload.mass_kg, payload.centre_of_gravity_m), np.eye(4))
            if self._on_open is not None:
                self._on_open(name, device.report())
        except BaseException:
            device.close()
            raise

    def close(self) -> None:
        """Close every device and release its lock."""
        for name, device in self._open.items():
            device.close()
            self._unlock(name)
        self._open.clear()

    # --- devices by role, for steps (service.steps.context.Devices) ---

    def robot(self, station: str) -> RobotArm:
        """Return the arm at a station, with the newest leave to move. Raises ConfigurationError or DeviceError."""
        name, leave = self.layout(station).robot, self._leave
        arm = cast(RobotArm, self.device(name))
        if leave is not None and self._told.get(name) != leave.seq:
            try:
                arm.let_move(leave.by, leave.not_before_monotonic_s)
            except DeviceUnavailableError:  # its link died before this leave was given
                self.reopen(arm)
                arm.let_move(leave.by, leave.not_before_monotonic_s)
            self._told[name] = leave.seq
        return arm

    def let_move(self, leave: LeaveToMove) -> None:
        """Give all arms leave to move; each gets it once, and reopening an arm does not renew it."""
        self._leave = leave

    def camera(self) -> Camera:
        """Return the rig's first camera. Raises ConfigurationError unless there is exactly one, DeviceError."""
        return cast(Camera, self.device(self._only("camera")))

    def camera_named(self, name: str) -> Camera:
        """Return a further camera by its name, or the first one for "". Raises ConfigurationError, DeviceError."""
        if not name:
            return self.camera()
        if name not in self.rig.section.cameras:
            raise ConfigurationError(
                f"the rig has no further camera {name!r}", where=str(self.rig.path), remedy="Correct `cameras`"
            )
        return self._further(name, self.rig.section.cameras[name]).camera

    def further_cameras(self) -> tuple[FurtherCamera, ...]:
        """Return the rig's further cameras.

        Raises ConfigurationError if one is not a calibrated camera; DeviceError.
        """
        return tuple(self._further(name, section) for name, section in self.rig.section.cameras.items())

    def _further(self, name: str, section: FurtherCameraSection) -> FurtherCamera:
        calibration, where = self.rig.folder / section.calibration, f"{self.rig.path}, camera {name}"
        if self.kind_of(name) != "camera":
            raise ConfigurationError(f"the device {name} is not a camera", where=where, remedy="Correct `cameras`")
        if not calibration.is_file():
            raise ConfigurationError(
                f"there is no file {calibration}",
                where=where,
                remedy="Calibrate this camera: orthocapture calibrate intrinsics … --out camera.json",
            )
        return FurtherCamera(name, cast(Camera, self.device(name)), section, calibration)

    def scanner(self, name: str | None = None) -> Scanner:
        """Return the scanner of this name, or the rig's only one. Raises ConfigurationError or DeviceError."""
        return cast(Scanner, self.device(name or self._only("scanner")))

    def ct(self) -> CtSource:
        """Return the rig's only CT source. Raises ConfigurationError unless there is exactly one, DeviceError."""
        return cast(CtSource, self.device(self._only("ct")))

    def lightbox(self) -> Lightbox | None:
        """Return the rig's light box, or None. Raises DeviceError."""
        names = self._of_kind("lightbox")
        return cast(Lightbox, self.device(names[0])) if names else None

    def layout(self, station: str) -> StationLayout:
        """Return the layout of a station in the rig file. Raises ConfigurationError if there is no such station."""
        return layout_of(self.rig, station)

    def nominal_T_flange_camera(self) -> Transform:
        """Return T_flange_camera (4, 4) in metres from the mount's drawing. Raises ConfigurationError without one."""
        return self.rig.nominal_T_flange_camera()

    def surroundings(self) -> tuple[CollisionSection, OpticsSection | None]:
        """Return the arm's surroundings and the lens's optics in the rig file."""
        return self.rig.section.collision, self.rig.section.optics

    def lens(self) -> LensSection | None:
        """Return focal length and sensor in the rig file, or None."""
        return self.rig.section.lens

    def imported(self) -> ImportList | None:
        """Return the file list of an import, or None for a run that captures."""
        return self.rig.section.imported

    def reopen(self, device: Device) -> None:
        """Close and open a device again after its link dropped. Raises DeviceError."""
        name = next(name for name, known in self._open.items() if known is device)
        del self._open[name]  # if reopening fails, the next caller starts from scratch
        device.close()
        try:
            self._connect(name, device)
        except BaseException as error:
            self._unlock(name)
            self._refused(name, error)
            raise
        self._open[name] = device

    def hold_arms(self) -> None:
        """Stop and close every open arm, which gets a leave once only; a dead link delays none of this."""
        for name in self.opened("robot"):
            arm = cast(RobotArm, self._open.pop(name))
            with suppress(OrthocaptureError):
                arm.stop()
            arm.close()
            self._unlock(name)

    def ended_connections(self) -> tuple[ConnectionEnd, ...]:
        """Return the connections to arms that have ended since the last call, in order."""
        ended: list[ConnectionEnd] = []
        while self._ended:
            ended.append(self._ended.popleft())
        return tuple(ended)

    def _lost(self, name: str, how: Ending, error: DeviceError) -> None:
        self._ended.append(ConnectionEnd(name, how, type(error).__name__, str(error)))

    def _refused(self, name: str, error: BaseException) -> None:
        """Remember that an arm could not be connected, or not be prepared."""
        if self.kind_of(name) == "robot" and isinstance(error, OrthocaptureError):
            self._ended.append(ConnectionEnd(name, "refused", type(error).__name__, str(error)))

    def _lock(self, name: str) -> None:
        """Lock a device that acts for this process; folders may be read by several processes."""
        spec, _ = self._spec(name)
        settings = self._config(name, spec).model_dump()
        named = {field: str(settings.get(field) or "") for field in _ADDRESS_FIELDS}
        where = next(
            (_one_name(field, value) for field, value in named.items() if value and value not in _ANY_PORT), ""
        )
        if spec.kind in _ACTING:
            self._locks[name] = DeviceLock.take(f"{self.rig.section.devices[name]['driver']} {where}".strip(), name)

    def _unlock(self, name: str) -> None:
        lock = self._locks.pop(name, None)
        if lock is not None:
            lock.release()

    # --- building ---

    def kind_of(self, name: str) -> str:
        """Return the kind of a device: robot, camera, scanner, ct or lightbox."""
        return self._spec(name)[0].kind

    def abandoned(self, name: str) -> Abandoned | None:
        """Return what becomes of a motion of this device whose program died, by its section of the rig file."""
        return self._config(name, self._spec(name)[0]).abandoned

    def _of_kind(self, kind: str) -> list[str]:
        return [name for name in self.names() if self.kind_of(name) == kind]

    def _only(self, kind: str) -> str:
        names = [name for name in self._of_kind(kind) if name not in self.rig.section.cameras]
        if len(names) != 1:
            raise ConfigurationError(
                f"this step needs exactly one {kind}, the rig has {len(names)}", where=str(self.rig.path)
            )
        return names[0]

    def _spec(self, name: str) -> tuple[DriverSpec, str]:
        settings = self.rig.section.devices.get(name)
        where = f"{self.rig.path}, device {name}"
        if settings is None:
            raise ConfigurationError(
                f"the rig has no device {name!r}",
                where=str(self.rig.path),
                remedy=f"Devices: {', '.join(self.names()) or 'none'}",
            )
        driver = settings.get("driver")
        points = _installed()
        if not isinstance(driver, str) or driver not in points:
            raise ConfigurationError(
                f"no driver {driver!r} is installed", where=where, remedy=f"Installed: {', '.join(sorted(points))}"
            )
        return cast(DriverSpec, points[driver].load()), points[driver].value

    def _build(self, name: str) -> Device:
        spec, spec_path = self._spec(name)
        config = self._config(name, spec)
        if spec.hosted:
            interface = INTERFACES[spec.kind]
            times = {
                "call_timeout_s": max(spec.call_timeout_s, config.longest_call_s),
                "reading_timeout_s": spec.reading_timeout_s,
            }
            proxy = partial(hosted, interface, spec_path, config, name=name, **times)
            return cast(Device, proxy(on_end=partial(self._lost, name)) if spec.kind == "robot" else proxy())
        return spec.build(config)

    def _config(self, name: str, spec: DriverSpec) -> DriverConfig:
        settings = {key: value for key, value in self.rig.section.devices[name].items() if key != "driver"}
        for field in _PATH_FIELDS:
            value = settings.get(field)
            if isinstance(value, str) and ":" not in value:  # not for addresses such as ptpip:… or socket://…
                settings[field] = str(self.rig.folder / value)
        try:
            return spec.config.model_validate(settings)
        except ValidationError as error:
            tree, at = self.rig.tree, ("devices", name)
            problems = [problem_of(details, tree, spec.config, at) for details in error.errors()]
            remedy = "Compare it with the example in docs/howto/your_hardware.md"
            refuse(problems, what="rig file", name=str(self.rig.path), remedy=remedy, error=ConfigurationError)


def _secrets_of(config: DriverConfig) -> Secrets:
    """Return what a device's section of the rig file says of the site, and the names of files where it exports."""
    settings = {field: str(value) for field, value in config.model_dump().items() if isinstance(value, str | Path)}
    addresses = [value for field, value in settings.items() if field in _PLACE_FIELDS]
    folder = Path(settings["folder"]) if settings.get("folder") else None
    files = [] if folder is None or not folder.is_dir() else [path.name for path in folder.rglob("*")]
    return {
        **named(files, "file"),
        **named(addresses, "address"),
        **named([settings.get("serial", "")], "serial number"),
    }


def _words_of(error: DeviceError) -> str:
    """Return what is wrong and what to do, without where: that names a place of this site."""
    return f"{error.what}. {error.remedy}" if error.remedy else error.what


def _one_name(field: str, address: str) -> str:
    """Return a device's address in one format, however it was written: a link's port, a host's IP address."""
    if field == "port":
        return address if ":" in address else os.path.realpath(address)
    if field != "host":
        return address
    try:
        return socket.gethostbyname(address)
    except OSError:  # to open it will fail, with an error that says so
        return address


def devices_of(rig: Rig) -> dict[str, RigDevice]:
    """Return what the drivers say of each device in a rig file, by name.

    Raises ConfigurationError if a driver is not installed, or refuses its section.
    """
    station = Station(rig)
    return {name: RigDevice(station.kind_of(name), station.abandoned(name)) for name in station.names()}


def layout_of(rig: Rig, station: str) -> StationLayout:
    """Return the layout of a station in a rig file. Raises ConfigurationError if there is no such station."""
    section = rig.section.stations.get(station)
    if section is None:
        known = ", ".join(rig.section.stations) or "none"
        raise ConfigurationError(
            f"the rig has no station {station!r}", where=str(rig.path), remedy=f"Stations: {known}"
        )
    azimuth = math.radians(section.approach_azimuth_deg)
    approach = (math.cos(azimuth), math.sin(azimuth), 0.0)
    obstacles = tuple(section.obstacles.items())
    driver = rig.section.devices.get(section.robot, {}).get("driver")
    is_arm = _is_arm(driver)
    abandoned = Station(rig).abandoned(section.robot) if is_arm and driver in _installed() else None
    return StationLayout(
        station, section.robot, section.scene_centre_m, approach, obstacles, is_arm=is_arm, abandoned=abandoned
    )


def _is_arm(driver: object) -> bool:
    """Return whether a driver is of an arm, not of other axes; true for a missing one, which opening reports."""
    point = _installed().get(driver) if isinstance(driver, str) else None
    return point is None or cast(DriverSpec, point.load()).is_arm
