"""How photographs are taken and developed: the views of a board, the optics as calibrated, and how raw files
become pictures. Loads no image library.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from service.core.errors import DataError


@dataclass(frozen=True, slots=True)
class ViewRange:
    """The wanted range of views of the board."""

    tilts_deg: tuple[float, ...] = (4.0, 14.0, 24.0, 32.0, 38.0)  # of the optical axis from the board's normal
    rolls_deg: tuple[float, ...] = (0.0, 12.0, -12.0, 180.0, 168.0, 192.0)  # of the image about the optical axis
    distances_m: tuple[float, ...] = (0.62, 0.68, 0.74)
    azimuths: int = 16


# Relative differences that count as equal: EXIF rounds focal length and aperture; focus encoders are coarse.
_TOLERANCE = {"focal_length_mm": 0.005, "aperture_f": 0.02, "focus_distance_m": 0.02}
_FOCUS_STEPS = 1  # rounding of a focus motor that stands still
_FIELDS = (
    "width", "height", "focal_length_mm", "aperture_f", "focus_distance_m", "focus_mode", "focus_position", "lens",
    "lens_serial", "body", "body_serial",
)  # fmt: skip
_NAMED = 5  # images named in a line of the summary


@dataclass(frozen=True, slots=True)
class Optics:
    """The optics recorded in an image file; None or "" for unknown values."""

    image: str
    width: int | None = None
    height: int | None = None
    focal_length_mm: float | None = None
    aperture_f: float | None = None
    focus_distance_m: float | None = None
    focus_mode: str = ""
    focus_position: int | None = None  # of the focus motor, in its own steps
    lens: str = ""
    lens_serial: str = ""
    body: str = ""
    body_serial: str = ""


@dataclass(frozen=True, slots=True)
class OpticsDeparture:
    """A property of an image that differs from the calibration."""

    image: str
    field: str
    calibrated: str
    found: str

    def __str__(self) -> str:
        return f"{self.image}: {self.field} {self.found}, calibrated at {self.calibrated}"


@dataclass(frozen=True, slots=True)
class OpticsComparison:
    """The differences, the properties compared, and those that the files do not contain."""

    departures: tuple[OpticsDeparture, ...]
    compared: tuple[str, ...]
    unknown: tuple[str, ...]

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images with differences, each once, in order."""
        return tuple(dict.fromkeys(departure.image for departure in self.departures))


def summary(departures: Sequence[OpticsDeparture]) -> tuple[str, ...]:
    """Return one line for each kind of difference, with the images that share it."""
    alike: dict[tuple[str, str, str], list[str]] = {}
    for departure in departures:
        alike.setdefault((departure.field, departure.found, departure.calibrated), []).append(departure.image)
    return tuple(
        f"{field} {found}, calibrated at {calibrated}: {', '.join(images[:_NAMED])}"
        + (f" and {len(images) - _NAMED} more" if len(images) > _NAMED else "")
        for (field, found, calibrated), images in alike.items()
    )


def compare_optics(calibration: Sequence[Optics], capture: Sequence[Optics]) -> OpticsComparison:
    """Compare images with those of the calibration, property by property.

    The calibrated value is the one that most of the calibration's images report. Focus, aperture and zoom change the
    focal length and the distortion; another lens, body or image size is another camera. Exposure time and ISO do not
    matter. Pass the calibration's own images as `capture` to check it for changes within.

    Args:
        calibration: optics of the images used for the calibration.
        capture: optics of the images to be used with it.

    Raises:
        DataError: one of the two is empty.
    """
    if not calibration or not capture:
        raise DataError(
            "no images to compare the optics of", remedy="Give the calibration's and the capture's images"
        )
    departures: list[OpticsDeparture] = []
    compared: list[str] = []
    for field in _FIELDS:
        stated = [getattr(optics, field) for optics in calibration]
        stated = [value for value in stated if value not in (None, "")]
        found = [(optics.image, getattr(optics, field)) for optics in capture]
        found = [(image, value) for image, value in found if value not in (None, "")]
        if not stated or not found:
            continue
        compared.append(field)
        reference = Counter(stated).most_common(1)[0][0]
        departures += [
            OpticsDeparture(image, field, _text(reference), _text(value))
            for image, value in found
            if not _same(field, value, reference)
        ]
    order = {optics.image: k for k, optics in enumerate(capture)}
    departures.sort(key=lambda departure: order[departure.image])
    unknown = tuple(field for field in _FIELDS if field not in compared)
    return OpticsComparison(tuple(departures), tuple(compared), unknown)


def _same(field: str, value: object, reference: object) -> bool:
    if field == "focus_position":
        return abs(int(str(value)) - int(str(reference))) <= _FOCUS_STEPS
    tolerance = _TOLERANCE.get(field)
    if tolerance is None or not isinstance(value, int | float) or not isinstance(reference, int | float):
        return value == reference
    return abs(value - reference) <= tolerance * abs(reference)


def states_focus(optics: Sequence[Optics]) -> bool:
    """Return whether the images would reveal a change of focus; the focus mode alone does not."""
    return all(one.focus_position is not None or one.focus_distance_m is not None for one in optics)


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, int | float) else str(value)


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
