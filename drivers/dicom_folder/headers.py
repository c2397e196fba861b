"""Reads the headers of DICOM images: of a file with one slice, or of each frame of an enhanced multi-frame file."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from pydicom.dataset import Dataset, FileDataset

from drivers.dicom_folder.consistency import common_of, value_unit
from drivers.dicom_folder.files import PARSE_ERRORS, read_dicom

_DEFLATED = "1.2.840.10008.1.2.1.99"  # the whole file is compressed, so its unpacked size is unbounded
_UNCOMPRESSED = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2")
#: Modality of a segmentation, which is listed apart from the series.
SEGMENTATION = "SEG"


@dataclass(frozen=True, slots=True)
class Part:
    """Which file of a concatenation this is: several multi-frame files that belong together."""

    concatenation_uid: str
    number: int  # from 1
    total: int | None  # where it is stated


@dataclass(frozen=True, slots=True)
class SliceHeader:
    """The relevant header fields of one slice; missing geometry is None and is reported as a problem."""

    path: Path
    frame: int | None  # its index in a multi-frame file; None in a file with one slice
    series_uid: str
    instance_uid: str
    frame_of_reference: str
    description: str
    modality: str
    image_type: tuple[str, ...]
    transfer_syntax: str
    rows: int
    columns: int
    frames: int  # of the file, where they are not described one by one
    samples: int
    pixel_spacing_mm: tuple[float, float] | None  # between rows, between columns
    orientation: tuple[float, ...] | None  # direction of a row (+i), direction of a column (+j)
    position_mm: tuple[float, ...] | None
    rescale: tuple[float, float] | None  # slope and intercept: stored values to Hounsfield units
    value_unit: str  # what the values are if not Hounsfield units; "" for these
    padding: tuple[int, int] | None  # the stored values, first and last, of pixels outside the image
    common: Mapping[str, str]  # what must be equal in a whole series
    cut_short: bool
    stated_instances: int | None  # NumberOfSeriesRelatedInstances: the files of the whole series, where it is stated
    number: int | None  # of the slice in its series: InstanceNumber, or the frame's place in its stack
    part: Part | None  # of a series whose frames were divided among several files
    acquisition: tuple[int, int] | None  # AcquisitionNumber and ImagesInAcquisition, where both are stated

    @property
    def name(self) -> str:
        """File name, frame (counted from 1, as in DICOM) and instance UID, for messages."""
        return f"{self.file_name} ({self.instance_uid})"

    @property
    def file_name(self) -> str:
        """File name and frame."""
        return self.path.name + ("" if self.frame is None else f" frame {self.frame + 1}")


def read_headers(path: Path) -> tuple[SliceHeader, ...] | str:
    """Read the headers of a file's slices; returns a sentence with the reason if they cannot be read."""
    again = "export it again, or take it out of the folder"
    try:
        if _is_deflated(path):
            return f"{path}: is compressed as a whole (deflated); export it again, uncompressed"
        dataset = read_dicom(path, header_only=True)
        if "SOPClassUID" not in dataset and "Rows" not in dataset:
            return f"{path}: is not a DICOM file, or is damaged; {again}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _headers(path, dataset)
    except OSError as error:
        return f"{path}: cannot be opened ({error.strerror or error}); {again}"
    except PARSE_ERRORS as error:
        return f"{path}: is not a DICOM file, or is damaged ({error}); {again}"


def _is_deflated(path: Path) -> bool:
    with path.open("rb") as file:
        return _DEFLATED.encode() in file.read(2048)  # the transfer syntax is among the first elements


def _headers(path: Path, dataset: FileDataset) -> tuple[SliceHeader, ...]:
    described = items(dataset, "PerFrameFunctionalGroupsSequence")
    if not described or str(dataset.get("Modality")) == SEGMENTATION:
        return (_header(path, dataset, (dataset,), None),)
    stated = int(dataset.get("NumberOfFrames") or 1)
    if len(described) != stated:
        raise ValueError(f"it states {stated} frames and describes {len(described)}")
    shared = items(dataset, "SharedFunctionalGroupsSequence")[:1]
    return tuple(_header(path, dataset, (groups, *shared), index) for index, groups in enumerate(described))


