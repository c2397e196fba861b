"""Decodes the pixels of slices into Hounsfield units."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import FileDataset
from pydicom.pixels.utils import pixel_array

from drivers.dicom_folder.files import PARSE_ERRORS, read_dicom
from drivers.dicom_folder.headers import SliceHeader
from drivers.errors import UnreadableFileError

# Pixels outside the reconstructed circle or suppressed as background have a padding value, which is no pixel of the
# image (DICOM PS3.3, C.7.5.1.1.2), and which the rescaling may turn into anything: nothing is known there, so that it
# counts as air, as the standard recommends to who writes it.
_AIR_HU = -1000
_RANGE_HU = np.iinfo(np.int16)  # in which volumes are kept
# What pydicom, its plug-ins and Pillow raise for pixels that are truncated, damaged or of a missing codec.
DECODE_ERRORS = (*PARSE_ERRORS, RuntimeError, OSError)


def hounsfield(headers: Sequence[SliceHeader]) -> Iterator[NDArray[np.int16]]:
    """The pixels of each slice in Hounsfield units, (J, I), in the order of the headers; padding counts as air.

    So does what is less than a volume can hold: nothing is thinner than air, and programs mark so what lies outside
    the reconstructed circle without stating a padding value.

    Raises:
        UnreadableFileError: a slice cannot be decoded, or its values are higher than a volume can hold, which no
            tissue and no metal is; names the slice and the file.
    """
    opened: tuple[Path, FileDataset] | None = None
    for header in headers:
        try:
            if opened is None or opened[0] != header.path:
                opened = (header.path, read_dicom(header.path))
            stored = _stored(opened[1], header.frame)
        except DECODE_ERRORS as error:
            raise UnreadableFileError(
                f"the image of slice {header.name} cannot be decoded ({error})",
                where=str(header.path),
                remedy=f"Export it again, uncompressed (it has transfer syntax {header.transfer_syntax})",
            ) from error
        if stored.shape != (header.rows, header.columns):
            raise UnreadableFileError(
                f"slice {header.name} holds an image of shape {stored.shape} instead of "
                f"{(header.rows, header.columns)}",
                where=str(header.path),
                remedy="Export the series again as single monochrome slices",
            )
        slope, intercept = header.rescale or (1.0, 0.0)  # a series without them is refused before
        rescaled = np.rint(stored * slope + intercept)
        if header.padding is not None:
            first, last = header.padding
            outside = (stored >= first) & (stored <= last)
            rescaled[outside] = np.minimum(rescaled[outside], _AIR_HU)  # many write less than air: it stays as it is
        highest = float(rescaled.max())
        if highest > _RANGE_HU.max:
            raise UnreadableFileError(
                f"slice {header.name} has values up to {highest:.0f} HU, more than any body or metal has and than "
                f"can be kept ({_RANGE_HU.max}): its rescale slope {slope:g} and intercept {intercept:g} are wrong, "
                "or it marks pixels outside the image without stating a padding value",
                where=str(header.path),
                remedy="Export the series again in Hounsfield units, or state the padding value",
            )
        rescaled[rescaled < _RANGE_HU.min] = _AIR_HU
        yield rescaled.astype(np.int16)


def _stored(dataset: FileDataset, frame: int | None) -> NDArray[np.integer]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(dataset.pixel_array if frame is None else pixel_array(dataset, index=frame))
