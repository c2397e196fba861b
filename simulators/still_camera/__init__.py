"""What simulated still cameras of all makers share: command-line options, pictures, the camera's own button."""

from __future__ import annotations

import argparse
import logging
import threading
from collections.abc import Sequence
from pathlib import Path

from simulators.ptpip.server import PtpIpServer
from simulators.serve import SimulatorError, Termination, announce
from simulators.still_camera.body import BodyOptions, CameraBody
from simulators.still_camera.scene import ImageSource, PictureFiles, StillLife, WorldSource

DEFAULT_WIDTH = 1536
_LOG = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the camera's options."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--port", type=int, default=15740, help="port of both connections; 0 takes a free one")
    parser.add_argument("--world", metavar="HOST:PORT", help="take pictures of the rig's world")
    parser.add_argument(
        "--image-width", type=int, metavar="W", help=f"image width (up to 9504; default {DEFAULT_WIDTH})"
    )
    parser.add_argument("--image", nargs="+", type=Path, metavar="FILE", help="serve these pictures in turn")
    parser.add_argument("--exposures-log", type=Path, metavar="FILE", help="write one JSON line per exposure")
    parser.add_argument("--first-counter", type=int, default=1, help="number of the first file")
    parser.add_argument(
        "--announce", choices=("event", "property", "both"), default="both", help="how to announce a file"
    )
    parser.add_argument("--send-to", type=Path, metavar="DIR", help="no cable: send every file into this folder")
    parser.add_argument("--battery", type=int, default=87, metavar="PERCENT", help="charge of the battery")
    parser.add_argument("--camera", default="", metavar="NAME", help="which camera of the world; default: the first")
    parser.add_argument("--clock-ahead-s", type=float, default=0.0, metavar="S", help="how far its clock is ahead")
    parser.add_argument("--fast", action="store_true", help="exposures take no time")
    parser.add_argument(
        "--mosaic-jpeg",
        action="store_true",
        help="make the JPEG beside a raw file of the same values, as a camera does; "
        "otherwise it is that of a sensor that measures three colours at every pixel",
    )


def image_source(args: argparse.Namespace) -> ImageSource:
    """Return where the pictures come from."""
    if args.world:
        return WorldSource(args.world, args.image_width or DEFAULT_WIDTH, camera=args.camera)
    if args.image:
        return PictureFiles(args.image, args.image_width)
    return StillLife(args.image_width or DEFAULT_WIDTH)


def _attend_button(source: WorldSource, body: CameraBody, stop: threading.Event) -> None:
    """Release the shutter whenever somebody in the world presses the camera's own button."""
    presses: int | None = None
    while not stop.is_set():
        try:
            count, iso = source.await_press(-1 if presses is None else presses)
        except SimulatorError as error:
            _LOG.debug("the button: %s", error)
            stop.wait(1.0)
            continue
        if presses is not None and count > presses:
            body.press(iso)
        presses = count


def body_options(args: argparse.Namespace) -> BodyOptions:
    """The options of the body."""
    return BodyOptions(
        args.fast,
        args.first_counter,
        args.exposures_log,
        args.announce,
        args.mosaic_jpeg,
        args.send_to,
        args.clock_ahead_s,
    )


def serve_until_stopped(
    server: PtpIpServer, body: CameraBody, termination: Termination, not_served: Sequence[str] = ()
) -> None:
    """Print the ready line, with what is not served of a recording, and serve until SIGTERM."""
    pictures, stop = body.source, threading.Event()
    if isinstance(pictures, WorldSource):
        threading.Thread(target=pictures.warm_up, args=(stop,), name="warm-up", daemon=True).start()
        threading.Thread(target=_attend_button, args=(pictures, body, stop), name="button", daemon=True).start()
    with server:
        host, port = server.address
        announce(
            simulator="camera",
            host=host,
            port=port,
            gphoto_port=f"ptpip:{host}:{port}:{port}",
            not_served=list(not_served),
        )
        termination.wait()
    stop.set()
