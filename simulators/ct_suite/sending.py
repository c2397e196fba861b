"""Sends a series over the network as a CT suite does (DICOM C-STORE), with the program storescu of dcmtk."""

from __future__ import annotations

import argparse
import shutil
import subprocess
from pathlib import Path

from simulators.serve import SimulatorError

_LONGEST_S = 600


def network_address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT")
    return host, int(port)


def send_series(folder: Path, host: str, port: int) -> None:
    """Send every file of a folder in one association, from CTSUITE to ORTHOCAPTURE."""
    if shutil.which("storescu") is None:
        raise SimulatorError("sending a series needs the program storescu: install dcmtk")
    words = ["storescu", "-aet", "CTSUITE", "-aec", "ORTHOCAPTURE", host, str(port), "+sd", str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=_LONGEST_S, check=False)
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise SimulatorError(f"{host}:{port} did not take the series: {said[-1] if said else 'storescu failed'}")
