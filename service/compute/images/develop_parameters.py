"""How raw files are developed: the fixed parameters, and the part that is cut out. Loads no image library."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DevelopParameters:
    """The parameters with which every raw file is developed; recorded with each picture, and the same for all.

    Attributes:
        demosaic: LibRaw's algorithm, by rawpy's name of it; chosen by bench/markers/raw_gain.py.
        white_balance: `camera`: the gains that the camera recorded for the exposure.
        primaries: primaries of the picture's colours; the colour matrix is the file's or, without one, LibRaw's for
            the model.
        gamma: power and slope of the transfer curve; 1, 1 is linear.
        highlights: treatment of saturated channels.
        auto_brightness: true if the content decides the brightness.
        noise_reduction: true if noise is reduced in any way.
        orientation: 0: as the sensor read it out.
        bits: bits of a channel.
    """

    demosaic: str = "VNG"
    white_balance: str = "camera"
    primaries: str = "sRGB"
    gamma: tuple[float, float] = (1.0, 1.0)
    highlights: str = "Clip"
    auto_brightness: bool = False
    noise_reduction: bool = False
    orientation: int = 0
    bits: int = 16


PARAMETERS = DevelopParameters()


@dataclass(frozen=True, slots=True)
class Crop:
    """The part of the developed area that the JPEG shows, in pixels of that area.

    `found` says where it comes from: `file`: the raw file names it; `moved`: the file names another, and the JPEG
    shows this one; `matched`: the file names none of the JPEG's size, so it was found by comparison with the JPEG.
    """

    left: int
    top: int
    width: int
    height: int
    found: str
