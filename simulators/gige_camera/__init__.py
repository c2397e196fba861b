"""A simulated industrial camera: GenICam registers and images over GigE Vision. Options and main loop."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path

from simulators.gige_camera.body import IndustrialBody
from simulators.gige_camera.control import PORT, ControlServer
from simulators.gige_camera.registers import SERIAL, Registers
from simulators.gige_camera.stream import Stream
from simulators.scene.intrinsics import FULL_HEIGHT, FULL_WIDTH
from simulators.serve import Termination, announce
from simulators.still_camera.scene import StillLife, WorldSource

_WIDTH = 960


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the camera's options."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; its port is always 3956")
    parser.add_argument("--world", metavar="HOST:PORT", help="take images of the rig's world")
    parser.add_argument(
        "--image-width", type=int, default=_WIDTH, metavar="W", help=f"image width (default {_WIDTH})"
    )
    parser.add_argument("--aperture-f", type=float, default=22.0, metavar="F", help="as the lens is set by hand")
    parser.add_argument("--exposures-log", type=Path, metavar="FILE", help="write one JSON line per exposure")
    parser.add_argument("--first-counter", type=int, default=1, help="number of the first image")


def serve(args: argparse.Namespace) -> None:
    """Print the ready line and serve until SIGTERM."""
    termination, stop = Termination(), threading.Event()
    width = args.image_width
    registers = Registers(args.host, width, round(width * FULL_HEIGHT / FULL_WIDTH))
    source = WorldSource(args.world, width) if args.world else StillLife(width)
    stream = Stream(args.host, registers)
    body = IndustrialBody(
        source, registers, stream, args.faults, args.aperture_f, args.first_counter, args.exposures_log
    )
    if isinstance(source, WorldSource):
        threading.Thread(target=source.warm_up, args=(stop,), name="warm-up", daemon=True).start()
    with ControlServer(args.host, registers, body.written, stream.resend):
        announce(simulator="gige", host=args.host, port=PORT, serial=SERIAL)
        termination.wait()
    stop.set()
