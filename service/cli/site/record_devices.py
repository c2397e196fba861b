"""Writes what every device of a rig said into a file that can be given away (`orthocapture doctor --record FILE`)."""

from __future__ import annotations

import socket
from collections import Counter
from importlib.metadata import version
from pathlib import Path

from drivers.recording import RecordedDevice, Recording, readable
from drivers.recording.personal_data import named, without_personal_data
from service.cli.common import progress_bar
from service.core.errors import ConfigurationError
from service.station import Station
from service.store.durable_effects import Clock


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
