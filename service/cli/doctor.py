"""`orthocapture doctor`: open every device of a rig, report its state and problems, and record what it said."""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
import socket
from collections import Counter
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from drivers.errors import DeviceError
from drivers.interfaces import DeviceIdentity, DeviceReport
from drivers.recording import RecordedDevice, Recording, readable
from drivers.recording.personal_data import named, without_personal_data
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    error_record,
    print_json,
    progress_bar,
    protocol_file,
    reporting_errors,
)
from service.cli.ending import ExitStatus
from service.cli.run import RigOption
from service.core.disk_space import Forecast, Usage, forecast
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.protocol import Protocol, load_protocol
from service.core.recorded_devices import DEVICE_LIMIT_S, HOST_LIMIT_S, clock_offset_words
from service.core.records.run_events import HostClock
from service.core.units import gigabytes
from service.monitor.reporter import host_clock
from service.rig import Rig, load_rig
from service.run_start import signature_copy
from service.station import Station
from service.steps import params_models
from service.store.data_folder import object_store_of, why_unsafe
from service.store.database.opening import has_database
from service.store.disk_space import forecast_of
from service.store.durable_effects import Clock, DurableFiles, SystemClock
from service.store.objects.opening import ProbeResult, open_objects, probe
from service.store.objects.spool import SpoolLevel, spool_level
from service.store.signatures.second_place import SecondPlace
from service.store.store import Store

# Optional libraries, which lack wheels for some Pythons and machines, and what is not possible without them.
_PARTS = {
    "rtde_control": "ur-rtde: arms of Universal Robots cannot be driven",
    "pycolmap": "pycolmap: camera poses cannot be found from images alone",
    "embreex": "embreex: rigs cannot be simulated, depth cannot be computed",
}
_LOW_DISK_BYTES = 20e9  # roughly a full capture of RAW and JPEG with its scans


