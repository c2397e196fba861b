"""A camera on a named pipe: Pillow writes JPEG files one after another, in a process of its own.

Standard output gets one JSON line for each, before it is written: its SHA-256 and this computer's monotonic clock.
"""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image


def jpeg(number: int, size: tuple[int, int] = (160, 120)) -> bytes:
    """An image of a noisy sensor, different for each number."""
    pixels = np.random.default_rng(number).integers(90, 120, (size[1], size[0], 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=92)
    return file.getvalue()


@contextmanager
def camera_on(pipe: Path, log: Path, *, first: int = 0, frozen: bool = False) -> Generator[subprocess.Popen[bytes]]:
    """Write 25 images a second to the pipe; `log` gets the lines."""
    words = [sys.executable, "-m", "tests.support.vendor.mjpeg_writer", str(pipe), str(first), str(int(frozen))]
    with log.open("wb") as lines, subprocess.Popen(words, stdout=lines) as process:
        try:
            yield process
        finally:
            process.kill()


def _main(pipe: str, first: int, frozen: bool) -> None:
    number = first
    with Path(pipe).open("wb") as stream:
        while True:
            data = jpeg(first if frozen else number)
            line = {"sha256": hashlib.sha256(data).hexdigest(), "monotonic_s": time.monotonic()}
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()
            stream.write(data)
            stream.flush()
            number += 1
            time.sleep(0.04)


if __name__ == "__main__":
    _main(sys.argv[1], int(sys.argv[2]), sys.argv[3] == "1")
