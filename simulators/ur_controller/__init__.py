"""A simulated Universal Robots controller on its real ports: RTDE 30004, dashboard 29999, script 30003, 30001."""

from __future__ import annotations

import argparse
import os
import signal
from types import FrameType

import numpy as np

from simulators.recordings import add_replay, recorded_device
from simulators.serve import SimulatorError, Termination, add_patience, announce
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.kinematics import MODELS
from simulators.ur_controller.replay import recorded
from simulators.ur_controller.server import CUT_OFF_S, DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT, Server
from simulators.world_link import WorldLink

HOME_RAD = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `simulators ur`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; the ports are UR's")
    parser.add_argument("--model", default="UR10e", choices=sorted(MODELS))
    parser.add_argument(
        "--version", default="5.12", help="Polyscope version: 3.15 for CB3, 5.12 or 5.25 for e-Series"
    )
    parser.add_argument("--serial", default="", help="serial number (digits); made from the address by default")
    parser.add_argument("--speed-up", type=float, default=1.0, metavar="N", help="motions take 1/N of their time")
    parser.add_argument("--initial-joints", default="", metavar="Q1,…,Q6", help="joints at start-up in radians")
    parser.add_argument("--world", default="", metavar="HOST:PORT", help="world socket that receives the joints")
    parser.add_argument("--local", action="store_true", help="start in local control; SIGUSR1 switches to remote")
    parser.add_argument("--arm", default="robot", help="name of the arm in the world and in fault plans")
    parser.add_argument(
        "--pendant-port", type=int, default=30090, help="port for what a person does at the pendant (pendant.py)"
    )
    parser.add_argument(
        "--cut-off", type=float, default=CUT_OFF_S, metavar="S", help="seconds without reading that end a connection"
    )
    parser.add_argument(
        "--fieldbus", action="store_true", help="a fieldbus is on, which reserves the input registers 0 to 23"
    )
    add_replay(parser)
    add_patience(parser)


def serve(args: argparse.Namespace) -> None:
    """Listen, print the ready line and serve until SIGTERM; SIGUSR1 switches to remote control.

    Raises SimulatorError.
    """
    termination = Termination()
    replayed = recorded(recorded_device(args.replay, "ur", args.replayed)) if args.replay else None
    model = replayed.model if replayed else MODELS[args.model]
    version = replayed.version if replayed else _version(args.version)
    as_recorded = None if replayed is None or args.initial_joints else replayed.joints
    controller = Controller(
        model,
        version,
        joints=_joints(args.initial_joints) if as_recorded is None else as_recorded,
        serial=args.serial or f"2023{'5' if model.e_series else '3'}{_last_number(args.host):05d}",
        faults=args.faults,
        device=args.arm,
        speed_up=args.speed_up,
        patience_s=args.patience,
    )
    words = replayed.set_up(controller) if replayed else None
    controller.local |= args.local

    def turn_key(number: int, frame: FrameType | None) -> None:
        del number, frame
        controller.local = not controller.local

    signal.signal(signal.SIGUSR1, turn_key)
    world = None
    if args.world:
        host, _, port = args.world.rpartition(":")
        world = WorldLink((host, int(port)), args.arm)
    server = Server(
        controller,
        args.host,
        world,
        args.pendant_port,
        cut_off_s=args.cut_off,
        fieldbus=args.fieldbus,
        words=words,
    )
    announce(
        host=args.host,
        rtde=f"{args.host}:{RTDE_PORT}",
        dashboard=f"{args.host}:{DASHBOARD_PORT}",
        script=f"{args.host}:{SCRIPT_PORT}",
        pendant=f"{args.host}:{args.pendant_port}",
        model=model.name,
        version=".".join(map(str, version)),
        serial=controller.serial,
        pid=os.getpid(),
        not_served=list(replayed.not_served) if replayed else [],
    )
    try:
        server.run(termination)
    finally:
        server.close()


def _version(text: str) -> tuple[int, int]:
    try:
        major, minor = (int(part) for part in text.split(".")[:2])
    except ValueError:
        raise SimulatorError(f"version {text!r} is not MAJOR.MINOR") from None
    return major, minor


def _joints(text: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    try:
        joints = [float(part) for part in text.split(",")] if text else list(HOME_RAD)
    except ValueError:
        joints = []
    if len(joints) != 6:
        raise SimulatorError(f"initial joints {text!r} are not six numbers")
    return np.array(joints)


def _last_number(host: str) -> int:
    last = host.rpartition(".")[2]
    return int(last) if last.isdigit() else 0