def doctor_command(
    rig: RigOption,
    data: DataOption = DEFAULT_DATA,
    protocol: Annotated[
        Path | None, typer.Option("--protocol", help="Check that the disk has room for a run of this protocol.")
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record", metavar="FILE", help="Write what every device says into a file, without personal data."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Open every device of a rig; report versions, clock offsets, free space and problems."""
    with reporting_errors(json):
        rig_file = load_rig(rig)
        loaded = None if protocol is None else load_protocol(protocol_file(protocol), params_models()).protocol
        station = Station(rig_file)
        found = _reports(station, quiet=json)
        if record is not None:
            record_devices(station, record, SystemClock(), quiet=json)
        existing = next(folder for folder in (data.resolve(), *data.resolve().parents) if folder.exists())
        free_bytes = shutil.disk_usage(existing).free
        unsafe = why_unsafe(existing)
        place = _second_place(rig_file, data)
        objects = _object_store(data)
        spool = _spool(data)
        space = None if loaded is None else _foresee(data, loaded, free_bytes, simulated=rig_file.section.simulated)
    healthy = all(isinstance(r, DeviceReport) and not r.problems for r in found.values())
    healthy = healthy and not any(tried.problem for tried in objects)
    healthy = healthy and not unsafe and (space is None or space.verdict == "enough") and not place.get("problem")
    clock = host_clock()
    missing = [what for module, what in _PARTS.items() if importlib.util.find_spec(module) is None]
    if json:
        devices = {name: _record(report) for name, report in found.items()}
        folder: dict[str, Any] = {"folder": str(data), "free_bytes": free_bytes, "unsafe": unsafe or None}
        if space is not None:
            folder["forecast"] = dataclasses.asdict(space) | {"verdict": space.verdict, "words": space.words}
        found_clock = clock.model_dump()
        print_json(
            {
                "ok": healthy,
                "devices": devices,
                "data": folder,
                "host_clock": found_clock,
                "missing": missing,
                "second_place": place or None,
                "spool": None if spool is None else dataclasses.asdict(spool),
                "object_store": {tried.name: tried.problem or "ok" for tried in objects} or None,
            }
        )
    else:
        for what in missing:
            console.tell(("!", "bold yellow"), f" not installed: {what} (see docs/howto/installation.md)")
        for name, report in found.items():
            _print(name, report)
        _print_machine(data, free_bytes, space, clock)
        if unsafe:
            console.tell(("!", "bold red"), f" the data folder is {unsafe} (docs/howto/operating.md, One server)")
        if place:
            console.print(
                f"second place of the signatures {place['path']}: {place['problem'] or 'up to date'}", markup=False
            )
        for tried in objects:
            mark = ("!", "bold red") if tried.problem else ("✓", "bold green")
            console.tell(mark, f" object store: {tried.name}", f": {tried.problem}" if tried.problem else "")
        if spool is not None:
            console.print(f"object store: {spool.sentence}", markup=False)
    if not healthy:
        raise typer.Exit(ExitStatus.FAILED)


def _object_store(data: Path) -> list[ProbeResult]:
    """Probe the object store that the site's file names; nothing without one."""
    section = object_store_of(data)
    if section is None:
        return []
    clock = SystemClock()
    return probe(open_objects(data, section, clock), clock, lock_days=section.lock_days)


def _spool(data: Path) -> SpoolLevel | None:
    """Return what waits for the object store; None without one, or before anything was recorded."""
    if object_store_of(data) is None or not has_database(data):
        return None
    with Store.open(data, create=False) as store:
        return spool_level(store)


def _reports(station: Station, *, quiet: bool) -> dict[str, DeviceReport | OrthocaptureError]:
    """Open every device of a rig: its report, or the error that opening it raised. Closes them all."""
    found: dict[str, DeviceReport | OrthocaptureError] = {}
    try:
        with progress_bar(quiet=quiet) as progress:
            for i, name in enumerate(station.names()):
                progress(f"opening {name}", i, len(station.names()))
                try:
                    found[name] = station.report(name)
                except (DeviceError, ConfigurationError) as error:
                    found[name] = error
    finally:
        station.close()
    return found


def _second_place(rig: Rig, data: Path) -> dict[str, str]:
    """Return the path of the second place of the signatures and what is wrong with it; nothing if the rig names none.

    What is missing there is written.
    """
    copy = signature_copy(rig)
    if copy is None:
        return {}
    away = SecondPlace.of(data, copy, SystemClock(), DurableFiles()).update()
    return {"path": str(copy), "problem": "" if away is None else away.why}


def _print_machine(data: Path, free_bytes: int, space: Forecast | None, clock: HostClock) -> None:
    note = "" if free_bytes > _LOW_DISK_BYTES else "  little for a full capture"
    console.tell(("data folder", "bold"), f" {data}: {gigabytes(free_bytes):.1f} GB free", (note, "yellow"))
    console.tell(("this machine's clock", "bold"), f" {_clock_words(clock)}")
    if space is not None:
        colour = {"enough": "green", "short": "yellow", "stop": "red"}[space.verdict]
        console.tell("    ", (space.words, colour))


def _clock_words(clock: HostClock) -> str:
    if clock.offset_s is not None:
        beyond = f", more than {HOST_LIMIT_S:g} s" if abs(clock.offset_s) > HOST_LIMIT_S else ""
        return f"{clock.offset_s:+.6f} s against the network's time (chrony){beyond}"
    if clock.synchronised:
        error = "" if clock.error_s is None else f", within {clock.error_s:.3f} s as it states itself"
        return f"is set by the network's time{error}"
    return "is not known to be set" if clock.synchronised is None else "is not set by the network's time"


def _offset_words(offset_s: float, clock: Literal["utc", "uptime"], *, late: bool) -> str:
    if clock == "uptime":
        return (
            f"its clock counts from when it was switched on, {offset_s:+.3f} s from this machine's count: that is "
            "normal, only a change during a run matters"
        )
    words = f"clock {clock_offset_words(offset_s, clock)}"
    if not late:
        return words
    return (
        f"{words}, more than {DEVICE_LIMIT_S:g} s: set it before a run, or the times in its files will be "
        "wrong by as much"
    )


def _foresee(data: Path, protocol: Protocol, free_bytes: int, *, simulated: bool) -> Forecast:
    if not has_database(data):
        return forecast(protocol, None, Usage(), None, free_bytes, simulated=simulated)
    with Store.open(data, create=False) as store:
        return forecast_of(store, protocol, simulated=simulated)


def _record(report: DeviceReport | OrthocaptureError) -> dict[str, Any]:
    if isinstance(report, OrthocaptureError):
        return {"ok": False, "error": error_record(report)}
    return {"ok": not report.problems, **dataclasses.asdict(report)}


def _identity_words(who: DeviceIdentity) -> str:
    """Return model, serial number and firmware, as far as the device states them."""
    return ", ".join(part for part in (who.model, f"serial {who.serial}" if who.serial else "", who.firmware) if part)


def _print(name: str, report: DeviceReport | OrthocaptureError) -> None:
    if isinstance(report, OrthocaptureError):
        console.tell((f"✗ {name}", "bold red"), f" {report}")
        return
    who = report.identity
    late = report.clock == "utc" and abs(report.clock_offset_s or 0.0) > DEVICE_LIMIT_S
    mark, style = ("!", "bold yellow") if report.problems or late else ("✓", "bold green")
    console.tell((f"{mark} {name}", style), f" {_identity_words(who)}")
    console.print(f"    {who.driver} {who.driver_version} at {who.address}")
    if report.clock_offset_s is not None:
        words = _offset_words(report.clock_offset_s, report.clock, late=late)
        console.tell("    ", (words, "yellow" if late else ""))
    if report.free_bytes is not None:
        console.print(f"    {gigabytes(report.free_bytes):.1f} GB free")
    if report.battery_fraction is not None:
        console.print(f"    battery {report.battery_fraction:.0%}")
    for key, value in report.details.items():
        console.print(f"    {key}: {value}")
    for problem in report.problems:
        console.tell("    ", (problem, "yellow"))


def record_devices(station: Station, file: Path, clock: Clock, *, quiet: bool) -> None:
    """Open each device once more, ask all that it tells, and write it without personal data.

    Raises ConfigurationError if the file exists or cannot be written.
    """
    secrets = named([socket.gethostname()], "address")
    devices: dict[str, RecordedDevice] = {}
    counted = Counter[str]()
    with progress_bar(quiet=quiet) as progress:
        for i, name in enumerate(station.names()):
            progress(f"recording {name}", i, len(station.names()))
            try:
                said, told = station.heard(name)
            except ConfigurationError as error:  # its section is wrong, or its driver is not installed
                section = station.rig.section.devices[name]
                said = RecordedDevice(kind="device", driver=str(section.get("driver", "")), error=error.what)
                told = named((str(value) for key, value in section.items() if key != "driver"), "address")
            counted[said.kind] += 1
            devices[said.kind if counted[said.kind] == 1 else f"{said.kind} {counted[said.kind]}"] = said
            secrets |= told
    recording = Recording(
        by=f"orthocapture {version('orthocapture')}",
        recorded_utc=clock.utc_now().isoformat(timespec="seconds"),
        devices=devices,
    )
    text = readable(without_personal_data(recording, secrets))
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise ConfigurationError(
            f"the recording cannot be written: {error.strerror or error}", where=str(file), remedy="Name a new file"
        ) from error
