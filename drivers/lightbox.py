r"""Serial driver of the light and environment box: light, temperature, shutter relay, foot pedal, signal tower.

Wire: 115200 baud, 8 data bits, no parity, one stop bit, ASCII lines. The host ends its lines with LF; the box ends
its own with LF or CR LF. Each request has one reply, which begins with the name of the quantity, so that a banner, a
late reply or noise is recognised and skipped. Lines that begin with # are comments (the banner).

    *IDN?        *IDN <maker>,<model>,<serial>,<firmware>
    LIGHT?       LIGHT <lux>                 decimal number, lux at the specimen
    TEMP?        TEMP <degrees Celsius>      decimal number
    SHUTTER?     SHUTTER <0|1>               1: relay closed
    SHUTTER 0|1  SHUTTER <0|1>               the state after switching
    PEDAL?       PEDAL <count> <last> <now>  presses since power-up; milliseconds since power-up of the last press (0
                                             before the first) and of this reply; before firmware 1.4 the count alone
    TOWER OFF|GREEN|YELLOW|RED   TOWER <light that is on>   one light of the signal tower; boxes before firmware 1.3
                                                            have none and answer ERR 1
    other        ERR <code> <text>           1 unknown request, 2 wrong argument, 3 sensor fault, 4 wrong checksum

From firmware 1.4 each reply ends with `*` and its checksum: CRC-16/XMODEM of all that precedes the `*`, in four
digits to base 16. A digit is the character 0x30 + its value (0 to 9, then : ; < = > ?) rather than hexadecimal,
so that a bit of the checksum is a bit of the line. So no error of up to three bits passes (P. Koopman and
T. Chakravarty, "Cyclic redundancy code (CRC) polynomial selection for embedded networks", 2004: a distance of 4 for
lines of this length), and what noise made of a number is not believed. A request may end so too; with a wrong
checksum it is refused with ERR 4.
"""

from __future__ import annotations

import binascii
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
from drivers.interfaces import (
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
    EnvironmentReading,
    Exchange,
    PedalReading,
    TowerLight,
)
from drivers.plugin import DriverConfig, DriverSpec
from service.core.units import seconds_of_ms

_LINK_ERRORS = (serial.SerialException, OSError, termios.error)
_ATTEMPTS = 3
_MAX_LINE = 256
_SEND_AGAIN = ""  # no reply has this value
_PEDAL_READINGS = 6  # until two in a row agree; a press may fall between two


_LIGHTS = tuple(light.value for light in TowerLight)


class _NotUnderstoodError(DeviceRefusedError):
    """The box does not know the request or its argument."""


class _UnknownRequestError(_NotUnderstoodError):
    """The box's firmware is too old to know the request."""


_REFUSALS: dict[str, type[DeviceRefusedError]] = {"1": _UnknownRequestError, "2": _NotUnderstoodError}


class LightboxConfig(DriverConfig):
    """The light box's section in rig.yaml."""

    port: str = Field(min_length=1, description="serial device, link to one, or socket://HOST:PORT")
    baudrate: int = Field(default=115200, gt=0)  # of the serial line
    timeout_s: float = Field(default=1.0, gt=0, description="longest wait for a reply; three attempts")


