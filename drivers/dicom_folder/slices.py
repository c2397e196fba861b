"""Reads DICOM slice headers and checks whether the slices of a series form a uniform volume."""

from __future__ import annotations

import io
import os
import re
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import FileDataset
from pydicom.errors import BytesLengthException, InvalidDicomError
from pydicom.pixels.decoders.base import get_decoder
from pydicom.uid import UID

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import Array, Transform
from drivers.meshes.mesh_file import MESH_SUFFIXES

_IGNORED_SUFFIXES = (
    *MESH_SUFFIXES,
    ".mtl",
    ".png",
    ".jpg",
    ".jpeg",
    ".txt",
    ".xml",
    ".json",
    ".csv",
    ".pdf",
    ".html",
)
PARSE_ERRORS = (
    InvalidDicomError,
    BytesLengthException,
    ValueError,
    ArithmeticError,
    AttributeError,
    LookupError,
    TypeError,
    EOFError,
    NotImplementedError,
    RecursionError,
    struct.error,
    zlib.error,
)
_DEFLATED = "1.2.840.10008.1.2.1.99"  # the whole file is compressed, so its unpacked size is unbounded
_LARGEST_PIXELS = 8192 * 8192  # per image; a CT slice has at most a sixteenth of it
_UNCOMPRESSED = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2")
_ORIENTATION_TOLERANCE = 1e-3
# Positions are decimal strings of a few digits; a missing slice doubles the step.
_SPACING_TOLERANCE = 0.02
_POSITION_TOLERANCE_MM = 0.01
_MAX_NAMED = 5


@dataclass(frozen=True, slots=True)
class SliceHeader:
    """The relevant header fields of one file; missing geometry is None and is reported as a problem."""

    path: Path
    series_uid: str
    instance_uid: str
    description: str
    modality: str
    image_type: tuple[str, ...]
    transfer_syntax: str
    rows: int
    columns: int
    frames: int
    samples: int
    pixel_spacing_mm: tuple[float, float] | None  # between rows, between columns
    orientation: tuple[float, ...] | None  # direction of a row (+i), direction of a column (+j)
    position_mm: tuple[float, ...] | None
    rescaled: bool
    cut_short: bool

    @property
    def name(self) -> str:
        """File name and instance UID, for messages."""
        return f"{self.path.name} ({self.instance_uid})"


def dicom_files(folder: Path) -> list[Path]:
    """Files in a folder and its subfolders that may be DICOM, whatever their extension.

    Leaves out DICOMDIR, hidden files, meshes, images and texts. Raises DeviceUnavailableError if the folder cannot be
    read.
    """
    try:
        root = folder.resolve(strict=True)
        return [
            path
            for path in sorted(folder.rglob("*"))
            if path.is_file()
            and not path.name.upper().startswith("DICOMDIR")
            and not any(part.startswith(".") for part in path.relative_to(folder).parts)
            and path.suffix.lower() not in _IGNORED_SUFFIXES
            and path.resolve().is_relative_to(root)
        ]
    except OSError as error:
        raise DeviceUnavailableError(
            f"the folder cannot be read ({error.strerror})",
            where=str(folder),
            remedy="Check that the share is mounted and that the path in rig.yaml is right",
        ) from error


