"""A driver that is suspended while it writes a piece of a motion takes it back: the axes may stand by then."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from drivers.errors import DeviceError
from drivers.grbl.table import GrblTable
from drivers.grbl.wire import JOG_CANCEL, RESET
from tests.support.arms.grbl_simulator import TURN, Tap, grbl_config, table
from tests.support.processes.waiting import until
from tests.support.rig.patience import PATIENT_GRBL

WATCHDOG_S = 5.0


class Clock:
    """The machine's clock, which may jump ahead."""

    def __init__(self) -> None:
        self.ahead_s = 0.0
        self._true = time.monotonic

    def monotonic(self) -> float:
        return self._true() + self.ahead_s


class Suspended(serial.Serial):
    """A port whose process is suspended before its sixth piece of a motion reaches the line.

    Class attributes: `clock` goes on meanwhile; if `times_out`, pyserial gives the write up, although the controller
    has the line.
    """

    times_out = False
    clock = Clock()
    pieces = 0

    def write(self, b: Any, /) -> int | None:
        if not b.startswith(b"$J"):
            return super().write(b)
        self.pieces += 1
        if self.pieces == 6:
            self.clock.ahead_s = WATCHDOG_S + 1.0
        written = super().write(b)
        if self.pieces == 6 and self.times_out:
            raise serial.SerialTimeoutException("Write timeout")
        return written


@pytest.mark.parametrize(("times_out", "taken_back"), [(False, JOG_CANCEL), (True, RESET)])
def test_a_piece_that_was_written_late_is_taken_back(
    times_out: bool, taken_back: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(Suspended, "times_out", times_out)
    monkeypatch.setattr(Suspended, "clock", clock)
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    monkeypatch.setattr(serial, "serial_for_url", Suspended)
    with table(tmp_path) as port, Tap(port, tmp_path) as tap:
        limits = {**PATIENT_GRBL, "watchdog_s": WATCHDOG_S}
        arm = GrblTable(grbl_config(tap.port, TURN, **limits))
        arm.open()
        over = threading.Event()
        threading.Thread(target=lives, args=(arm, over), daemon=True).start()
        try:
            arm.let_move("Ada", time.monotonic())
            arm.move_joints(np.radians([-90.0]), speed_rad_s=0.9, acceleration_rad_s2=1.5)
            with pytest.raises(DeviceError):  # nothing moves until a person has confirmed, or the line is dead
                until(lambda: not arm.is_moving(), "it moves on", every_s=0.02)
        finally:
            until(lambda: taken_back in after_the_last_piece(tap.sent), "not taken back", every_s=0.02)
            over.set()
            arm.close()
    assert tap.sent.count(b"$J") == 6
    assert after_the_last_piece(tap.sent).startswith(taken_back)


def lives(arm: GrblTable, over: threading.Event) -> None:
    """Give the driver its program's signs of life."""
    while not over.wait(0.02):
        arm.heartbeat(time.monotonic())


def after_the_last_piece(sent: bytes) -> bytes:
    return sent.rpartition(b"$J")[2].partition(b"\n")[2]