def _header(path: Path, dataset: FileDataset, groups: Sequence[Dataset], frame: int | None) -> SliceHeader:
    """The header of one slice; `groups` hold its geometry, the first that has an element counts."""
    rows, columns = int(dataset.get("Rows") or 0), int(dataset.get("Columns") or 0)
    frames, samples = int(dataset.get("NumberOfFrames") or 1), int(dataset.get("SamplesPerPixel") or 1)
    syntax = str(dataset.file_meta.get("TransferSyntaxUID", "")) if hasattr(dataset, "file_meta") else ""
    pixel_bytes = rows * columns * frames * samples * int(dataset.get("BitsAllocated") or 16) // 8
    spacing = grouped(groups, "PixelMeasuresSequence", "PixelSpacing", 2)
    slope = grouped(groups, "PixelValueTransformationSequence", "RescaleSlope", 1)
    intercept = grouped(groups, "PixelValueTransformationSequence", "RescaleIntercept", 1)
    image_type = _image_type(dataset, groups)
    return SliceHeader(
        path=path,
        frame=frame,
        series_uid=str(dataset.get("SeriesInstanceUID") or f"(none) {path.parent.name}"),
        instance_uid=str(dataset.get("SOPInstanceUID") or "no UID"),
        frame_of_reference=str(dataset.get("FrameOfReferenceUID") or ""),
        description=str(dataset.get("SeriesDescription") or ""),
        modality=str(dataset.get("Modality") or "unknown"),
        image_type=image_type,
        transfer_syntax=syntax or "unknown",
        rows=rows,
        columns=columns,
        frames=frames if frame is None else 1,
        samples=samples,
        pixel_spacing_mm=None if spacing is None else (spacing[0], spacing[1]),
        orientation=grouped(groups, "PlaneOrientationSequence", "ImageOrientationPatient", 6),
        position_mm=grouped(groups, "PlanePositionSequence", "ImagePositionPatient", 3),
        rescale=None if slope is None or intercept is None else (slope[0], intercept[0]),
        value_unit=value_unit(dataset, groups, image_type),
        padding=_padding(dataset),
        common=common_of(dataset, groups),
        cut_short=syntax in _UNCOMPRESSED and path.stat().st_size < pixel_bytes,
        stated_instances=_count(dataset, "NumberOfSeriesRelatedInstances"),
        number=_number(groups),
        part=_part(dataset),
        acquisition=_acquisition(dataset),
    )


def _padding(dataset: Dataset) -> tuple[int, int] | None:
    """The range of stored values that are padding (PS3.3, C.7.5.1.1.2), as the pixels are stored.

    Programs write the value as signed or unsigned whatever the pixels are: it has the same bits.
    """
    value = _numbers(dataset, "PixelPaddingValue", 1)
    if value is None:
        return None
    limit = _numbers(dataset, "PixelPaddingRangeLimit", 1) or value
    bits, signed = int(dataset.get("BitsAllocated") or 16), int(dataset.get("PixelRepresentation") or 0) == 1
    ends = [int(end) % (1 << bits) for end in (*value, *limit)]
    ends = sorted(end - (1 << bits) if signed and end >= 1 << (bits - 1) else end for end in ends)
    return ends[0], ends[1]


def _count(dataset: Dataset, name: str) -> int | None:
    """A number of at least 1, or None."""
    number = _numbers(dataset, name, 1)
    return None if number is None or number[0] < 1 else int(number[0])


def _number(groups: Sequence[Dataset]) -> int | None:
    """The number of a slice; that which it had before its series was written as multi-frame counts first."""
    number = grouped(groups, "UnassignedPerFrameConvertedAttributesSequence", "InstanceNumber", 1)
    number = number or grouped(groups, "FrameContentSequence", "InStackPositionNumber", 1)
    return None if number is None else int(number[0])


def _part(dataset: Dataset) -> Part | None:
    uid, number = str(dataset.get("ConcatenationUID") or ""), _count(dataset, "InConcatenationNumber")
    return Part(uid, number, _count(dataset, "InConcatenationTotalNumber")) if uid and number is not None else None


def _acquisition(dataset: Dataset) -> tuple[int, int] | None:
    number, images = _numbers(dataset, "AcquisitionNumber", 1), _count(dataset, "ImagesInAcquisition")
    return None if number is None or images is None else (int(number[0]), images)


def _image_type(dataset: Dataset, groups: Sequence[Dataset]) -> tuple[str, ...]:
    found = [item for group in groups for item in items(group, "CTImageFrameTypeSequence")[:1]]
    words = (found[0].get("FrameType") if found else None) or dataset.get("ImageType") or ()
    return tuple(str(word).upper() for word in ([words] if isinstance(words, str) else words))


def items(dataset: Dataset, sequence: str) -> list[Dataset]:
    """The items of a sequence; none if it is missing, or is not a sequence."""
    value = dataset.get(sequence)
    return [item for item in cast("list[object]", value or ()) if isinstance(item, Dataset)]


def grouped(groups: Sequence[Dataset], sequence: str, name: str, count: int) -> tuple[float, ...] | None:
    """Finite numbers of an element of functional groups, or of a data set itself; None unless there are `count`."""
    for group in groups:
        for place in (group, *items(group, sequence)[:1]):
            numbers = _numbers(place, name, count)
            if numbers is not None:
                return numbers
    return None


def _numbers(dataset: Dataset, name: str, count: int) -> tuple[float, ...] | None:
    value = dataset.get(name)
    if value is None or value == "":
        return None
    found = [value] if count == 1 else list(value)
    numbers = tuple(float(str(item)) for item in found)
    return numbers if len(numbers) == count and np.all(np.isfinite(numbers)) else None
