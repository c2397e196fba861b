"""What the programs of known scanners export, and the options that choose a scanner."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from simulators.serve import SimulatorError


@dataclass(frozen=True, slots=True)
class Scanner:
    """A scanner and its program's exports.

    Attributes:
        formats: that it exports, the usual one first; `view` is a PLY with one point for each pixel of the sensor.
        pixels: columns and rows of its sensor, where it exports views.
        missing: coordinate of a pixel that measured nothing.
        normals: whether a view has them.
        colours: whether a view has them.
    """

    formats: tuple[str, ...]
    pixels: tuple[int, int] = (0, 0)
    missing: float = 0.0
    normals: bool = False
    colours: bool = False


SCANNERS = {
    "hand": Scanner(("ply", "obj", "stl")),
    "artec_leo": Scanner(("obj", "ply", "stl")),
    "artec_space_spider": Scanner(("ply", "obj", "stl")),
    "shining3d": Scanner(("stl", "obj", "ply")),
    "structured_light": Scanner(("e57", "ply", "obj", "stl"), pixels=(960, 600)),
    "zivid": Scanner(("view",), pixels=(972, 600), missing=float("nan"), colours=True),
    "photoneo": Scanner(("view",), pixels=(1032, 772), normals=True),
}
FORMATS = tuple(dict.fromkeys(name for scanner in SCANNERS.values() for name in scanner.formats))
VIEWS = ("view", "e57")  # formats that hold views, no mesh


def add_scanner_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that choose the scanner and its format; a rig has them too."""
    parser.add_argument("--scanner", choices=tuple(SCANNERS), default="hand", help="whose exports they are")
    parser.add_argument("--format", choices=FORMATS, help="of the export; default: the usual one of the scanner")
    parser.add_argument(
        "--views", type=int, default=1, metavar="N", help="views of one scan, each from another place"
    )


def chosen_format(args: argparse.Namespace) -> str:
    """The format of the export. Raises SimulatorError if the scanner's program does not write it."""
    formats = SCANNERS[args.scanner].formats
    if args.format is not None and args.format not in formats:
        raise SimulatorError(f"--scanner {args.scanner} exports {', '.join(formats)}, not {args.format}")
    chosen = args.format or formats[0]
    if args.views > 1 and chosen not in VIEWS:
        raise SimulatorError(f"--views is for a scanner that exports views, not for {chosen}")
    return chosen
