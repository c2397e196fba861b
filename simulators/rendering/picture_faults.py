"""Faults that spoil a picture before it reaches the sensor: smeared lens, shake, no light, a cloth in the way."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, TypeVar, cast

import cv2
import numpy as np

from simulators.faults import Fault
from simulators.geometry import Bytes
from simulators.rendering.sensor import Light, colour_on

# Fault kinds of the message `image`: `smear` lasts until somebody cleans the lens; `blur`, `black` and `covered` last
# one picture. `value` is σ as a fraction of the picture's width (smear, blur), or the fraction of it that is covered.
_BLUR, _COVERED = 0.004, 0.5
_CLOTH = (60, 105, 120)  # RGB of a surgical drape
P = TypeVar("P", Bytes, Light)


class Lens:
    """The front of the lens: a smear stays until somebody cleans it. Thread-safe."""

    def __init__(self) -> None:
        self._smear = 0.0  # σ as a fraction of the picture's width
        self._cleanings = 0
        self._lock = threading.Lock()

    def picture(self, picture: P, fault: Fault | None, view: Mapping[str, Any]) -> P:
        """Return the picture (H, W, 3) seen through the lens, given the due fault and the world's view."""
        kind = fault.kind if fault is not None else ""
        value = fault.value if fault is not None else None
        share = float(value) if isinstance(value, int | float) else None
        with self._lock:
            if view.get("lens_cleanings", 0) != self._cleanings:
                self._smear, self._cleanings = 0.0, int(view["lens_cleanings"])
            if kind == "smear":
                self._smear = share or _BLUR
            smear = self._smear
        if kind == "black":
            return np.zeros_like(picture)
        if kind == "covered":
            picture = _covered(picture, share or _COVERED)
        blur = max(smear, share or _BLUR) if kind == "blur" else smear
        return _blurred(picture, blur) if blur > 0 else picture


def _blurred(picture: P, share: float) -> P:
    blurred = cv2.GaussianBlur(picture, (0, 0), share * picture.shape[1])
    return cast("P", blurred.astype(picture.dtype))


def _covered(picture: P, share: float) -> P:
    """Cover the left part of the picture with a folded cloth with an uneven edge."""
    height, width = picture.shape[:2]
    x, y = np.arange(width, dtype=np.float32)[None, :], np.arange(height, dtype=np.float32)[:, None]
    edge = width * share + 0.02 * width * np.sin(9.0 * y / height)
    folds = 0.8 + 0.2 * np.sin(25.0 * (x + 0.4 * y) / width)
    cloth = folds[..., None] * colour_on(picture, _CLOTH)
    return cast("P", np.where((x < edge)[..., None], cloth, picture).astype(picture.dtype))
