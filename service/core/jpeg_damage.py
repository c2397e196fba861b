"""Damage within the entropy-coded data of JPEG files, of which only a decoder knows.

A decoder takes up its work again after the damage, so that the picture looks whole: displaced or of another
brightness from there on. It warns of what did not fit, and OpenCV passes that on to the standard error stream of its
process only. Hence the files are decoded in a process of their own, at an eighth of their size, which is cheap.
JPEG has no checksum: damage that leaves a picture of the right length is not seen here either.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from service.core.errors import DataError
from service.core.picture_files import JPEG_BEGINS, end_of_jpeg

_ALLOWED_S, _ALLOWED_S_A_FILE = 60.0, 20.0
_FILE = re.compile(r"^decoding file (\d+)$", re.MULTILINE)
# libjpeg's messages, in each of its versions; others, such as of an unknown revision of JFIF, are no damage.
_DAMAGE = re.compile(
    r"^(?:Corrupt JPEG data: (?P<what>.*)|(?P<other>Inconsistent progression.*|Invalid SOS.*|Premature end.*))$",
    re.MULTILINE,
)
_SPARE = re.compile(r"(\d+) extraneous bytes before marker 0xd9")


def damaged_jpegs(files: Sequence[Path]) -> dict[Path, str]:
    """Return the damaged ones of complete JPEG files, with the decoder's messages.

    Files of other kinds are passed over. A file with which the decoder ends, or does not end, is a damaged one too.
    """
    found: dict[Path, str] = {}
    left = [file for file in files if _begins_as_jpeg(file)]  # without any, no process is started
    while left:
        said, end = _decoded(left)
        parts = _FILE.split(said)[1:]  # number, text, number, text, …
        begun = [(left[int(number)], words) for number, words in zip(parts[::2], parts[1::2], strict=True)]
        for file, words in begun:
            damage = _DAMAGE.search(words)
            if damage is not None and not _is_padding(file, damage["what"] or ""):
                found[file] = f"its picture is damaged within ({damage['what'] or damage['other']})"
        if not end:
            return found
        if not begun:
            raise DataError(f"pictures cannot be decoded: {end}", where=str(left[0]), remedy=said.strip()[-500:])
        found[begun[-1][0]] = f"its picture cannot be decoded ({end})"
        left = left[len(begun) :]
    return found


def _begins_as_jpeg(file: Path) -> bool:
    """Return whether a file begins as a JPEG does; whoever reads one that cannot be opened says so."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(JPEG_BEGINS)) == JPEG_BEGINS
    except OSError:
        return False


def _decoded(files: Sequence[Path]) -> tuple[str, str]:
    """Return what the decoder said of the files, and why it ended before the last one; "" if it did not."""
    names = b"\0".join(os.fsencode(file) for file in files)
    allowed_s = _ALLOWED_S + _ALLOWED_S_A_FILE * len(files)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", __name__],  # no module from where somebody happens to work
            input=names,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=allowed_s,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return (error.stderr or b"").decode(errors="replace"), f"the decoder did not end within {allowed_s:g} s"
    end = "" if done.returncode == 0 else f"the decoder ended with status {done.returncode}"
    return done.stderr.decode(errors="replace"), end


def _is_padding(file: Path, what: str) -> bool:
    """Return whether the decoder only warns of equal bytes with which a camera filled up the end of the picture."""
    spare = _SPARE.fullmatch(what)
    if spare is None:
        return False
    data = file.read_bytes()
    end = end_of_jpeg(data, str(file)) - 2
    filling = data[end - int(spare[1]) : end]
    return len(set(filling)) == 1 and filling[0] in (0x00, 0xFF)


def _decode_all() -> None:
    """Decode the files named on standard input; the decoder's warnings go to the standard error stream."""
    for number, name in enumerate(sys.stdin.buffer.read().split(b"\0")):
        os.write(2, f"decoding file {number}\n".encode())
        try:
            data = np.fromfile(os.fsdecode(name), np.uint8)
        except OSError:
            continue  # whoever reads the file next says so
        cv2.imdecode(data, cv2.IMREAD_REDUCED_GRAYSCALE_8)


if __name__ == "__main__":
    _decode_all()
