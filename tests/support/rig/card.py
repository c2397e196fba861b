"""The memory card of a camera without a cable: photographs with EXIF, copied by another process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from simulators.rendering.sensor import bordered, read_out
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw

BEGAN = datetime(2026, 11, 21, 10, 0, tzinfo=UTC)
_COPY = """\
import sys
target, source = sys.argv[1:]
data = open(source, "rb").read()
with open(target, "wb") as stream:
    stream.write(data[: len(data) // 2])
    stream.flush()
    print("half", flush=True)
    if sys.stdin.readline():
        stream.write(data[len(data) // 2 :])
"""


def photograph(number: int, taken: datetime, *, iso: int = 100, raw: bool = False) -> bytes:
    """A small image file, different for each number."""
    settings = ExposureSettings(22.0, 1 / 50, (1, 50), iso, on_card=True)
    picture = np.full((64, 96, 3), 40 + number, dtype=np.uint8)
    picture[number % 64] = 255
    shot = Shot(settings, number, taken, PLATE)
    return encode_raw(read_out(bordered(picture), iso, number), shot) if raw else encode_jpeg(picture, shot)


def after(seconds: float) -> datetime:
    """A time this long after the beginning."""
    return BEGAN + timedelta(seconds=seconds)


def put(folder: Path, name: str, data: bytes) -> Path:
    """Copy a file to the folder by another process; it is complete when this returns."""
    with half_copied(folder, name, data) as path:
        pass
    return path


@contextmanager
def half_copied(folder: Path, name: str, data: bytes, *, whole: bool = True) -> Generator[Path]:
    """Let another process copy half a file and pause; at the end of the block it finishes, or gives up."""
    source = folder.parent / f"{name}.source"
    source.write_bytes(data)
    command = [sys.executable, "-I", "-S", "-c", _COPY, str(folder / name), str(source)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "half\n"
        yield folder / name
        if whole:
            process.stdin.write("go on\n")
        process.stdin.close()
        assert process.wait(90) == 0
    source.unlink()
