"""The simulated industrial camera's exposures: started by a register, rendered, and sent as a stream of packets."""

from __future__ import annotations

import json
import logging
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.faults import FaultPlan
from simulators.gige_camera.registers import (
    ACQUISITION_MODE,
    BAYER_RG8,
    EXPOSURE_US,
    GAIN_DB,
    MONO8,
    PIXEL_FORMAT,
    SINGLE_FRAME,
    START,
    STOP,
    Registers,
)
from simulators.gige_camera.stream import Stream
from simulators.rendering.picture_faults import Lens
from simulators.serve import SimulatorError
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.scene import ImageSource, Moment
from simulators.units import nanoseconds, seconds_of_us

_BASE_ISO = 100
_LAST_BLOCK = 0xFFFF  # GVSP counts images in 16 bits, without zero
_LOG = logging.getLogger(__name__)


class IndustrialBody:
    """Exposes while acquisition is on. The lens is set by hand, to `aperture_f`."""

    def __init__(
        self,
        source: ImageSource,
        registers: Registers,
        stream: Stream,
        faults: FaultPlan,
        aperture_f: float,
        first_counter: int = 1,
        exposures_log: Path | None = None,
    ) -> None:
        self.source = source
        self._registers, self._stream, self._faults = registers, stream, faults
        self._aperture_f, self._log = aperture_f, exposures_log
        self._counter = first_counter
        self._lens = Lens()
        self._previous = b""
        self._acquisition: threading.Event | None = None  # the one that is on; set: to be stopped
        self._going = threading.Lock()

    def written(self, address: int) -> None:
        """Act on a register that a client has written."""
        if address == STOP and self._acquisition is not None:
            self._acquisition.set()
        elif address == START and (self._acquisition is None or self._acquisition.is_set()):
            self._acquisition = stop = threading.Event()
            threading.Thread(target=self._acquire, args=(stop,), name="acquisition", daemon=True).start()

    def _acquire(self, stop: threading.Event) -> None:
        with self._going:  # an exposure that was stopped may still be rendered
            while not stop.is_set():
                try:
                    self._expose(stop)
                except SimulatorError:
                    _LOG.exception("exposure %d gave no image", self._counter)
                if self._registers.get(ACQUISITION_MODE) == SINGLE_FRAME:
                    stop.set()

    def _expose(self, stop: threading.Event) -> None:
        began_s = time.monotonic()
        counter, self._counter = self._counter, self._counter + 1
        settings = self._settings()
        fault = self._faults.check("camera", "image")
        moment = self.source.freeze(counter)
        picture = self._lens.picture(self.source.develop(moment, settings), fault, moment.view)
        code = self._registers.get(PIXEL_FORMAT)
        pixels = _read_out(picture, code)
        kind = fault.kind if fault is not None else ""
        if kind == "stale" and self._previous:
            pixels = self._previous
        self._previous = pixels
        left_s = settings.exposure_s - (time.monotonic() - began_s)
        if stop.wait(max(0.0, left_s)) or kind == "no_image":
            return
        self._write_log(moment, settings)
        lost_share = float(fault.value or 0.0) if fault is not None and kind == "lost_packets" else 0.0
        lost = 3 if kind in ("lost_packets", "truncate") else 0
        block = (counter - 1) % _LAST_BLOCK + 1
        stall_s = float(fault.value or 0.5) if fault is not None and kind == "stall" else 0.0
        self._stream.send(
            block, code, pixels, nanoseconds(began_s), lost, lost_share, for_good=kind == "truncate", stall_s=stall_s
        )

    def _settings(self) -> ExposureSettings:
        exposure_us = self._registers.real(EXPOSURE_US)
        iso = round(_BASE_ISO * 10 ** (self._registers.real(GAIN_DB) / 20))
        return ExposureSettings(self._aperture_f, seconds_of_us(exposure_us), (round(exposure_us), 1_000_000), iso)

    def _write_log(self, moment: Moment, settings: ExposureSettings) -> None:
        if self._log is None:
            return
        line = {
            "counter": moment.counter,
            "T_world_camera": moment.T_world_camera,
            "settings": {"aperture_f": settings.aperture_f, "exposure_s": settings.exposure_s, "iso": settings.iso},
            "time": datetime.now(UTC).isoformat(),
        }
        with self._log.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")


def _read_out(picture: NDArray[np.uint8], code: int) -> bytes:
    """The values of an RGB picture (H, W, 3) in a pixel format."""
    if code == MONO8:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)).tobytes()
    if code != BAYER_RG8:
        return picture.tobytes()
    mosaic = picture[..., 1].copy()
    mosaic[::2, ::2] = picture[::2, ::2, 0]
    mosaic[1::2, 1::2] = picture[1::2, 1::2, 2]
    return mosaic.tobytes()
