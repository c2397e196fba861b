"""Acts of people and devices in a case, apart from faults on the wire, and the person's repairs before going on."""

from __future__ import annotations

import shutil
import signal
import socket
import sqlite3
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from service.store.database.engine import database_path
from tests.support.processes.faulty_disk import FaultyDisk, JumpingClock
from tests.support.torture.faults.place.ct_suite import Suite
from tests.support.torture.faults.place.material import SCAN, ct_folder, mirrored_ct, other_ct, scan_folder, spoilt_ct
from tests.support.torture.faults.place.newer_rigs import Film, OtherClient, pendant
from tests.support.vendor.ur_rtde_protocol import RtdeClient

if TYPE_CHECKING:
    from tests.support.torture.faults.trial import Trial

_DASHBOARD = 29999


def _say(trial: Trial, *orders: str) -> list[str]:
    """Send lines to the simulated controller's dashboard, as from the pendant; returns its replies."""
    with (
        socket.create_connection((trial.arm_host, _DASHBOARD), timeout=3) as link,
        link.makefile("rw") as lines,
    ):
        lines.readline()
        answers: list[str] = []
        for order in orders:
            lines.write(f"{order}\n")
            lines.flush()
            answers.append(lines.readline().strip())
        return answers


def _slider(trial: Trial, fraction: float) -> None:
    """Move the speed slider on the pendant."""
    client = RtdeClient(trial.arm_host)
    recipe, _ = client.input_setup(["speed_slider_mask", "speed_slider_fraction"])
    client.send("U", struct.pack(">BId", recipe, 1, fraction))
    time.sleep(0.1)
    client.close()


def _unlock(trial: Trial) -> None:
    """Release the protective stop, which the controller allows some seconds after it happened."""
    deadline_s = time.monotonic() + 15.0
    while time.monotonic() < deadline_s:
        if _say(trial, "unlock protective stop")[0].startswith(("Protective stop rel", "Failed")):
            return
        time.sleep(0.3)


def _power_up(trial: Trial) -> None:
    """Release the emergency stop button, power on, and release the brakes."""
    deadline_s = time.monotonic() + 15.0
    while time.monotonic() < deadline_s:
        _say(trial, "power on", "brake release")
        if "RUNNING" in _say(trial, "robotmode")[0]:
            return
        time.sleep(0.3)


