"""The fixed parameters with which raw files are developed; read by steps, which load no image library."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DevelopParameters:
    """How every raw file is developed; recorded with each picture, and the same for all.

    Attributes:
        demosaic: LibRaw's algorithm, by rawpy's name of it; chosen by bench/markers/raw_gain.py.
        white_balance: `camera`: the gains that the camera recorded for the exposure.
        primaries: of the picture's colours; the colour matrix is the file's or, without one, LibRaw's for the model.
        gamma: power and slope of the transfer curve; 1, 1 is linear.
        highlights: what becomes of saturated channels.
        auto_brightness: whether the content decides the brightness.
        noise_reduction: of any kind.
        orientation: 0: as the sensor read it out.
        bits: of a channel.
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
