"""Compiles the GenTL producer of the tests, and starts the simulated industrial camera to which it speaks."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.support.rig.simulator_process import simulator

_SOURCES = Path(__file__).parents[1] / "gentl"
ADDRESS_VARIABLE = "GENTL_CAMERA"  # of the environment, which tells the producer where the camera is


def compiled_producer(folder: Path) -> Path:
    """The producer as a file that harvesters loads; without gcc this fails."""
    file = folder / "producer.cti"
    sources = sorted(str(path) for path in _SOURCES.glob("*.c"))
    subprocess.run(
        ["gcc", "-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror", "-o", file, *sources], check=True
    )
    return file


@contextmanager
def industrial_camera(host: str, *words: str, faults: Sequence[Mapping[str, object]] = ()) -> Generator[None]:
    """The simulated camera at an address of the loopback; its images have 480 × 320 px."""
    plan = json.dumps([{"device": "camera", "on": "image", **fault} for fault in faults])
    with simulator("gige", "--host", host, "--image-width", "480", "--faults", plan, *words):
        yield
