"""Develops raw files with fixed parameters to linear 16-bit pictures that match the JPEG of the same exposure."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from service.compute.descent import gauss_newton
from service.compute.photography import PARAMETERS, Crop, DevelopParameters
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array

Pixels16 = NDArray[np.uint16]
_P = TypeVar("_P", NDArray[np.uint8], Pixels16)
INSTALL = 'pip install "orthocapture[raw]"'
MOST_SHIFT_PX = 0.25  # of the developed picture against the JPEG; half a pixel would be another convention
_MOST_ROOM_PX = 160  # around the JPEG in the exposed area; cameras leave out some tens of pixels
_TIFF = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE,
         cv2.IMWRITE_TIFF_PREDICTOR, cv2.IMWRITE_TIFF_PREDICTOR_HORIZONTAL]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Development:
    """The record of a development.

    Attributes:
        parameters: the fixed parameters.
        white_balance: gains of red, green, blue and second green that the camera recorded (0: as the first green).
        black_level: black level of the four photosites of the pattern.
        white_level: white level of the sensor's values.
        area: width and height of the exposed area.
        crop: the picture's crop in it.
        shift_px: median shift of the picture against the JPEG in x and y; None without a JPEG.
        largest_shift_px: largest shift of a part of the picture; None without a JPEG.
        rawpy: rawpy's version.
        libraw: LibRaw's version.
    """

    parameters: DevelopParameters
    white_balance: tuple[float, ...]
    black_level: tuple[int, ...]
    white_level: int
    area: tuple[int, int]
    crop: Crop
    shift_px: tuple[float, float] | None
    largest_shift_px: float | None
    rawpy: str
    libraw: str


@dataclass(frozen=True, slots=True)
class Developed:
    """A picture (H, W, 3) BGR, linear, 65535 at saturation, of the size of the JPEG; and how it was made."""

    image_bgr: Pixels16
    how: Development


def develop(path: Path, jpeg_bgr: NDArray[np.uint8] | None, parameters: DevelopParameters = PARAMETERS) -> Developed:
    """Develop a raw file.

    Args:
        path: any raw format that LibRaw reads, such as ARW, CR3, NEF or DNG.
        jpeg_bgr: (H, W, 3) the JPEG of the same exposure, as stored. The picture gets its size, and its place is
            checked. None: the crop that the file names, unchecked.
        parameters: fixed for a series of pictures.

    Raises:
        ConfigurationError: rawpy is not installed, or it does not know the demosaic algorithm.
        DataError: the file cannot be developed, has no part that matches the JPEG, or the JPEG was corrected for
            distortion by the camera.
    """
    rawpy = _rawpy()
    options = _options(rawpy, parameters)
    try:
        with rawpy.imread(str(path)) as raw:
            area = np.ascontiguousarray(raw.postprocess(**options)[..., ::-1], dtype=np.uint16)
            sizes = raw.sizes
            white_balance = tuple(float(gain) for gain in raw.camera_whitebalance)
            black_level = tuple(int(level) for level in raw.black_level_per_channel)
            white_level = int(raw.white_level)
    except rawpy.LibRawError as error:
        raise DataError(
            f"the raw file cannot be developed: {_words(error)}",
            where=str(path),
            remedy="Copy the file from the camera again; if it is whole, LibRaw does not know the model yet",
        ) from error
    named = _named_crop(sizes)
    crop, shift, largest = (named, None, None) if jpeg_bgr is None else _matched(area, jpeg_bgr, named, path)
    how = Development(
        parameters=parameters,
        white_balance=white_balance,
        black_level=black_level,
        white_level=white_level,
        area=(area.shape[1], area.shape[0]),
        crop=crop,
        shift_px=shift,
        largest_shift_px=largest,
        rawpy=str(rawpy.__version__),
        libraw=".".join(map(str, rawpy.libraw_version)),
    )
    return Developed(np.ascontiguousarray(_part(area, crop)), how)


def encode_tiff(image_bgr: Pixels16) -> bytes:
    """Encode a picture (H, W, 3) BGR as a TIFF with 16 bits a channel, compressed without loss."""
    return cv2.imencode(".tif", image_bgr, _TIFF)[1].tobytes()


def read_developed(path: Path) -> Pixels16:
    """Read (H, W, 3) BGR of a TIFF that `encode_tiff` wrote. Raises DataError if it is not such a file."""
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None or image.dtype != np.uint16 or image.ndim != 3:
        raise DataError(
            "this is not a developed picture with 16 bits a channel",
            where=str(path),
            remedy="Develop the raw file with `orthocapture develop`",
        )
    return np.asarray(image, dtype=np.uint16)


def coded(linear: Pixels16) -> Pixels16:
    """Encode linear values as sRGB-coded ones with 16 bits (IEC 61966-2-1)."""
    return _CODE[linear]


def eight_bits(coded_bgr: Pixels16) -> NDArray[np.uint8]:
    """Return sRGB-coded values with 16 bits, rounded to 8."""
    return ((coded_bgr.astype(np.uint32) + 128) // 257).astype(np.uint8)


def _code_table() -> Pixels16:
    x = np.arange(65536) / 65535
    y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(65535 * y).astype(np.uint16)


_CODE = _code_table()


def _rawpy() -> Any:
    try:
        return importlib.import_module("rawpy")
    except ImportError as error:
        raise ConfigurationError(
            "raw files cannot be developed: rawpy is not installed", where="extra raw", remedy=f"Run: {INSTALL}"
        ) from error


def _options(rawpy: Any, parameters: DevelopParameters) -> dict[str, Any]:
    """Return the parameters as rawpy takes them; those that it would otherwise choose by the content are set too."""
    names = [algorithm.name for algorithm in rawpy.DemosaicAlgorithm]
    if parameters.demosaic not in names:
        raise ConfigurationError(
            f"there is no demosaic algorithm {parameters.demosaic}",
            where="demosaic",
            remedy=f"Use {', '.join(names)}",
        )
    return {
        "demosaic_algorithm": rawpy.DemosaicAlgorithm[parameters.demosaic],
        "use_camera_wb": parameters.white_balance == "camera",
        "output_color": rawpy.ColorSpace[parameters.primaries],
        "gamma": parameters.gamma,
        "highlight_mode": rawpy.HighlightMode[parameters.highlights],
        "no_auto_bright": not parameters.auto_brightness,
        "fbdd_noise_reduction": rawpy.FBDDNoiseReductionMode.Off,
        "median_filter_passes": 0,
        "user_flip": parameters.orientation,
        "output_bps": parameters.bits,
        "adjust_maximum_thr": 0.0,  # otherwise the brightest pixel may lower the white level
        "bright": 1.0,
    }


def _named_crop(sizes: Any) -> Crop:
    """Return the crop that the file names, in pixels of the developed area; all of the area if it names none."""
    left, top = sizes.crop_left_margin - sizes.left_margin, sizes.crop_top_margin - sizes.top_margin
    inside = left >= 0 and top >= 0 and left + sizes.crop_width <= sizes.width
    if sizes.crop_width and inside and top + sizes.crop_height <= sizes.height:
        return Crop(left, top, sizes.crop_width, sizes.crop_height, "file")
    return Crop(0, 0, sizes.width, sizes.height, "file")


def _matched(
    area: Pixels16, jpeg_bgr: NDArray[np.uint8], named: Crop, path: Path
) -> tuple[Crop, tuple[float, float], float]:
    """Return the crop whose pixels are the JPEG's, its shift against the JPEG, and the largest shift of a part."""
    height, width = jpeg_bgr.shape[:2]
    room = area.shape[1] - width, area.shape[0] - height
    if min(room) < 0 or max(room) > _MOST_ROOM_PX:
        raise DataError(
            f"the raw file has {area.shape[1]} × {area.shape[0]} pixels and the JPEG {width} × {height}: "
            "they are not two pictures of one size",
            where=str(path),
            remedy="Set the camera to JPEGs of full size (L), and give the JPEG of the same exposure",
        )
    crop = named
    if (named.width, named.height) != (width, height):
        crop = Crop(room[0] // 2, room[1] // 2, width, height, "matched")
    grey = np.asarray(cv2.cvtColor(jpeg_bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    whole = np.asarray(cv2.cvtColor(eight_bits(coded(area)), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    shift = find_shift(grey, _part(whole, crop))
    dx, dy = (round(s) for s in shift.median_px)
    if (dx, dy) != (0, 0):
        left, top = int(np.clip(crop.left + dx, 0, room[0])), int(np.clip(crop.top + dy, 0, room[1]))
        crop = Crop(left, top, width, height, "matched" if crop.found == "matched" else "moved")
        shift = find_shift(grey, _part(whole, crop))
    if not shift.certain:
        raise DataError(
            "the raw file and the JPEG do not show the same picture",
            where=str(path),
            remedy="Give the JPEG of the same exposure",
        )
    if shift.largest_px > MOST_SHIFT_PX:
        raise DataError(
            f"parts of the developed picture lie up to {shift.largest_px:.2f} px from where the JPEG shows them; "
            f"poses and calibration are of the JPEG, so {MOST_SHIFT_PX} px is the most",
            where=str(path),
            remedy="Turn the distortion compensation of the camera off, for all images of the calibration too",
        )
    return crop, shift.median_px, shift.largest_px


def _part(picture: _P, crop: Crop) -> _P:
    return picture[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]


def _words(error: Exception) -> str:
    """Return LibRaw's message."""
    first = error.args[0] if error.args else ""
    return first.decode("utf-8", "replace") if isinstance(first, bytes) else str(first or type(error).__name__)


_TILES, _TILE_PX = (5, 4), 256
_LEAST_RESPONSE = 0.15  # of the phase correlation: share of its energy in the peak
_LEAST_SPREAD = 4.0  # standard deviation, grey levels; a plain part shows no shift
_SMOOTH_PX = 1.0  # standard deviation of the filter against noise
_MARGIN_PX, _MOST_MOVED_PX, _DONE_PX, _MOST_STEPS = 24, 3.0, 1e-3, 30
_MOST_SIGMA_PX = 0.05  # of a part's shift, as if the noise of the pixels were independent
_FEWEST = 3  # parts


@dataclass(frozen=True, slots=True)
class Shift:
    """The shift of a second picture's content against the first, in x and y, over the parts that show one.

    Attributes:
        median_px: median shift over all parts; what is at p in the first is at p + shift in the second.
        largest_px: length of the largest shift of a part.
        parts: number of parts that show a shift.
    """

    median_px: tuple[float, float]
    largest_px: float
    parts: int

    @property
    def certain(self) -> bool:
        """True if enough parts show a shift."""
        return self.parts >= _FEWEST


def find_shift(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> Shift:
    """Find the shift between two grey pictures (H, W) of one size, in parts all over them.

    Phase correlation (Kuglin and Hines 1975) finds it to a pixel; least squares on the pixels to hundredths. Neither
    depends on the brightness or the contrast, which differ between a JPEG and a developed raw file.
    """
    shifts: list[tuple[float, float]] = []
    for rows, columns in _parts(first.shape[0], first.shape[1]):
        a, b = (picture[rows, columns].astype(np.float32) for picture in (first, second))
        if min(float(a.std()), float(b.std())) < _LEAST_SPREAD:
            continue
        shift = _shift_of(a, b)
        if shift is not None:
            shifts.append(shift)
    if not shifts:
        return Shift((0.0, 0.0), 0.0, 0)
    every = np.array(shifts)
    middle = np.median(every, axis=0)
    return Shift((float(middle[0]), float(middle[1])), float(np.linalg.norm(every, axis=1).max()), len(every))


def _shift_of(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[float, float] | None:
    """Return the shift of a part; None if its content does not show one."""
    window = cv2.createHanningWindow((a.shape[1], a.shape[0]), cv2.CV_32F)
    rough, response = cv2.phaseCorrelate(a.copy(), b.copy(), window)  # it multiplies them by the window in place
    if response < _LEAST_RESPONSE:
        return None
    return _refined(a, b, np.round(np.array(rough, dtype=np.float64)))


def _refined(a: NDArray[np.float32], b: NDArray[np.float32], start: Array) -> tuple[float, float] | None:
    """Estimate the shift by Gauss–Newton (Lucas and Kanade 1981), with gain and offset of the brightness."""
    a, b = (np.asarray(cv2.GaussianBlur(part, (0, 0), _SMOOTH_PX), dtype=np.float32) for part in (a, b))
    inner = slice(_MARGIN_PX, -_MARGIN_PX)
    aim = a[inner, inner].astype(np.float64).ravel()

    def linearised(shift: Array) -> tuple[Array, Array, Array]:
        """Return rows of the equations, normal matrix, and solution: gain, offset, gain times the step."""
        # Splines: cv2.warpAffine rounds positions to 1/32 px, and the steps would never end.
        moved = ndimage.shift(b, (-shift[1], -shift[0]), order=3, mode="reflect")[inner, inner]
        dy, dx = np.gradient(moved.astype(np.float64))
        rows = np.stack([moved.ravel(), np.ones(moved.size), dx.ravel(), dy.ravel()], axis=1).astype(np.float64)
        normal = rows.T @ rows
        return rows, normal, np.linalg.solve(normal, rows.T @ aim).astype(np.float64)

    def near(shift: Array) -> bool:
        return bool(np.all(np.abs(shift - start) < _MOST_MOVED_PX))

    def step_at(shift: Array) -> Array:
        if not near(shift):
            return np.zeros(2)  # lost: there is nothing to follow
        values = linearised(shift)[2]
        return np.asarray(values[2:] / values[0], dtype=np.float64)

    shift = gauss_newton(start, step_at, lambda at, step: at + step, most=_MOST_STEPS, settled=_DONE_PX)
    if not near(shift):
        return None
    rows, normal, values = linearised(shift)
    if np.abs(values[2:] / values[0]).max() >= _DONE_PX:
        return None
    rest = aim - rows @ values
    sigma_px = np.sqrt(np.diag(np.linalg.inv(normal))[2:] * (rest @ rest) / rest.size) / abs(values[0])
    # An edge in one direction does not show the shift along it.
    return (float(shift[0]), float(shift[1])) if sigma_px.max() < _MOST_SIGMA_PX else None


def _parts(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    """Yield the rows and columns of parts that are spread over a picture, its corners included."""
    side = min(_TILE_PX, height, width)
    for top in np.linspace(0, height - side, _TILES[1]).astype(int):
        for left in np.linspace(0, width - side, _TILES[0]).astype(int):
            yield slice(top, top + side), slice(left, left + side)
