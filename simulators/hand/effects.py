"""Effects of a hand on an image: camera shake during the exposure, or a finger in front of the lens."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, cast

import cv2
import numpy as np

from simulators.geometry import Bytes
from simulators.rendering.sensor import Light, colour_on

_SKIN = (205, 150, 125)  # RGB
P = TypeVar("P", Bytes, Light)


def hand_in_picture(picture: P, view: Mapping[str, Any]) -> P:
    """Apply the hand's effects, as given by the world's view, to a picture (H, W, 3)."""
    hand = view.get("hand") or {}
    out = _finger(picture) if hand.get("finger") else picture
    dx, dy = (float(part) * picture.shape[1] for part in hand.get("shake", (0.0, 0.0)))
    return _shaken(out, dx, dy) if abs(dx) + abs(dy) > 1.0 else out


def _shaken(picture: P, dx: float, dy: float) -> P:
    """Smear the picture along (dx, dy) pixels, at constant speed."""
    reach = int(np.ceil(max(abs(dx), abs(dy)) / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.float32)
    for t in np.linspace(-0.5, 0.5, 8 * reach):
        kernel[round(reach + t * dy), round(reach + t * dx)] += 1
    smeared = cv2.filter2D(picture, -1, kernel / kernel.sum())
    return cast("P", smeared.astype(picture.dtype))


def _finger(picture: P) -> P:
    """Draw a finger tip, out of focus, over the right third of the picture."""
    height, width = picture.shape[:2]
    mask = np.zeros((height, width), dtype=np.float32)
    centre, axes = (round(1.02 * width), round(0.6 * height)), (round(0.48 * width), round(0.45 * height))
    cv2.ellipse(mask, centre, axes, 25.0, 0.0, 360.0, 1.0, -1)
    mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), 0.02 * width), dtype=np.float32)[..., None]
    touched = picture * (1 - mask) + colour_on(picture, _SKIN) * mask
    return cast("P", touched.astype(picture.dtype))