def _background(trial: Trial, work: Callable[[], None]) -> None:
    """Run `work` in a thread while the run continues."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    trial.ends.append(lambda: thread.join(20.0))


# --- export folders -------------------------------------------------------------------------------------------


def _cut(trial: Trial) -> bytes:
    """Truncate the export; returns the removed bytes."""
    path = trial.scene_folder / SCAN
    data = path.read_bytes()
    kept = len(data) * 6 // 10
    path.write_bytes(data[:kept])
    return data[kept:]


def _truncated(trial: Trial) -> None:
    _cut(trial)


def _empty(trial: Trial) -> None:
    (trial.scene_folder / SCAN).write_bytes(b"")


def _half_written(trial: Trial) -> None:
    rest = _cut(trial)

    def go_on() -> None:
        time.sleep(2.0)
        with (trial.scene_folder / SCAN).open("ab") as export:
            export.write(rest)

    _background(trial, go_on)


def _replaced(trial: Trial) -> None:
    """Export again and again for some seconds, so that the file changes while it is read."""
    path = trial.scene_folder / SCAN
    whole = (trial.material / SCAN).read_bytes()
    other = (trial.material / "eight.ply").read_bytes()

    def go_on() -> None:
        until_s = time.monotonic() + 3.0
        while time.monotonic() < until_s:
            for data in (other, whole):
                path.write_bytes(data)
                time.sleep(0.05)

    _background(trial, go_on)


def _noise(trial: Trial) -> None:
    path = trial.scene_folder / SCAN
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 256] = Random(trial.seed).randbytes(256)
    path.write_bytes(bytes(data))


def _scaled(trial: Trial, factor: float) -> None:
    mesh = trimesh.load_mesh(trial.material / SCAN, process=False)
    trimesh.Trimesh(np.asarray(mesh.vertices) * factor, mesh.faces, process=False).export(trial.scene_folder / SCAN)


def _away(trial: Trial, seconds: float | None) -> None:
    """Remove the share, and bring it back after `seconds` if not None."""
    aside = trial.scene_folder.with_name("aside")
    trial.scene_folder.rename(aside)

    def back() -> None:
        assert seconds is not None
        time.sleep(seconds)
        aside.rename(trial.scene_folder)

    if seconds is not None:
        _background(trial, back)


def _emptied(trial: Trial) -> None:
    for path in list(trial.scene_folder.rglob("*")):
        if path.is_file():
            path.unlink()


def _ct(trial: Trial, kind: str) -> None:
    _emptied(trial)
    if kind == "mirrored":
        mirrored_ct(trial.scene_folder)
    elif kind == "two_series":
        ct_folder(trial.scene_folder, trial.material)
        other_ct(trial.scene_folder)
    else:
        spoilt_ct(trial.scene_folder, kind)


def _whole_scan(trial: Trial) -> None:
    """Scan and export again."""
    scan_folder(trial.scene_folder, trial.material)


def _whole_ct(trial: Trial) -> None:
    _emptied(trial)
    ct_folder(trial.scene_folder, trial.material)


def _share_back(trial: Trial) -> None:
    aside = trial.scene_folder.with_name("aside")
    if aside.exists():
        aside.rename(trial.scene_folder)


# --- disk, database, clock ------------------------------------------------------------------------------------


def _faulty_disk(trial: Trial) -> dict[str, Any]:
    """Keyword arguments of Store.open for a failing disk."""
    if trial.disk is None:
        value = trial.case.value
        trial.disk = FaultyDisk(str(value["effect"]), int(value["nth"]), int(value["errno"]))
    return {"files": trial.disk}


def _arm_disk(trial: Trial) -> None:
    assert trial.disk is not None
    trial.disk.armed = True


def _mend_disk(trial: Trial) -> None:
    assert trial.disk is not None
    trial.disk.mended = True


def _jumping(trial: Trial) -> dict[str, Any]:
    trial.clock = trial.clock or JumpingClock()
    return {"clock": trial.clock}


def _jump(trial: Trial) -> None:
    assert trial.clock is not None
    trial.clock.ahead_s = float(trial.case.value["seconds"])


def _lock(trial: Trial) -> None:
    """Lock the database for writing, like a database browser that somebody has left open."""

    def hold() -> None:
        with closing(sqlite3.connect(database_path(trial.data), timeout=10.0, isolation_level=None)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            time.sleep(float(trial.case.value["seconds"]))
            connection.execute("ROLLBACK")

    _background(trial, hold)


def _data_away(trial: Trial) -> None:
    trial.data.rename(trial.data.with_name("data-aside"))


def _data_back(trial: Trial) -> None:
    aside = trial.data.with_name("data-aside")
    if aside.exists():
        shutil.rmtree(trial.data, ignore_errors=True)
        aside.rename(trial.data)


# --- turntable, KUKA arm, video camera --------------------------------------------------------------------------


def _film(trial: Trial) -> Film:
    assert trial.film is not None
    return trial.film


def _pulled(trial: Trial, seconds: float | None) -> None:
    """End the video, and start it again after `seconds`; None: never."""
    _film(trial).end()

    def back() -> None:
        assert seconds is not None
        time.sleep(seconds)
        _film(trial).run()

    if seconds is not None:
        _background(trial, back)


def _taken(trial: Trial) -> None:
    """Control the camera from another program, which takes it before this one can."""
    trial.other = OtherClient(trial.arm_host)
    trial.ends.append(trial.other.let_go)


def _let_go(trial: Trial) -> None:
    assert trial.other is not None
    trial.other.let_go()


def _kuka_stop(trial: Trial) -> None:
    pendant(trial, "stop external_stop")
    trial.stopped()


# --- a CT suite that sends -------------------------------------------------------------------------------------


def _suite(trial: Trial) -> Suite:
    assert trial.suite is not None
    return trial.suite


def _killed_in_between(trial: Trial) -> None:
    _suite(trial).send()
    _suite(trial).kill_receiver()


def _send_again(trial: Trial) -> None:
    """Return what a person does at the CT suite, once the receiver can be reached."""
    if trial.case.spoil is not None and trial.case.spoil.column.startswith("away_"):
        trial.await_return()
    _suite(trial).send_again()


def _listen_and_send(trial: Trial) -> None:
    _suite(trial).listen()
    _suite(trial).send_again()


ACTS: Mapping[str, Callable[[Trial], None]] = {
    "nothing": lambda _trial: None,
    "slider": lambda trial: _slider(trial, float(trial.case.value["fraction"])),
    "half_written": _half_written,
    "truncated": _truncated,
    "empty": _empty,
    "corrupt": _noise,
    "replaced": _replaced,
    "scaled": lambda trial: _scaled(trial, float(trial.case.value["factor"])),
    "wrong_specimen": lambda trial: scan_folder(trial.scene_folder, trial.material, "eight.ply"),
    "no_export": _emptied,
    "share_away": lambda trial: _away(trial, trial.case.value.get("seconds")),
    "ct": lambda trial: _ct(trial, str(trial.case.value["kind"])),
    "disk": _arm_disk,
    "clock": _jump,
    "lock": _lock,
    "data_away": _data_away,
    "send": lambda trial: _suite(trial).send(),
    "send_cut": lambda trial: _suite(trial).cut(),
    "send_spoilt": lambda trial: _suite(trial).send_spoilt(str(trial.case.value["kind"])),
    "send_two": lambda trial: _suite(trial).send_two(),
    "receiver_killed": _killed_in_between,
    "unplug": lambda trial: trial.simulators.stop(("lightbox",)),
    "camera_off": lambda trial: trial.simulators.stop(("camera",)),
    "film": lambda trial: _film(trial).run(str(trial.case.value["how"])),
    "film_pauses": lambda trial: _film(trial).pause(),
    "film_ends": lambda trial: _pulled(trial, trial.case.value.get("seconds")),
    "taken": _taken,
    "gige_off": lambda trial: trial.simulators.stop(("gige",)),
    "table_off": lambda trial: trial.simulators.stop(("grbl",)),
    "kuka_off": lambda trial: trial.simulators.stop(("kuka",)),
    "kuka_stop": _kuka_stop,
    "arm_off": lambda trial: trial.simulators.stop(("ur",)),
}
MENDS: Mapping[str, Callable[[Trial], None]] = {
    "unlock": _unlock,
    "power_up": _power_up,
    "slider_up": lambda trial: _slider(trial, 1.0),
    "film": lambda trial: _film(trial).run(),
    "let_go": _let_go,
    "kuka_release": lambda trial: pendant(trial, "release"),
    "scan": _whole_scan,
    "ct": _whole_ct,
    "send": _send_again,
    "listen": _listen_and_send,
    "send_afresh": lambda trial: _suite(trial).send_afresh(),
    "share_back": _share_back,
    "disk": _mend_disk,
    "data_back": _data_back,
    "remote": lambda trial: trial.simulators.signal("ur", signal.SIGUSR1),
}
SEAMS: Mapping[str, Callable[[Trial], dict[str, Any]]] = {"disk": _faulty_disk, "clock": _jumping}
