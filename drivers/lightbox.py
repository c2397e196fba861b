r"""Serial driver of the light and environment box: light, temperature, shutter relay, foot pedal, signal tower.

Wire: 115200 baud, 8 data bits, no parity, one stop bit, ASCII lines. The host ends its lines with LF; the box ends
its own with LF or CR LF. Each request has one reply, which begins with the name of the quantity, so that a banner, a
late reply or noise is recognised and skipped. Lines that begin with # are comments (the banner).

    *IDN?        *IDN <maker>,<model>,<serial>,<firmware>
    LIGHT?       LIGHT <lux>                 decimal number, lux at the specimen
    TEMP?        TEMP <degrees Celsius>      decimal number
    SHUTTER?     SHUTTER <0|1>               1: relay closed
    SHUTTER 0|1  SHUTTER <0|1>               the state after switching
    PEDAL?       PEDAL <count>               presses since power-up
    TOWER OFF|GREEN|YELLOW|RED   TOWER <light that is on>   one light of the signal tower; boxes before firmware 1.3
                                                            have none and answer ERR 1
    other        ERR <code> <text>           1 unknown request, 2 wrong argument, 3 sensor fault
"""

from __future__ import annotations

import math
import termios
import time
from importlib.metadata import version

import serial
from pydantic import Field

from drivers.errors import (
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
)
from drivers.interfaces import DeviceIdentity, DeviceReport, EnvironmentReading, TowerLight
from drivers.plugin import DriverConfig, DriverSpec

_LINK_ERRORS = (serial.SerialException, OSError, termios.error)
_ATTEMPTS = 3
_MAX_LINE = 256


_LIGHTS = tuple(light.value for light in TowerLight)


class _UnknownRequestError(DeviceRefusedError):
    """The box's firmware is too old to know the request."""


class LightboxConfig(DriverConfig):
    """The light box's section in rig.yaml."""

    port: str = Field(min_length=1, description="serial device, link to one, or socket://HOST:PORT")
    baudrate: int = Field(default=115200, gt=0)  # of the serial line
    timeout_s: float = Field(default=1.0, gt=0, description="longest wait for a reply; three attempts")


