"""A GRBL 1.1 controller on a pseudo-terminal: a turntable X under the specimen, and slides.

Written from GRBL's description of its interface, with none of the driver's code.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

from simulators.grbl.carrier import Carrier
from simulators.grbl.controller import SIMULATED, Controller
from simulators.grbl.machine import Machine
from simulators.grbl.replay import recorded
from simulators.recordings import add_replay, recorded_device
from simulators.serial_line import Terminal
from simulators.serve import SimulatorError, Termination, announce
from simulators.world_link import WorldLink

_TICK_S, _REST_S = 0.003, 0.02  # while it moves; while nothing changes unless the host says something


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `simulate grbl`."""
    parser.add_argument("--link", type=Path, metavar="PATH", help="symbolic link to the pseudo-terminal")
    parser.add_argument("--world", default="", metavar="HOST:PORT", help="control socket of the rig with the camera")
    parser.add_argument("--tilt-deg", type=float, default=35.0, help="tilt of the camera from the vertical")
    parser.add_argument("--distance-m", type=float, default=0.62, help="from the camera to the scene's centre")
    parser.add_argument("--speed-up", type=float, default=1.0, metavar="N", help="motions take 1/N of their time")
    parser.add_argument("--setting", nargs="+", default=[], metavar="N=VALUE", help="settings such as 22=0")
    add_replay(parser)


def serve(args: argparse.Namespace) -> None:
    """Serve until SIGTERM."""
    termination = Termination()
    said, settings = SIMULATED, dict[int, float]()
    if args.replay:
        said, settings = recorded(recorded_device(args.replay, "grbl", args.replayed))
    given = _settings(args.setting)
    said = replace(said, listed=tuple({*said.listed, *given}))
    machine = Machine(settings | given, args.speed_up)
    carrier = Carrier(args.tilt_deg, args.distance_m)
    world = None
    if args.world:
        host, _, port = args.world.rpartition(":")
        if not port.isdigit():
            raise SimulatorError(f"--world wants HOST:PORT, not {args.world!r}")
        world = WorldLink((host, int(port)), "table")
    terminal = Terminal(args.link)
    controller = Controller(machine, terminal.send, args.faults, said)
    try:
        port_name = terminal.plug_in()
        controller.power_up()
        link = None if args.link is None else str(args.link)
        announce(port=port_name, link=link, not_served=list(said.not_served))
        while not termination.is_set():
            controller.hear(terminal.receive(_TICK_S if controller.busy else _REST_S))
            now_s = time.monotonic()
            controller.advance(now_s)
            if controller.unplugged_s:
                terminal.pull_out(controller.unplugged_s)
                controller.power_up()
            if world is not None:
                world.push_camera(carrier.T_world_camera(machine.true_position).tolist(), now_s)
    finally:
        terminal.unplug()
        if world is not None:
            world.close()


def _settings(given: list[str]) -> dict[int, float]:
    try:
        return {int(number): float(value) for number, _, value in (text.partition("=") for text in given)}
    except ValueError as error:
        raise SimulatorError(f"--setting wants N=VALUE, not {' '.join(given)!r}") from error
