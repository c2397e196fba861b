"""The words of libraries do not reach a person's terminal: real processes, with files that libraries dislike."""

from __future__ import annotations

import logging
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.logs import ASKED, is_own
from tests.support.ct.ct_series import write_series
from tests.support.rig.rig import REPOSITORY, command

AFTER = """
import logging, sys
from service.cli import main as program
program.app = lambda: None
program.main()
import pydicom, trimesh, tifffile, PIL.Image, warnings
for name in ("pydicom", "trimesh", "tifffile", "PIL", "asyncio", "pynetdicom.acse"):
    logging.getLogger(name).error("words of %s", name)
warnings.warn("words of a warning")
logging.getLogger("drivers.ur").warning("the arm is busy")
logging.getLogger("orthocapture.web").error("a page failed")
"""


def _said(*command: str | Path, **environment: str) -> str:
    """What a process of its own writes to its error stream and its output."""
    done = subprocess.run(
        command,
        cwd=REPOSITORY,
        env={**{k: v for k, v in os.environ.items() if not k.startswith("OPENCV_")}, "COLUMNS": "80", **environment},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.slow
def test_a_series_of_which_pydicom_complains_is_told_of_in_our_words(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", uid="1.2.3.45")
    for path in (tmp_path / "ct").iterdir():  # a leading zero, which a part of a UID may not have
        path.write_bytes(path.read_bytes().replace(b"1.2.3.45", b"1.2.3.05"))
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"name: ct\ndevices:\n  ct: {{driver: dicom_folder, folder: {tmp_path / 'ct'}, stable_s: 0}}\n")
    words = command("doctor", "--rig", str(rig), "--data", str(tmp_path / "data"))
    said = _said(*words)
    assert "DICOM folder" in said
    assert "Invalid value" not in said, said
    assert "Invalid value" in _said(*words, **{ASKED: "1"}), "pydicom complains of these files"


@pytest.mark.slow
def test_no_library_speaks_whatever_its_import_sets(tmp_path: Path) -> None:
    said = _said(sys.executable, "-c", AFTER)
    assert "words of" not in said, said
    assert "drivers.ur WARNING the arm is busy" in said
    assert "orthocapture.web ERROR a page failed" in said
    shown = _said(sys.executable, "-c", AFTER, **{ASKED: "1"})
    assert "pydicom ERROR words of pydicom" in shown
    assert "words of a warning" in shown


def test_what_the_decoders_of_pictures_print_does_not_appear(tmp_path: Path) -> None:
    """libjpeg, libpng, libtiff and FFmpeg write to the error stream themselves, past every logger."""
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    jpeg, png = (cv2.imencode(kind, pixels)[1].tobytes() for kind in (".jpg", ".png"))
    end = jpeg.rindex(b"\xff\xd9")
    profile = b"iCCPx\0\0" + zlib.compress(b"no profile")
    chunk = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    contents = {"a.jpg": jpeg[:end] + bytes(20) + jpeg[end:], "b.png": png[:33] + chunk + png[33:]}
    contents |= {"c.mp4": b"\0\0\0\x18ftypmp42\0\0\0\0isommp42" + bytes(500)}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    reading = (
        "import os, sys\nfrom service.cli import main as program\nprogram.app = lambda: None\nprogram.main()\n"
        "import cv2\n"
        f"for name in ('a.jpg', 'b.png', 'none.png'): cv2.imread(os.path.join({str(tmp_path)!r}, name))\n"
        f"cv2.VideoCapture({str(tmp_path / 'c.mp4')!r}, cv2.CAP_FFMPEG)\nprint('own words', file=sys.stderr)\n"
    )
    assert _said(sys.executable, "-c", reading) == "own words\n"
    shown = _said(sys.executable, "-c", reading, **{ASKED: "1"})
    for words in ("Corrupt JPEG data", "libpng warning", "can't open/read file", "moov atom not found"):
        assert words in shown


@pytest.mark.parametrize(
    ("name", "own"),
    [("service.worker", True), ("drivers.host.camera", True), ("orthocapture", True), ("pydicom", False),
     ("servicebus", False), ("py.warnings", False)],
)  # fmt: skip
def test_whose_record_it_is(name: str, own: bool) -> None:
    assert is_own(logging.LogRecord(name, logging.WARNING, "", 1, "words", None, None)) is own