class SerialLightbox:
    """drivers.interfaces.Lightbox over pyserial. After the link broke, the next call reopens the port.

    Another box that answers there then is no longer read until `open`, which tells of it.
    """

    def __init__(self, config: LightboxConfig) -> None:
        self._config = config
        self._port: serial.Serial | None = None
        self._pending = b""
        self._has_tower = True  # until the box refuses the request
        self._checks = False  # whether this box ends its lines with a checksum
        self._serial = ""  # of the box that was opened

    def open(self) -> DeviceIdentity:
        """Open the port and return the box's identity; skips unsolicited lines such as the banner."""
        self.close()
        self._has_tower, self._checks, self._serial = True, False, ""
        identity = self._identity()
        self._serial = identity.serial
        return identity

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
                number = self._ask(f"{request}?", request).partition(" ")[0]  # of the pedal, the count alone
            except DeviceRefusedError as error:
                problems.append(str(error))
            else:
                details[request.lower()] = f"{number} {unit}".strip()
        return DeviceReport(identity=identity, details=details, problems=tuple(problems))

    def answers(self) -> DeviceAnswers:
        """Ask for everything that it measures and is; nothing is switched."""
        exchanges: list[Exchange] = []
        silent: list[str] = []
        for question in ("*IDN?", "LIGHT?", "TEMP?", "SHUTTER?", "PEDAL?"):
            try:
                exchanges.append(Exchange(question=question, answer=self._ask(question, question[:-1])))
            except (DeviceRefusedError, DeviceTimeoutError) as error:
                silent.append(f"{question}: {error.what}")
        return DeviceAnswers(exchanges=tuple(exchanges), silent=tuple(silent))

    def read(self) -> EnvironmentReading:
        """Return the light level in lux, the temperature in °C and the state of the shutter relay."""
        return EnvironmentReading(
            light_lux=self._number("LIGHT"),
            temperature_c=self._number("TEMP"),
            shutter_relay_closed=self._number("SHUTTER") == 1,
            monotonic_s=time.monotonic(),
        )

    def pedal(self) -> PedalReading:
        """Return the foot pedal's count, as two readings in a row agree on it.

        Raises DeviceFaultError if no two do: what comes over the line is noise.
        """
        last: PedalReading | None = None
        for _ in range(_PEDAL_READINGS):
            count, *times = map(int, self._ask("PEDAL?", "PEDAL").split(" "))
            reading = PedalReading(count, *(seconds_of_ms(time_ms) for time_ms in times))
            if last is not None and (last.presses, last.pressed_s) == (reading.presses, reading.pressed_s):
                return reading
            last = reading
        raise DeviceFaultError(
            f"the foot pedal's count differs in each of {_PEDAL_READINGS} readings",
            where=self._config.port,
            remedy="Check the cable of the light box and of its pedal: the line is disturbed",
        )

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
        if len(fields) == 4 and not self._checks and _checks_lines(fields[3]):
            raise DeviceFaultError(
                f"its identity {','.join(fields)!r} comes without the checksum of its firmware",
                where=self._config.port,
                remedy="Check the cable of the light box: the line is disturbed",
            )
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
        refused: DeviceRefusedError | None = None
        try:
            port = self._open_port()
            for _ in range(_ATTEMPTS):
                # The buffer can hold a banner or the reply to an earlier request.
                port.reset_input_buffer()
                self._pending = b""
                port.write((with_checksum(request) if self._checks else request).encode("ascii") + b"\n")
                deadline = time.monotonic() + self._config.timeout_s
                while (line := self._line(port, deadline)) is not None:
                    heard = line or heard
                    try:
                        value = self._value(line, request, name)
                    except _NotUnderstoodError as error:
                        if not self._checks:
                            raise
                        refused, value = error, _SEND_AGAIN  # its checksum may have been what was disturbed
                    if value == _SEND_AGAIN:
                        break
                    if value is not None:
                        return value
        except _LINK_ERRORS as error:
            self.close()
            raise DeviceUnavailableError(
                f"the light box is not connected ({error})",
                where=self._config.port,
                remedy="Check the cable and the power of the box; it is opened again at the next request",
            ) from error
        if refused is not None:
            raise refused
        detail = f"; it said {heard[:40]!r}" if heard else ""
        raise DeviceTimeoutError(
            f"no usable reply to {request} in {_ATTEMPTS} × {self._config.timeout_s:g} s{detail}",
            where=self._config.port,
            remedy="Check that the box is powered, that the baud rate is right, and that the port is the box's",
        )

    def _open_port(self) -> serial.Serial:
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
            if self._serial:
                self._require_same()
        return self._port

    def _require_same(self) -> None:
        """Close the port again if another box answers than the one that was opened. Raises DeviceUnavailableError."""
        found = self._identity().serial
        if found != self._serial:
            self.close()
            raise DeviceUnavailableError(
                f"another light box answers: it has the serial number {found}, not {self._serial}",
                where=self._config.port,
                remedy="Open it again",
            )

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
        """Return the value if this line is the expected reply, None if another may follow, or _SEND_AGAIN.

        Raises DeviceRefusedError for ERR.
        """
        if not line.isascii():
            return None
        text = line.decode("ascii")
        bare = without_checksum(text)
        if bare is None and self._checks:
            return None if text.startswith("#") else _SEND_AGAIN  # disturbed on its way here
        self._checks = bare is not None
        word, _, value = (text if bare is None else bare).partition(" ")
        if word == "ERR":
            if value.startswith("4"):
                return _SEND_AGAIN  # disturbed on its way there
            refusal = _REFUSALS.get(value.split(" ")[0], DeviceRefusedError)
            raise refusal(
                f"the light box refuses {request}: {value}",
                where=self._config.port,
                remedy="See the box's manual for the error; check its sensors",
            )
        return value if word == name and value.isprintable() and _usable(name, value) else None


def with_checksum(line: str) -> str:
    """Return a line with its checksum, as boxes from firmware 1.4 send and take it."""
    checksum = binascii.crc_hqx(line.encode("ascii"), 0)
    return f"{line}*{''.join(chr(0x30 + (checksum >> shift & 15)) for shift in (12, 8, 4, 0))}"


def without_checksum(line: str) -> str | None:
    """Return a line without its checksum; None if it has none, or a wrong one."""
    bare = line[:-5]
    return bare if line == with_checksum(bare) else None


def _checks_lines(firmware: str) -> bool:
    """Return whether boxes of this firmware end their lines with a checksum."""
    numbers = firmware.split(".")
    return len(numbers) == 2 and all(n.isdecimal() for n in numbers) and tuple(map(int, numbers)) >= (1, 4)


def _usable(name: str, value: str) -> bool:
    """Return whether a reply's value is valid for the quantity `name`."""
    match name:
        case "*IDN":
            return True
        case "TOWER":
            return value in _LIGHTS
        case "SHUTTER":
            return value.isdecimal()
        case "PEDAL":
            numbers = value.split(" ")
            return len(numbers) in (1, 3) and all(number.isdecimal() and len(number) < 16 for number in numbers)
        case _:
            try:
                return math.isfinite(float(value))
            except ValueError:
                return False


def _build(config: LightboxConfig) -> SerialLightbox:
    return SerialLightbox(config)


DRIVER = DriverSpec(kind="lightbox", config=LightboxConfig, build=_build, hosted=False, call_timeout_s=30.0)
