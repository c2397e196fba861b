"""What the scanners and the CT suite of a simulated rig deliver: options, sections of rig.yaml, commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from simulators.scan_station.scanners import SCANNERS, USUAL_SPACING_MM, chosen_format
from simulators.serve import SimulatorError

_HAND = "hand"
_MAIN = "scanner"  # the device that every rig has


def add_delivery_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--ct-voxel-mm", type=float, default=0.4, help="edge of the CT's voxels")
    parser.add_argument(
        "--ct-sends-to", metavar="HOST:PORT", help="the CT suite sends its series there instead of writing files"
    )
    parser.add_argument(
        "--scan-spacing-mm", type=float, default=USUAL_SPACING_MM, help="distance between the points of scans"
    )
    kinds = ", ".join(SCANNERS)
    parser.add_argument("--scanner", default=_HAND, metavar="NAME[/FORMAT]", help=f"of the device scanner: {kinds}")
    parser.add_argument(
        "--further-scanner",
        nargs="+",
        default=(),
        metavar="NAME[/FORMAT]",
        help="further scanners; the devices have their names, such as artec_leo or structured_light_obj",
    )


def check_delivery_arguments(args: argparse.Namespace) -> None:
    """Raise SimulatorError if there is no such scanner, or if its program does not export that format."""
    for text in _scanners(args).values():
        _kind(text)


def scanner_sections(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """The scanners' sections in rig.yaml: of a known scanner, the profile of its name."""
    return {device: _section(device, text) for device, text in _scanners(args).items()}


def delivery_words(args: argparse.Namespace, device: str, folder: Path, *, spray: bool) -> list[str]:
    """The command with which the CT (`ct`) or a scanner delivers. Raises LookupError if there is no such device."""
    if device == "ct":
        words = ["ct", "--folder", str(folder / "ct"), "--voxel-mm", str(args.ct_voxel_mm)]
        return [*words, *(["--send-to", args.ct_sends_to] if args.ct_sends_to else [])]
    scanners = _scanners(args)
    if device not in scanners:
        raise LookupError(f"there is no scanner {device!r}; {', '.join(scanners)}")
    scanner, kind = _kind(scanners[device])
    words = ["scanner", "--folder", str(folder / _folder(device)), "--scanner", scanner, "--format", kind]
    words += ["--spacing-mm", str(args.scan_spacing_mm)]
    return [*words, *(["--spray"] if spray else [])]


def scan_folders(args: argparse.Namespace) -> list[str]:
    """The folders to which the scanners export."""
    return [_folder(device) for device in _scanners(args)]


def _scanners(args: argparse.Namespace) -> dict[str, str]:
    return {_MAIN: args.scanner, **{text.replace("/", "_"): text for text in args.further_scanner}}


def _kind(text: str) -> tuple[str, str]:
    name, _, wanted = text.partition("/")
    if name not in SCANNERS:
        raise SimulatorError(f"there is no scanner {name!r}; {', '.join(SCANNERS)}")
    return name, chosen_format(name, wanted or None)


def _section(device: str, text: str) -> dict[str, Any]:
    scanner, _ = _kind(text)
    expected = {"unit": "mm"} if scanner == _HAND else {"profile": scanner}
    return {"driver": "scan_folder", "folder": _folder(device), **expected, "stable_s": 1.0}


def _folder(device: str) -> str:
    return "scans" if device == _MAIN else f"scans_{device}"
