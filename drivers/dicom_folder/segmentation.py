"""Reads DICOM Segmentation objects (SEG): binary, fractional and label maps."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileDataset
from pydicom.pixels.utils import pixel_array

from drivers.dicom_folder.files import read_dicom
from drivers.dicom_folder.headers import SEGMENTATION, grouped, items
from drivers.dicom_folder.labels import Block, chosen
from drivers.dicom_folder.pixels import DECODE_ERRORS
from drivers.errors import UnreadableFileError
from service.core.units import metres

_LARGEST_PIXELS = 8192 * 8192
_AGAIN = "Export the segmentation again as a DICOM Segmentation object of this series"


def read_segmentation(
    path: Path, segments: tuple[str, ...], frame_of_reference: str
) -> tuple[list[Block], tuple[str, ...]]:
    """The slices of the wanted segments, and the labels of these.

    Args:
        path: a file of modality SEG.
        segments: labels; empty: all.
        frame_of_reference: UID of the series' frame of reference; "" if it states none.

    Raises:
        UnreadableFileError: it is damaged, lacks a segment, states no geometry, or has another frame of reference.
    """
    try:
        dataset = read_dicom(path)
        if str(dataset.get("Modality")) != SEGMENTATION:
            raise _refused(path, f"it is not a segmentation (modality {dataset.get('Modality')})")
        own = str(dataset.get("FrameOfReferenceUID") or "")
        if frame_of_reference and own != frame_of_reference:
            raise _refused(path, f"its frame of reference ({own or 'none'}) is not that of the series")
        known = {
            str(item.get("SegmentLabel") or item.get("SegmentNumber")): int(item.get("SegmentNumber") or 0)
            for item in items(dataset, "SegmentSequence")
            if item.get("SegmentNumber") != dataset.get("PixelPaddingValue", 0)  # the background of a label map
        }
        names, numbers = chosen(segments, known, path)
        return list(_blocks(path, dataset, numbers)), names
    except OSError as error:
        raise _refused(path, f"it cannot be opened ({error.strerror or error})") from error
    except DECODE_ERRORS as error:
        raise _refused(path, f"it cannot be read as a segmentation ({error})") from error


def _blocks(path: Path, dataset: FileDataset, numbers: frozenset[int]) -> Iterator[Block]:
    described = items(dataset, "PerFrameFunctionalGroupsSequence")
    shared = items(dataset, "SharedFunctionalGroupsSequence")[:1]
    frames, rows, columns = (int(dataset.get(n) or 0) for n in ("NumberOfFrames", "Rows", "Columns"))
    if not described or len(described) != frames or not 0 < rows * columns <= _LARGEST_PIXELS:
        raise _refused(path, f"it states {frames} frames of {rows} × {columns} pixels and describes {len(described)}")
    for index, own in enumerate(described):
        groups = (own, *shared)
        segment = _segment(groups)
        if segment is not None and segment not in numbers:
            continue
        T = _place(groups)
        if T is None:
            raise _refused(path, f"frame {index + 1} states no position, orientation or pixel spacing")
        pixels = _frame(dataset, index)
        if pixels.shape != (rows, columns):
            raise _refused(path, f"frame {index + 1} has pixels of shape {pixels.shape}")
        yield Block(T, _marked(dataset, pixels, numbers)[:, :, None], f" (frame {index + 1})")


def _segment(groups: tuple[Dataset, ...]) -> int | None:
    """The segment of a frame; None in a label map, whose frames hold several."""
    number = grouped(groups, "SegmentIdentificationSequence", "ReferencedSegmentNumber", 1)
    return None if number is None else int(number[0])


def _marked(dataset: FileDataset, pixels: NDArray[np.generic], numbers: frozenset[int]) -> NDArray[np.bool_]:
    """Which pixels of a frame, (J, I), belong to the wanted segments; in a fractional one at least by a half."""
    match str(dataset.get("SegmentationType")):
        case "BINARY":
            return np.asarray(pixels == 1)
        case "FRACTIONAL":
            return np.asarray(2 * pixels.astype(np.int64) >= int(dataset.get("MaximumFractionalValue") or 1))
        case "LABELMAP":
            return np.isin(pixels, list(numbers))
        case other:
            raise ValueError(f"segmentations of type {other} are not supported")


def _frame(dataset: FileDataset, index: int) -> NDArray[np.generic]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(pixel_array(dataset, index=index))


def _place(groups: tuple[Dataset, ...]) -> NDArray[np.float64] | None:
    """T_ct_block (4, 4) in metres for the axes row, column, slice of a frame; None if the geometry is not stated."""
    spacing = grouped(groups, "PixelMeasuresSequence", "PixelSpacing", 2)
    orientation = grouped(groups, "PlaneOrientationSequence", "ImageOrientationPatient", 6)
    position = grouped(groups, "PlanePositionSequence", "ImagePositionPatient", 3)
    if spacing is None or orientation is None or position is None:
        return None
    T = np.eye(4)
    along_row, down_column = np.array(orientation[:3]), np.array(orientation[3:])
    T[:3, 0] = down_column * spacing[0]
    T[:3, 1] = along_row * spacing[1]
    T[:3, 2] = np.cross(along_row, down_column)
    T[:3, 3] = position
    T[:3] = metres(T[:3])
    return T


def _refused(path: Path, why: str) -> UnreadableFileError:
    return UnreadableFileError(why, where=str(path), remedy=_AGAIN)
