"""Reads the label image of a NIfTI-1 file (.nii, .nii.gz), and makes a copy of it without texts."""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

import numpy as np
from numpy.typing import NDArray

from drivers.dicom_folder.labels import LPS_FROM_RAS, Block, chosen
from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.interfaces import Transform

NIFTI_SUFFIXES = (".nii", ".nii.gz")
_HEADER_BYTES = 348
_LARGEST_VOXELS = 1 << 30  # a CT series of 1024 × 1024 × 1024 voxels
_BLOCK_BYTES = 1 << 20
_MOST_SEGMENTS = 1000
# NIfTI-1 data types of whole numbers.
_TYPES = {2: "u1", 4: "i2", 8: "i4", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
_UNITS_M = {1: 1.0, 2: 1e-3, 3: 1e-6}  # metre, millimetre, micrometre
# Texts that a program may fill: data_type, db_name, descrip, aux_file, intent_name; offset and length.
_TEXTS = ((4, 10), (14, 18), (148, 80), (228, 24), (328, 16))
_AGAIN = "Export the segmentation again as a NIfTI-1 label image"


@dataclass(frozen=True, slots=True)
class _Header:
    order: str
    shape: tuple[int, int, int]
    kind: str
    offset: int
    T_ct_voxel: Transform

    @property
    def voxels(self) -> int:
        """Their number."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def data_bytes(self) -> int:
        """The size of the image."""
        return self.voxels * np.dtype(self.kind).itemsize


def is_nifti(path: Path) -> bool:
    """Return whether a file is NIfTI by its name."""
    return path.name.lower().endswith(NIFTI_SUFFIXES)


def check_nifti(path: Path) -> None:
    """Check that a file is complete. Raises as `read_nifti` does, and OSError."""
    if not is_nifti(path):
        raise UnreadableFileError("it is not a NIfTI file", where=str(path), remedy=_AGAIN)
    header = _read_header(path)
    left = header.offset + header.data_bytes
    with _open_file(path) as file:
        while left > 0:
            left -= len(_bytes(path, file, min(left, _BLOCK_BYTES)))


def read_nifti(path: Path, segments: tuple[str, ...], most_voxels: int) -> tuple[Block, tuple[str, ...]]:
    """The voxels of the wanted labels, and the labels.

    Args:
        path: a file of one three-dimensional image of whole numbers.
        segments: labels as text, such as "1"; empty: all but 0.
        most_voxels: the largest number of voxels of the series.

    Raises:
        IncompleteExportError: the file is cut short.
        UnreadableFileError: it is no such image, states no place in space, or lacks a label.
    """
    header = _read_header(path)
    if header.voxels > most_voxels:
        raise _refused(path, f"it has {header.voxels:,} voxels, more than the series ({most_voxels:,})")
    with _open_file(path) as file:
        _bytes(path, file, header.offset)
        data = _bytes(path, file, header.data_bytes)
    values = np.frombuffer(data, dtype=np.dtype(header.kind)).reshape(header.shape, order="F")
    present = np.unique(values)
    if len(present) > _MOST_SEGMENTS:
        raise _refused(path, f"it has {len(present)} different values: it is an image, not a segmentation")
    names, numbers = chosen(segments, {str(int(value)): int(value) for value in present if value != 0}, path)
    inside: NDArray[np.bool_] = np.isin(values, list(numbers))
    return Block(header.T_ct_voxel, inside), names


def without_texts(source: Path, target: Path) -> tuple[str, ...]:
    """Copy a file without its free texts and extensions; returns what was removed.

    Raises as `read_nifti` does, and OSError.
    """
    header = _read_header(source)
    removed: list[str] = []
    with _open_file(source) as file:
        head = bytearray(_bytes(source, file, header.offset))
        voxels = _bytes(source, file, header.data_bytes)
    for (start, length), name in zip(
        _TEXTS, ("data_type", "db_name", "descrip", "aux_file", "intent_name"), strict=True
    ):
        if head[start : start + length].strip(b"\0 "):
            removed.append(f"NIfTI {name}")
            head[start : start + length] = bytes(length)
    if any(head[348:]):
        removed.append("NIfTI extensions")
    head[108:112] = struct.pack(f"{header.order}f", 352.0)  # vox_offset: behind an empty extension
    content = bytes(head[:348]) + bytes(4) + voxels
    target.write_bytes(gzip.compress(content, 1, mtime=0) if source.name.lower().endswith(".gz") else content)
    return tuple(removed)


def _open_file(path: Path) -> IO[bytes]:
    if path.name.lower().endswith(".gz"):
        return cast("IO[bytes]", gzip.open(path, "rb"))
    return path.open("rb")


def _bytes(path: Path, file: IO[bytes], count: int) -> bytes:
    """Exactly so many bytes of a file."""
    parts: list[bytes] = []
    left = count
    try:
        while left > 0 and (block := file.read(min(left, _BLOCK_BYTES))):  # a wrong size allocates no more than this
            parts.append(block)
            left -= len(block)
    except EOFError as error:
        raise IncompleteExportError("the file is cut short", where=str(path), remedy=_AGAIN) from error
    except (zlib.error, gzip.BadGzipFile) as error:
        raise _refused(path, f"it cannot be unpacked ({error})") from error
    if left > 0:
        raise IncompleteExportError(
            f"the file is cut short: {left:,} bytes are missing", where=str(path), remedy=_AGAIN
        )
    return b"".join(parts)


def _read_header(path: Path) -> _Header:
    with _open_file(path) as file:
        head = _bytes(path, file, _HEADER_BYTES)
    order = next((o for o in "<>" if struct.unpack(f"{o}i", head[:4])[0] == _HEADER_BYTES), None)
    if order is None or head[344:348] != b"n+1\0":
        raise _refused(path, "it is not a NIfTI-1 file of one part")
    dim = struct.unpack(f"{order}8h", head[40:56])
    if not 3 <= dim[0] <= 7 or min(dim[1:4]) < 1 or any(n > 1 for n in dim[4 : dim[0] + 1]):
        raise _refused(
            path, f"it is not one three-dimensional image (its dimensions are {dim[1 : max(dim[0], 0) + 1]})"
        )
    shape = (int(dim[1]), int(dim[2]), int(dim[3]))
    if np.prod(shape, dtype=np.int64) > _LARGEST_VOXELS:
        raise _refused(path, f"it claims {shape[0]} × {shape[1]} × {shape[2]} voxels")
    datatype = struct.unpack(f"{order}h", head[70:72])[0]
    if datatype not in _TYPES:
        raise _refused(path, f"its voxels are not whole numbers (data type {datatype})")
    slope, intercept = struct.unpack(f"{order}2f", head[112:120])
    if slope not in (0.0, 1.0) or (slope == 1.0 and intercept != 0.0):
        raise _refused(path, "its labels are scaled")
    offset = struct.unpack(f"{order}f", head[108:112])[0]
    if not 352 <= offset <= 1 << 24:
        raise _refused(path, f"its voxels would begin at byte {offset:g}")
    return _Header(order, shape, order + _TYPES[datatype], int(offset), _place(path, head, order))


def _place(path: Path, head: bytes, order: str) -> Transform:
    """T_ct_voxel (4, 4) in metres, of the sform, else of the qform (NIfTI-1, methods 3 and 2)."""
    qform, sform = struct.unpack(f"{order}2h", head[252:256])
    T = np.eye(4)
    if sform > 0:
        T[:3] = np.array(struct.unpack(f"{order}12f", head[280:328])).reshape(3, 4)
    elif qform > 0:
        T[:3] = _of_quaternion(head, order)
    else:
        raise _refused(path, "it states no place in space (neither sform nor qform)")
    T[:3] *= _UNITS_M.get(head[123] & 7, 1e-3)  # programs that state no unit write millimetres
    if not np.isfinite(T).all() or abs(np.linalg.det(T[:3, :3])) < 1e-18:
        raise _refused(path, "its place in space is not an affine map")
    return LPS_FROM_RAS @ T


def _of_quaternion(head: bytes, order: str) -> Transform:
    pixdim = struct.unpack(f"{order}8f", head[76:108])
    b, c, d, x, y, z = struct.unpack(f"{order}6f", head[256:280])
    a = float(np.sqrt(max(0.0, 1.0 - b * b - c * c - d * d)))
    R = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    sides = np.array([pixdim[1], pixdim[2], pixdim[3] * (-1.0 if pixdim[0] < 0 else 1.0)])
    return np.column_stack([R * sides, [x, y, z]])


def _refused(path: Path, why: str) -> UnreadableFileError:
    return UnreadableFileError(why, where=str(path), remedy=_AGAIN)
