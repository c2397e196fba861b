"""The fixed parameters with which raw files are developed; read by steps, which load no image library."""

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
