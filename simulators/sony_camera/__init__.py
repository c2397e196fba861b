"""A simulated Sony camera over PTP/IP, an ILCE-7RM5 or one that was recorded: options and main loop."""

from __future__ import annotations

import argparse

from simulators import still_camera
from simulators.recordings import add_replay, not_recorded
from simulators.serve import Termination
from simulators.sony_camera.alpha_7r_v import alpha_7r_v
from simulators.sony_camera.answers import with_answers
from simulators.sony_camera.body import SonyBody, SonyOptions
from simulators.sony_camera.properties import Code
from simulators.sony_camera.recorded import names, recorded_table, replayed_table
from simulators.sony_camera.server import SonyServer
from simulators.still_camera import body_options, image_source, serve_until_stopped


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the camera's options."""
    still_camera.add_arguments(parser)
    parser.add_argument(
        "--recorded", choices=names(), metavar="BODY", help="serve what this body was recorded to state"
    )
    add_replay(parser)
    parser.add_argument("--lens-switch", choices=("MF", "AF"), default="AF", help="focus switch on the lens")
    parser.add_argument("--no-lens", action="store_true", help="there is no lens, or one without contacts")
    parser.add_argument(
        "--not-ready-s",
        type=float,
        default=0.0,
        metavar="S",
        help="releases give no photograph so long after opening",
    )
    parser.add_argument("--old-file", action="store_true", help="its memory still holds a file of another day")
    parser.add_argument("--answers", metavar="JSON", help="properties that answer otherwise (sony_camera/answers.py)")
    parser.add_argument("--bare-event", action="store_true", help="announce a file as C206 instead of C201")


def serve(args: argparse.Namespace) -> None:
    """Print the ready line and serve until SIGTERM."""
    termination = Termination()
    sony = SonyOptions("" if args.no_lens else args.lens_switch, args.not_ready_s, args.bare_event)
    replayed = args.replay or args.recorded
    if args.replay:
        table = replayed_table(args.replay, args.replayed)
    else:
        table = recorded_table(args.recorded) if args.recorded else alpha_7r_v()
    if args.answers:
        table = with_answers(table, args.answers)
    body = SonyBody(image_source(args), args.faults, body_options(args), table, sony)
    if not (replayed or args.answers):
        body.properties.put(Code.BATTERY, args.battery)
    if args.replay:
        body.fill_card()
    if args.old_file:
        body.shoot().join()  # the file is there before anybody opens the body
    server = SonyServer(args.host, args.port, body, args.faults)
    serve_until_stopped(server, body, termination, not_recorded(args))