class SerialLightbox:
    """drivers.interfaces.Lightbox over pyserial. After the link broke, the next call reopens the port."""

    def __init__(self, config: LightboxConfig) -> None:
        self._config = config
        self._port: serial.Serial | None = None
        self._pending = b""
        self._has_tower = True  # until the box refuses the request

    def open(self) -> DeviceIdentity:
        """Open the port and return the box's identity; skips unsolicited lines such as the banner."""
        self.close()
        self._has_tower = True
        return self._identity()

    def close(self) -> None:
        """Close the port; does not raise if the link is dead."""
        port, self._port, self._pending = self._port, None, b""
        if port is not None:
            try:
                port.close()
            except _LINK_ERRORS:
                return  # the link is already dead

    def report(self) -> DeviceReport:
        """Return the identity and the current readings; a sensor fault is listed as a problem and not raised."""
        identity = self._identity()
        details: dict[str, str] = {}
        problems: list[str] = []
        for request, unit in (("LIGHT", "lx"), ("TEMP", "°C"), ("SHUTTER", ""), ("PEDAL", "")):
            try:
                details[request.lower()] = f"{self._ask(f'{request}?', request)} {unit}".strip()
            except DeviceRefusedError as error:
                problems.append(str(error))
        return DeviceReport(identity=identity, details=details, problems=tuple(problems))

    def read(self) -> EnvironmentReading:
        """Return the light level in lux, the temperature in °C and the state of the shutter relay."""
        return EnvironmentReading(
            light_lux=self._number("LIGHT"),
            temperature_c=self._number("TEMP"),
            shutter_relay_closed=self._number("SHUTTER") == 1,
            monotonic_s=time.monotonic(),
        )

    def pedal_presses(self) -> int:
        """Return the number of pedal presses since the box was powered up."""
        return int(self._number("PEDAL"))

    def show_tower(self, light: TowerLight) -> bool:
        """Switch on one light of the signal tower, or none.

        Returns False if the box has no tower; raises DeviceFaultError if it shows another light than requested.
        """
        if not self._has_tower:
            return False
        try:
            lit = self._ask(f"TOWER {light.value}", "TOWER")
        except _UnknownRequestError:
            self._has_tower = False
            return False
        if lit != light.value:
            raise DeviceFaultError(
                f"the signal tower did not switch: it shows {lit}",
                where=self._config.port,
                remedy="Check the tower and its supply",
            )
        return True

    def _identity(self) -> DeviceIdentity:
        fields = [field.strip() for field in self._ask("*IDN?", "*IDN").split(",")]
        if len(fields) != 4:
            raise DeviceFaultError(
                f"this is not a light box: it identifies itself as {','.join(fields)!r}",
                where=self._config.port,
                remedy="Check which device is on this port",
            )
        return DeviceIdentity(
            kind="lightbox",
            model=f"{fields[0]} {fields[1]}",
            serial=fields[2],
            firmware=fields[3],
            driver="lightbox",
            driver_version=f"pyserial {version('pyserial')}",
            address=self._config.port,
        )

    def _number(self, quantity: str) -> float:
        return float(self._ask(f"{quantity}?", quantity))

    def _ask(self, request: str, name: str) -> str:
        """Send a request and return the value of the reply named `name`; retries if no usable reply comes in time."""
        heard = b""
        try:
            port = self._opened()
            for _ in range(_ATTEMPTS):
                # The buffer can hold a banner or the reply to an earlier request.
                port.reset_input_buffer()
                self._pending = b""
                port.write(request.encode("ascii") + b"\n")
                deadline = time.monotonic() + self._config.timeout_s
                while (line := self._line(port, deadline)) is not None:
                    heard = line or heard
                    value = self._value(line, request, name)
                    if value is not None:
                        return value
        except _LINK_ERRORS as error:
            self.close()
            raise DeviceUnavailableError(
                f"the light box is not connected ({error})",
                where=self._config.port,
                remedy="Check the cable and the power of the box; it is opened again at the next request",
            ) from error
        detail = f"; it said {heard[:40]!r}" if heard else ""
        raise DeviceTimeoutError(
            f"no usable reply to {request} in {_ATTEMPTS} × {self._config.timeout_s:g} s{detail}",
            where=self._config.port,
            remedy="Check that the box is powered, that the baud rate is right, and that the port is the box's",
        )

    def _opened(self) -> serial.Serial:
        if self._port is None:
            try:
                port = serial.serial_for_url(self._config.port, baudrate=self._config.baudrate, timeout=0.05)
            except ValueError as error:
                raise DeviceUnavailableError(
                    f"the port cannot be opened ({error})",
                    where=self._config.port,
                    remedy="Correct the port in rig.yaml",
                ) from error
            port.write_timeout = self._config.timeout_s
            self._port = port
        return self._port

    def _line(self, port: serial.Serial, deadline_s: float) -> bytes | None:
        """The next complete line without its line end; None at the deadline."""
        while b"\n" not in self._pending:
            if time.monotonic() >= deadline_s:
                return None
            self._pending += port.read(max(1, min(port.in_waiting, _MAX_LINE)))
            # Replies are short: do not let noise without line ends accumulate.
            if b"\n" not in self._pending:
                self._pending = self._pending[-_MAX_LINE:]
        line, self._pending = self._pending.split(b"\n", 1)
        return line.strip()

    def _value(self, line: bytes, request: str, name: str) -> str | None:
        """The value if this line is the expected reply, otherwise None. Raises DeviceRefusedError for ERR."""
        if not line.isascii():
            return None
        word, _, value = line.decode("ascii").partition(" ")
        if word == "ERR":
            refusal = _UnknownRequestError if value.split(" ")[0] == "1" else DeviceRefusedError
            raise refusal(
                f"the light box refuses {request}: {value}",
                where=self._config.port,
                remedy="See the box's manual for the error; check its sensors",
            )
        return value if word == name and value.isprintable() and _usable(name, value) else None


def _usable(name: str, value: str) -> bool:
    """Whether a reply's value is valid for the quantity `name`."""
    match name:
        case "*IDN":
            return True
        case "TOWER":
            return value in _LIGHTS
        case "SHUTTER" | "PEDAL":
            return value.isdigit()
        case _:
            try:
                return math.isfinite(float(value))
            except ValueError:
                return False


def _build(config: LightboxConfig) -> SerialLightbox:
    return SerialLightbox(config)


DRIVER = DriverSpec(kind="lightbox", config=LightboxConfig, build=_build, hosted=False, call_timeout_s=30.0)
