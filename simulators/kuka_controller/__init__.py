"""A simulated KUKA controller (LBR iiwa or Med) with our Sunrise application: newline-delimited JSON over TCP."""

from __future__ import annotations

import argparse
import os

import numpy as np

from simulators.kuka_controller.controller import HEARTBEAT_S, MODES, Controller
from simulators.kuka_controller.fri import VERSIONS
from simulators.kuka_controller.kinematics import MODELS, Array
from simulators.kuka_controller.replay import recorded
from simulators.kuka_controller.server import Server
from simulators.recordings import add_replay, recorded_device
from simulators.serve import SimulatorError, Termination, add_patience, announce
from simulators.world_link import WorldLink

HOME_RAD = (0.0, 0.5236, 0.0, -1.2217, 0.0, 1.3963, 0.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `simulators kuka`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--port", type=int, default=30010, help="port of the application")
    parser.add_argument("--pendant-port", type=int, default=30011, help="port for what a person does at the smartPAD")
    parser.add_argument("--model", default="LBR Med 14", choices=sorted(MODELS))
    parser.add_argument("--mode", default="AUT", choices=MODES, help="operating mode at start-up")
    parser.add_argument("--serial", default="", help="serial number; made from the address by default")
    parser.add_argument("--speed-up", type=float, default=1.0, metavar="N", help="motions take 1/N of their time")
    parser.add_argument("--initial-joints", default="", metavar="Q1,…,Q7", help="joints at start-up in radians")
    parser.add_argument(
        "--true-load-kg", type=float, metavar="M", help="mass on the flange: another one in the tool stops the arm"
    )
    parser.add_argument(
        "--fri-version", default="1", choices=(*VERSIONS, "none"), help="FRI, which sends every 10 ms at most"
    )
    parser.add_argument("--world", default="", metavar="HOST:PORT", help="world socket that receives the joints")
    parser.add_argument("--arm", default="robot", help="name of the arm in the world and in fault plans")
    add_replay(parser)
    add_patience(parser)


def serve(args: argparse.Namespace) -> None:
    """Listen, print the ready line and serve until SIGTERM. Raises SimulatorError."""
    termination = Termination()
    replayed = recorded(recorded_device(args.replay, "kuka_sunrise", args.replayed)) if args.replay else None
    as_recorded = None if replayed is None or args.initial_joints else replayed.joints
    controller = Controller(
        replayed.model if replayed else MODELS[args.model],
        joints=_joints(args.initial_joints) if as_recorded is None else as_recorded,
        serial=args.serial or (replayed.serial if replayed else "") or f"simulated {args.host}",
        faults=args.faults,
        device=args.arm,
        speed_up=args.speed_up,
        heartbeat_s=max(HEARTBEAT_S, args.patience),
        true_load_kg=args.true_load_kg,
    )
    controller.mode = args.mode
    if replayed:
        replayed.set_up(controller)
    world = None
    if args.world:
        host, _, port = args.world.rpartition(":")
        world = WorldLink((host, int(port)), args.arm)
    server = Server(controller, (args.host, args.port), args.pendant_port, world, args.fri_version)
    announce(
        host=args.host,
        application=f"{args.host}:{args.port}",
        pendant=f"{args.host}:{args.pendant_port}",
        model=controller.model.name,
        serial=controller.serial,
        pid=os.getpid(),
        not_served=list(replayed.not_served) if replayed else [],
    )
    try:
        server.run(termination)
    finally:
        server.close()


def _joints(text: str) -> Array:
    try:
        joints = [float(part) for part in text.split(",")] if text else list(HOME_RAD)
    except ValueError:
        joints = []
    if len(joints) != 7:
        raise SimulatorError(f"initial joints {text!r} are not seven numbers")
    return np.array(joints)
