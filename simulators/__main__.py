"""Command line of the simulators: `python -m simulators NAME …` prints one ready line and serves until SIGTERM."""

from __future__ import annotations

import argparse
import ast
import ctypes
import gc
import importlib
import importlib.util
import json
import logging
import os
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol, cast

from simulators.faults import FaultPlan
from simulators.serve import SimulatorError, end_with


class SimulatorModule(Protocol):
    """The functions that each simulator's module or package provides."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the simulator's options."""
        ...

    def serve(self, args: argparse.Namespace) -> None:
        """Start, print the ready line and serve until SIGTERM."""
        ...


GROUP = "orthocapture.simulators"
_SIMULATORS = {
    "ur": ("simulators.ur_controller", "a Universal Robots controller: RTDE, dashboard, script port"),
    "kuka": ("simulators.kuka_controller", "a KUKA controller with our Sunrise application"),
    "camera": ("simulators.sony_camera", "a Sony ILCE-7RM5 over PTP/IP, or another that was recorded"),
    "canon": ("simulators.canon_camera", "a Canon EOS R5 over PTP/IP, or another EOS that was recorded"),
    "nikon": ("simulators.nikon_camera", "a Nikon Z that was recorded, over PTP/IP"),
    "gige": ("simulators.gige_camera", "an industrial camera over GigE Vision"),
    "video": ("simulators.video_camera", "a camera whose video goes into a named pipe"),
    "scanner": ("simulators.scan_station.station", "an Artec export folder"),
    "ct": ("simulators.ct_suite.suite", "a CT scanner that writes a DICOM series"),
    "lightbox": ("simulators.lightbox", "the light and environment box on a pseudo-terminal"),
    "rig": ("simulators.rig.processes", "all of them around one scene"),
}


@cache
def simulators() -> dict[str, tuple[str, str]]:
    """Return module and description of each simulator, by name: ours, and those with an entry point of GROUP.

    The description of the latter is the first sentence of the module.
    """
    found = dict(_SIMULATORS)
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        spec = importlib.util.find_spec(point.module)
        words = ast.get_docstring(ast.parse(Path(spec.origin).read_text("utf-8"))) if spec and spec.origin else None
        found.setdefault(point.name, (point.module, (words or point.module).partition("\n")[0].rstrip(".")))
    return found


def _load(name: str) -> SimulatorModule:
    # Imported on demand: most simulators need half a second of imports that the others do not.
    return cast(SimulatorModule, importlib.import_module(_rows(name)[name][0]))


def _rows(name: str) -> dict[str, tuple[str, str]]:
    """Return the simulator of this name, or all: to look for those of plug-ins takes longer than to start one."""
    return {name: _SIMULATORS[name]} if name in _SIMULATORS else simulators()


def _parser(chosen: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="orthocapture simulate", description=__doc__)
    commands = parser.add_subparsers(dest="simulator", required=True, metavar="NAME")
    for name, (_, what) in _rows(chosen or "").items():
        command = commands.add_parser(name, help=what, description=what, conflict_handler="resolve")
        _common(command)
        if name == chosen:
            _load(name).add_arguments(command)
    return parser


def _described(name: str) -> dict[str, object]:
    """Return all simulators, or the options of one, as plain data, for other command lines to present."""
    if name not in _rows(name):
        return {"simulators": {known: what for known, (_, what) in simulators().items()}}
    options = argparse.ArgumentParser(add_help=False, conflict_handler="resolve")
    _common(options)
    _load(name).add_arguments(options)
    # argparse has no public list of a parser's options.
    actions: list[argparse.Action] = options._actions
    return {
        "what": _rows(name)[name][1],
        "options": [
            {
                "flags": list(action.option_strings),
                "metavar": str(action.metavar or ""),
                "help": action.help or "",
                "default": "" if action.default in (None, False, "[]", ()) else str(action.default),
                "required": action.required,
                "flag": action.nargs == 0,
                "many": action.nargs == "+",
                "number": {int: "int", float: "float"}.get(cast(type, action.type), ""),
                "choices": [str(choice) for choice in action.choices or ()],
            }
            for action in actions
            if action.help != argparse.SUPPRESS
        ],
    }


def _common(command: argparse.ArgumentParser) -> None:
    command.add_argument("--faults", metavar="FILE|JSON", default="[]", help="fault plan: a JSON list or a file")
    command.add_argument(
        "--parent", type=int, default=0, metavar="PID", help="end when this process is no longer the parent"
    )
    command.add_argument("--log-level", default="WARNING", help="level of the log on stderr")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one simulator. Returns 0 after SIGTERM, 1 with the reason on stderr, 2 for wrong usage."""
    # One thread for linear algebra: its threads block one another when many processes share the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _keep_freed_memory()
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["--describe"]:
        sys.stdout.write(json.dumps(_described(words[1] if len(words) > 1 else "")) + "\n")
        return 0
    chosen = words[0] if words and words[0] in _rows(words[0]) else None
    try:
        with _unsearched():
            args = _parser(chosen).parse_args(words)
    except SimulatorError as error:
        sys.stderr.write(f"simulators: {error}\n")
        return 1
    logging.basicConfig(
        level=args.log_level.upper(), format=f"%(asctime)s {args.simulator} %(levelname)s %(message)s"
    )
    try:
        if isinstance(args.faults, str):
            args.faults = FaultPlan.parse(args.faults)
        if args.parent:
            end_with(args.parent)
        _load(args.simulator).serve(args)
    except SimulatorError as error:
        sys.stderr.write(f"simulators {args.simulator}: {error}\n")
        return 1
    return 0


@contextmanager
def _unsearched() -> Generator[None]:
    """Load modules inside this: Python's collector does not look for garbage among them, then or later."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _keep_freed_memory() -> None:
    """Keep freed memory: rendering allocates thousands of large arrays, and glibc would return each to the OS."""
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for option, value in ((-3, 32 << 20), (-1, 1 << 30)):  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD of malloc.h
            libc.mallopt(option, value)


if __name__ == "__main__":
    sys.exit(main())
