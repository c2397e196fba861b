"""Pixel formats of GenICam (GenICam Pixel Format Naming Convention 2.1) that become photographs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.genicam.link import Frame

# Name → code on the wire, and OpenCV's conversion to BGR; None: grey. OpenCV's names have the first square of the
# pattern, GenICam's its first two pixels.
FORMATS: dict[str, tuple[int, int | None]] = {
    "Mono8": (0x01080001, None),
    "BayerGR8": (0x01080008, cv2.COLOR_BayerGRBG2BGR_EA),
    "BayerRG8": (0x01080009, cv2.COLOR_BayerRGGB2BGR_EA),
    "BayerGB8": (0x0108000A, cv2.COLOR_BayerGBRG2BGR_EA),
    "BayerBG8": (0x0108000B, cv2.COLOR_BayerBGGR2BGR_EA),
    "RGB8": (0x02180014, cv2.COLOR_RGB2BGR),
}


def picture(frame: Frame, name: str) -> NDArray[np.uint8] | None:
    """(H, W) grey or (H, W, 3) BGR pixels of an image; None if it is not of this format, or incomplete."""
    code, conversion = FORMATS[name]
    channels = 3 if name == "RGB8" else 1
    wanted = frame.height * frame.width * channels
    if frame.code != code or len(frame.data) < wanted or not wanted:
        return None
    pixels = np.frombuffer(frame.data, np.uint8, wanted)
    shaped = pixels.reshape(frame.height, frame.width, channels) if channels > 1 else pixels.reshape(frame.height, -1)
    return shaped if conversion is None else np.asarray(cv2.cvtColor(shaped, conversion), dtype=np.uint8)
