"""A camera whose video arrives in a named pipe, as JPEG files one after another: a microscope with its program."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import select
import time
from pathlib import Path

import cv2

from simulators.rendering.sensor import Light, picture_without_filters
from simulators.serve import SimulatorError, Termination, announce
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.scene import ImageSource, Moment, StillLife, WorldSource

_WIDTH, _QUALITY = 960, 95
# Every image begins with a comment of this size, which is sent together with the previous image: FFmpeg reads in
# blocks of this size, and takes an image as complete once the next one begins.
_BLOCK = 4096
_START = b"\xff\xd8"
_HEAD = _START + b"\xff\xfe" + (_BLOCK + 2).to_bytes(2, "big") + bytes(_BLOCK)
_STALE_S = 1.0  # a frame that took longer is dropped, as a camera's program does that cannot follow
_SETTINGS = ExposureSettings(22.0, 1 / 15, (1, 15), 100)  # as they are dialled in by hand


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--pipe", type=Path, required=True, help="named pipe; it is made if there is none")
    parser.add_argument("--world", metavar="HOST:PORT", help="film the rig's world")
    parser.add_argument("--image-width", type=int, default=_WIDTH, metavar="W", help="width of its images")
    parser.add_argument("--frame-rate", type=float, default=2.0, metavar="HZ", help="images a second")
    parser.add_argument("--exposures-log", type=Path, metavar="FILE", help="write one JSON line per image")
    parser.add_argument("--first-counter", type=int, default=1, help="number of the first image")


def serve(args: argparse.Namespace) -> None:
    """Print the ready line and film until SIGTERM, whenever somebody reads the pipe."""
    termination = Termination()
    try:
        if not args.pipe.is_fifo():
            os.mkfifo(args.pipe)
    except OSError as error:
        raise SimulatorError(f"no pipe can be made at {args.pipe}: {error.strerror}") from error
    source = WorldSource(args.world, args.image_width) if args.world else StillLife(args.image_width)
    film = _Film(source, args.first_counter, args.exposures_log)
    announce(simulator="video", pipe=str(args.pipe))
    while not termination.wait(0.05):
        try:
            pipe = os.open(args.pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            continue  # nobody reads
        try:
            _write_on(pipe, film, 1.0 / args.frame_rate, termination)
        except BrokenPipeError:
            pass
        finally:
            os.close(pipe)


def _write_on(pipe: int, film: _Film, interval_s: float, termination: Termination) -> None:
    """Write images until the end, or until nobody reads any more (BrokenPipeError)."""
    _write(pipe, _HEAD, termination)
    while not termination.is_set():
        began_s = time.monotonic()
        data = film.next_image()
        if time.monotonic() - began_s < _STALE_S:
            film.note(data)
            _write(pipe, data.removeprefix(_HEAD) + _HEAD, termination)
        time.sleep(max(0.0, began_s + interval_s - time.monotonic()))


def _write(pipe: int, data: bytes, termination: Termination) -> None:
    while data and not termination.is_set():
        if select.select([], [pipe], [], 0.2)[1]:
            data = data[os.write(pipe, data) :]


class _Film:
    """Images of what is in front of the lens; as long as nothing moves there, only their noise differs."""

    def __init__(self, source: ImageSource, first_counter: int, log: Path | None) -> None:
        self._source, self._log = source, log
        self._counter = first_counter - 1
        self._seen: tuple[object, ...] = ()
        self._light: Light | None = None
        self._moment = Moment(0, None, {})

    def next_image(self) -> bytes:
        """Expose once; a JPEG file without EXIF."""
        self._counter += 1
        self._moment = moment = self._source.freeze(self._counter)
        seen = (moment.T_world_camera, moment.view.get("scene"), moment.view.get("light_lux"))
        if self._light is None or seen != self._seen:
            self._light, self._seen = self._source.light(moment, _SETTINGS), seen
        picture = picture_without_filters(self._light, _SETTINGS.iso, self._counter)
        done, encoded = cv2.imencode(
            ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        if not done:
            raise SimulatorError("the picture could not be encoded as JPEG")
        return _HEAD + encoded.tobytes().removeprefix(_START)

    def note(self, data: bytes) -> None:
        """Log the truth about an image that is sent."""
        if self._log is None:
            return
        line = {"sha256": hashlib.sha256(data).hexdigest(), "T_world_camera": self._moment.T_world_camera}
        with self._log.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"counter": self._counter, **line}) + "\n")