class _NoFurther(io.BufferedReader):
    """A file reader that caps each read at the rest of the file: a wrong length field would allocate gigabytes."""

    def __init__(self, raw: io.FileIO) -> None:
        super().__init__(raw)
        self._bytes = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to `size` bytes, or all remaining ones if it is None or negative, as io.BufferedReader does."""
        left = max(self._bytes - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


def read_dicom(path: Path, *, header_only: bool = False) -> FileDataset:
    """Read a DICOM file, also one without preamble, with pydicom's warnings suppressed.

    Raises OSError, or one of PARSE_ERRORS if the file is damaged or not DICOM.
    """
    with warnings.catch_warnings(), path.open("rb", buffering=0) as raw, _NoFurther(raw) as file:
        warnings.simplefilter("ignore")
        dataset = pydicom.dcmread(file, force=True, stop_before_pixels=header_only)
        # Elements are decoded on access, which can warn too.
        dataset.decode()
    return dataset


def read_header(path: Path) -> SliceHeader | str:
    """Read the header of a slice; returns a sentence with the reason if it cannot be read."""
    again = "export it again, or take it out of the folder"
    try:
        if _is_deflated(path):
            return f"{path}: is compressed as a whole (deflated); export it again, uncompressed"
        dataset = read_dicom(path, header_only=True)
        if "SOPClassUID" not in dataset and "Rows" not in dataset:
            return f"{path}: is not a DICOM file, or is damaged; {again}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _header(path, dataset)
    except OSError as error:
        return f"{path}: cannot be opened ({error.strerror or error}); {again}"
    except PARSE_ERRORS as error:
        return f"{path}: is not a DICOM file, or is damaged ({error}); {again}"


def _is_deflated(path: Path) -> bool:
    with path.open("rb") as file:
        return _DEFLATED.encode() in file.read(2048)  # the transfer syntax is among the first elements


def _header(path: Path, dataset: FileDataset) -> SliceHeader:
    rows, columns = int(dataset.get("Rows") or 0), int(dataset.get("Columns") or 0)
    frames, samples = int(dataset.get("NumberOfFrames") or 1), int(dataset.get("SamplesPerPixel") or 1)
    syntax = str(dataset.file_meta.get("TransferSyntaxUID", "")) if hasattr(dataset, "file_meta") else ""
    pixel_bytes = rows * columns * frames * samples * int(dataset.get("BitsAllocated") or 16) // 8
    spacing = _numbers(dataset, "PixelSpacing", 2)
    return SliceHeader(
        path=path,
        series_uid=str(dataset.get("SeriesInstanceUID") or f"(none) {path.parent.name}"),
        instance_uid=str(dataset.get("SOPInstanceUID") or "no UID"),
        description=str(dataset.get("SeriesDescription") or ""),
        modality=str(dataset.get("Modality") or "unknown"),
        image_type=tuple(str(word).upper() for word in dataset.get("ImageType") or ()),
        transfer_syntax=syntax or "unknown",
        rows=rows,
        columns=columns,
        frames=frames,
        samples=samples,
        pixel_spacing_mm=None if spacing is None else (spacing[0], spacing[1]),
        orientation=_numbers(dataset, "ImageOrientationPatient", 6),
        position_mm=_numbers(dataset, "ImagePositionPatient", 3),
        rescaled=bool(_numbers(dataset, "RescaleSlope", 1) and _numbers(dataset, "RescaleIntercept", 1)),
        cut_short=syntax in _UNCOMPRESSED and path.stat().st_size < pixel_bytes,
    )


def _numbers(dataset: FileDataset, name: str, count: int) -> tuple[float, ...] | None:
    value = dataset.get(name)
    if value is None or value == "":
        return None
    items = [value] if count == 1 else list(value)
    numbers = tuple(float(str(item)) for item in items)
    return numbers if len(numbers) == count and np.all(np.isfinite(numbers)) else None


def problems_of(headers: Sequence[SliceHeader]) -> tuple[str, ...]:
    """Why these slices do not form a uniform CT volume, one text per problem; empty if they do."""
    if all(header.rows == 0 or header.columns == 0 for header in headers):
        return (f"it holds no images (modality {headers[0].modality})",)
    problems: list[str] = []
    for text, bad in (
        ("localiser images", [h for h in headers if "LOCALIZER" in h.image_type]),
        ("files that hold no image, perhaps cut short", [h for h in headers if h.rows * h.columns == 0]),
        ("files that are cut short", [h for h in headers if h.cut_short]),
        ("multi-frame images, which are not read", [h for h in headers if h.frames > 1]),
        (
            f"images of more than {_LARGEST_PIXELS:,} pixels",
            [h for h in headers if h.rows * h.columns > _LARGEST_PIXELS],
        ),
        ("colour images", [h for h in headers if h.samples > 1]),
        ("images that are not CT", [h for h in headers if h.modality != "CT"]),
        ("no rescale slope and intercept, so no Hounsfield units, in", [h for h in headers if not h.rescaled]),
        ("no position, orientation or pixel spacing in", [h for h in headers if not _placed(h)]),
    ):
        if bad:
            problems.append(f"{text}: {_named(bad)}")
    problems += [
        f"images compressed as {UID(syntax).name}, for which no decoder is installed (pip install python-gdcm): "
        + _named([h for h in headers if h.transfer_syntax == syntax])
        for syntax in sorted({h.transfer_syntax for h in headers})
        if _undecodable(syntax)
    ]
    images = [header for header in headers if header.rows * header.columns > 0]
    placed = [header for header in images if _placed(header) and "LOCALIZER" not in header.image_type]
    if placed:
        problems += _shape_problems(placed) or _position_problems(placed)
    return tuple(problems)


def _undecodable(syntax: str) -> bool:
    """Whether no decoder is installed for a known transfer syntax; an unknown one is tried when it is read."""
    uid = UID(syntax) if re.fullmatch(r"[0-9.]+", syntax) else None
    if uid is None or not uid.is_transfer_syntax or not uid.is_compressed or uid.is_deflated:
        return False
    try:
        return not get_decoder(uid).is_available
    except NotImplementedError:
        return True


def _placed(header: SliceHeader) -> bool:
    return None not in (header.position_mm, header.orientation, header.pixel_spacing_mm)


def _named(headers: Sequence[SliceHeader]) -> str:
    names = ", ".join(header.name for header in headers[:_MAX_NAMED])
    return names + (f" and {len(headers) - _MAX_NAMED} more" if len(headers) > _MAX_NAMED else "")


def _shape_problems(headers: Sequence[SliceHeader]) -> list[str]:
    problems: list[str] = []
    for what, keys in (
        ("image size", [(h.rows, h.columns) for h in headers]),
        ("pixel spacing", [tuple(round(x, 4) for x in h.pixel_spacing_mm or ()) for h in headers]),
        ("orientation", [tuple(round(x / 2e-3) for x in h.orientation or ()) for h in headers]),
    ):
        usual = Counter(keys).most_common(1)[0][0]
        slack = 1 if what == "orientation" else 0  # rounded to 0.002, so adjacent values count as equal
        other = [
            header
            for header, key in zip(headers, keys, strict=True)
            if max(abs(a - b) for a, b in zip(key, usual, strict=True)) > slack
        ]
        if other:
            problems.append(f"mixed {what}: {_named(other)}")
    if any(min(header.pixel_spacing_mm or (0.0,)) <= 0 for header in headers):
        problems.append("pixel spacing that is not positive")
    for header in headers:
        row, column = np.array(header.orientation).reshape(2, 3)
        lengths = np.linalg.norm([row, column], axis=1)
        if np.max(np.abs(lengths - 1)) > _ORIENTATION_TOLERANCE or abs(row @ column) > _ORIENTATION_TOLERANCE:
            problems.append(f"row and column directions that are not perpendicular unit vectors: {header.name}")
            break
    return problems


def _position_problems(headers: Sequence[SliceHeader]) -> list[str]:
    if len(headers) < 2:
        return ["only one slice: there is no spacing"]
    ordered, along = _along_normal(headers)
    steps = np.diff(along)
    distinct = steps[steps > _POSITION_TOLERANCE_MM]
    if len(distinct) == 0:
        return [f"all slices at the same position: {_named(ordered)}"]
    # The median step, not the mean, which gaps would change. With only two steps the smaller one is the spacing.
    spacing = float(np.median(distinct)) if len(distinct) > 2 else float(distinct.min())
    problems: list[str] = []
    for step, before, after, at in zip(steps, ordered[:-1], ordered[1:], along[:-1], strict=True):
        span = f"between {before.name} at {at:.3f} mm and {after.name} at {at + step:.3f} mm"
        if step <= _POSITION_TOLERANCE_MM:
            problems.append(f"duplicate slice: {before.name} and {after.name}, both at {at:.3f} mm")
        elif step > 1.5 * spacing:
            problems.append(f"gap: {round(step / spacing) - 1} slices of {spacing:.3f} mm missing {span}")
        elif abs(step - spacing) > max(_SPACING_TOLERANCE * spacing, _POSITION_TOLERANCE_MM):
            problems.append(f"uneven spacing: {step:.3f} mm instead of {spacing:.3f} mm {span}")
    if problems:
        return problems
    position = np.array([header.position_mm for header in ordered])
    straight = position[0] + np.linspace(0.0, 1.0, len(ordered))[:, None] * (position[-1] - position[0])
    off = np.linalg.norm(position - straight, axis=1)
    if off.max() > max(_SPACING_TOLERANCE * spacing, _POSITION_TOLERANCE_MM) * 2:
        worst = ordered[int(off.argmax())]
        return [f"slices do not lie on a line: {worst.name} is off by {off.max():.3f} mm"]
    return []


def _along_normal(headers: Sequence[SliceHeader]) -> tuple[list[SliceHeader], Array]:
    """The slices sorted along the slice normal (cross product of row and column), and their positions on it in mm."""
    row, column = np.array(headers[0].orientation).reshape(2, 3)
    along = np.array([header.position_mm for header in headers]) @ np.cross(row, column)
    order = np.argsort(along, kind="stable")
    return [headers[index] for index in order], along[order]


def arrange(headers: Sequence[SliceHeader]) -> tuple[list[SliceHeader], Transform, tuple[float, float, float]]:
    """Return the slices in order of k, T_ct_voxel (4, 4) and the spacing (i, j, k) in metres.

    The series must have no problems. The step along k is taken from the slice positions, so T_ct_voxel includes the
    shear of a tilted gantry.
    """
    ordered, _ = _along_normal(headers)
    orientation = ordered[0].orientation or ()
    row_spacing, column_spacing = ordered[0].pixel_spacing_mm or (0.0, 0.0)
    first, last = (np.array(header.position_mm, dtype=np.float64) for header in (ordered[0], ordered[-1]))
    T = np.eye(4)
    T[:3, 0] = np.array(orientation[:3]) * column_spacing
    T[:3, 1] = np.array(orientation[3:]) * row_spacing
    T[:3, 2] = (last - first) / (len(ordered) - 1)
    T[:3, 3] = first
    T[:3] *= 1e-3
    i, j, k = np.linalg.norm(T[:3, :3], axis=0)
    return ordered, T, (float(i), float(j), float(k))
