"""Finds the DICOM files of a folder, and reads them whatever state they are in."""

from __future__ import annotations

import io
import os
import struct
import warnings
import zlib
from pathlib import Path

import pydicom
from pydicom.dataset import FileDataset
from pydicom.errors import BytesLengthException, InvalidDicomError

from drivers.folder_files import files_below
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
    ".nii",
)
PARSE_ERRORS = (
    InvalidDicomError,
    BytesLengthException,
    ValueError,
    ArithmeticError,
    AttributeError,
    LookupError,
    TypeError,
    NameError,
    EOFError,
    ImportError,  # of a codec that a library would like to have
    AssertionError,
    MemoryError,  # as much as a wrong length asks for
    RuntimeError,
    struct.error,
    zlib.error,
)


def dicom_files(folder: Path) -> list[Path]:
    """Files in a folder and its subfolders that may be DICOM, whatever their extension.

    Leaves out DICOMDIR, hidden files, meshes, NIfTI files, images and texts. Raises DeviceUnavailableError if the
    folder cannot be read.
    """

    def belongs(path: Path) -> bool:
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        other = path.suffix.lower() in _IGNORED_SUFFIXES or path.name.lower().endswith(".nii.gz")
        return not hidden and not other and not path.name.upper().startswith("DICOMDIR")

    return files_below(folder, belongs)


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
        try:
            dataset = pydicom.dcmread(file, force=True, stop_before_pixels=header_only)
            # Elements are decoded on access, which can warn too.
            dataset.decode()
        except (OSError, *PARSE_ERRORS):
            raise
        except Exception as error:  # a plug-in's own
            raise ValueError(f"{type(error).__name__}: {error}") from error
    return dataset
