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
        views: the number of views of one scan, as people take it with this scanner.
    """

    formats: tuple[str, ...]
    pixels: tuple[int, int] = (0, 0)
    missing: float = 0.0
    normals: bool = False
    colours: bool = False
    views: int = 1


SCANNERS = {
    "hand": Scanner(("ply", "obj", "stl")),
    "artec_leo": Scanner(("obj", "ply", "stl")),
    "artec_space_spider": Scanner(("ply", "obj", "stl")),
    "shining3d": Scanner(("stl", "obj", "ply")),
    "structured_light": Scanner(("e57", "ply", "obj", "stl"), pixels=(960, 600), views=4),
    "zivid": Scanner(("view",), pixels=(972, 600), missing=float("nan"), colours=True, views=3),
    "photoneo": Scanner(("view",), pixels=(1032, 772), normals=True, views=3),
}
FORMATS = tuple(dict.fromkeys(name for scanner in SCANNERS.values() for name in scanner.formats))
USUAL_SPACING_MM = 0.5  # of the vertices on spheres, where it exports a mesh
VIEWS = ("view", "e57")  # formats that hold views, no mesh


def add_scanner_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that choose the scanner and its format."""
    parser.add_argument("--scanner", choices=tuple(SCANNERS), default="hand", help="whose exports they are")
    parser.add_argument("--format", choices=FORMATS, help="of the export; default: the usual one of the scanner")
    parser.add_argument("--views", type=int, metavar="N", help="views of one scan; default: as usual for the scanner")


def chosen_format(scanner: str, wanted: str | None) -> str:
    """The format of a scanner's export. Raises SimulatorError if its program does not write the wanted one."""
    formats = SCANNERS[scanner].formats
    if wanted is not None and wanted not in formats:
        raise SimulatorError(f"the program of {scanner} exports {', '.join(formats)}, not {wanted}")
    return wanted or formats[0]
