"""What scanner and CT suite of a simulated rig deliver: the rig's options, section of rig.yaml, commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from simulators.scan_station.scanners import add_scanner_arguments, chosen_format


def add_delivery_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--ct-voxel-mm", type=float, default=0.4, help="edge of the CT's voxels")
    parser.add_argument(
        "--ct-sends-to", metavar="HOST:PORT", help="the CT suite sends its series there instead of writing files"
    )
    add_scanner_arguments(parser)


def check_delivery_arguments(args: argparse.Namespace) -> None:
    """Raise SimulatorError if the scanner does not export as the options say."""
    chosen_format(args)


def scanner_section(args: argparse.Namespace) -> dict[str, Any]:
    """The scanner's section in rig.yaml: of a known scanner, the profile of its name."""
    expected = {"unit": "mm"} if args.scanner == "hand" else {"profile": args.scanner}
    return {"driver": "scan_folder", "folder": "scans", **expected, "stable_s": 1.0}


def scanner_words(args: argparse.Namespace, folder: Path, *, spray: bool) -> list[str]:
    """The command that exports a scan."""
    words = ["scanner", "--folder", str(folder / "scans"), "--scanner", args.scanner, "--views", str(args.views)]
    return [*words, *(["--format", args.format] if args.format else []), *(["--spray"] if spray else [])]


def ct_words(args: argparse.Namespace, folder: Path) -> list[str]:
    """The command that delivers a series."""
    words = ["ct", "--folder", str(folder / "ct"), "--voxel-mm", str(args.ct_voxel_mm)]
    return [*words, *(["--send-to", args.ct_sends_to] if args.ct_sends_to else [])]
