"""The colour of the spheres: named colours, and distances between colours independent of the light's strength."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.core.errors import ConfigurationError
from service.core.geometry import Array

Colour = tuple[float, float, float]  # B, G, R as coded in an image, 0..255

# Typical matte plastic under neutral light, and the chromaticity tolerance for spheres of that name.
NAMED_BGR: Mapping[str, tuple[Colour, float]] = {
    "white": ((230.0, 230.0, 230.0), 0.16),
    "grey": ((140.0, 140.0, 140.0), 0.16),
    "green": ((75.0, 200.0, 130.0), 0.3),  # from yellowish to dark green
    "orange": ((56.0, 139.0, 236.0), 0.22),
}
_HEX_TOLERANCE = 0.18  # covers the light's colour and the camera's white balance
_ALIKE = 0.07  # largest distance of discs of one colour
_LEARNT_TOLERANCE = (0.1, 0.16)  # smallest and largest tolerance of a learnt colour
_PALEST = 0.2  # saturation of a pale picture over that of the named colour
_SAME_HUE_RAD = 0.45
_MEMBERS = 3  # least number of discs from which a colour is learnt


@dataclass(frozen=True, slots=True)
class ColourModel:
    """The chromaticity (2,) of the spheres in an image, and its tolerance for single pixels."""

    middle: Array
    tolerance: float
    srgb: bool
    palest: float = 1.0  # least saturation over that of `middle`; below 1, the hue decides, not the saturation

    def distance(self, colours_bgr: Array) -> Array:
        """(N,) distance of colours (N, 3) in tolerances; up to 1 is a sphere's colour."""
        tones = chromaticity(colours_bgr, srgb=self.srgb)
        if self.palest == 1.0:
            return np.linalg.norm(tones - self.middle, axis=1) / self.tolerance
        saturation = float(np.linalg.norm(self.middle))
        along, across = (tones @ [u, v] / saturation for u, v in _axes(self.middle / saturation))
        off = np.abs(np.arctan2(across, along)) / _SAME_HUE_RAD
        return np.asarray(np.where(np.hypot(along, across) < self.palest, 9.0, off), dtype=np.float64)

    def paler(self) -> ColourModel | None:
        """The model for pale pictures of cheap cameras, by its hue; None if the colour has hardly any saturation."""
        pale = float(np.linalg.norm(self.middle)) > 2 * self.tolerance
        return replace(self, palest=_PALEST) if pale else None


def _axes(unit: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    u, v = (float(x) for x in unit)
    return (u, v), (-v, u)


def colour_of(text: str) -> tuple[Colour, float]:
    """A colour and its chromaticity tolerance from a name (white, grey, green, orange) or #rrggbb.

    Raises:
        ConfigurationError: neither a known name nor #rrggbb.
    """
    word = text.strip().lower()
    if word in NAMED_BGR:
        return NAMED_BGR[word]
    if len(word) == 7 and word[0] == "#" and all(c in "0123456789abcdef" for c in word[1:]):
        r, g, b = (int(word[i : i + 2], 16) for i in (1, 3, 5))
        return (float(b), float(g), float(r)), _HEX_TOLERANCE
    raise ConfigurationError(
        f"{text!r} is not a known sphere colour", remedy=f"Give one of {', '.join(NAMED_BGR)}, or #rrggbb"
    )


def learn_colour(colours_bgr: Array, weights: Array, clear: NDArray[np.bool_], *, srgb: bool) -> ColourModel | None:
    """The colour that most of the discs share, since all spheres have one colour; None if too few agree.

    Args:
        colours_bgr: (N, 3) median colours of discs.
        weights: (N,) how much each looks like a sphere.
        clear: (N,) discs that pass every test by themselves; at least one must have the colour.
        srgb: whether the values are sRGB coded.
    """
    if len(colours_bgr) < _MEMBERS:
        return None
    tones = chromaticity(colours_bgr, srgb=srgb)
    near = np.linalg.norm(tones[:, None] - tones[None], axis=2) < _ALIKE
    total = near @ weights
    members = near[int(np.argmax(total))]
    if members.sum() < _MEMBERS or not np.any(members & clear) or float(total.max()) < 0.4 * float(weights.sum()):
        return None
    middle = np.median(tones[members], axis=0)
    spread = float(np.median(np.linalg.norm(tones[members] - middle, axis=1)))
    return ColourModel(middle, float(np.clip(4 * spread, *_LEARNT_TOLERANCE)), srgb)


def given_colour(colour_bgr: Colour, tolerance: float, *, srgb: bool) -> ColourModel:
    """The model of a colour known in advance."""
    return ColourModel(chromaticity(np.array([colour_bgr]), srgb=srgb)[0], tolerance, srgb)


def chromaticity(colours_bgr: Array, *, srgb: bool = True) -> Array:
    """(N, 2) opponent colours over the channel sum, of colours (N, 3) 0..255; independent of the light's strength.

    They are red minus green and blue minus yellow, divided by the sum: a stronger lamp scales all channels alike.
    """
    x = np.asarray(colours_bgr, dtype=np.float64).reshape(-1, 3) / 255
    if srgb:
        x = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    total = np.maximum(x.sum(axis=1), 0.02)  # black has no colour
    b, g, r = x.T
    return np.stack([(r - g) / total, (b - 0.5 * (r + g)) / total], axis=1)
