"""The header of a DICOM file as lines for a recording of devices: what names no person, and the series' description.

Whoever writes the recording takes the description out of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pydicom.dataset import Dataset
from pydicom.uid import UID

from drivers.dicom_folder.deidentify import copy_kept
from drivers.dicom_folder.files import PARSE_ERRORS, read_dicom
from drivers.interfaces import FileHeader
from drivers.interfaces.answers import SERIES_DESCRIPTION

_LONGEST = 200  # characters of a value
_FREE_TEXT = ("SegmentLabel", "PixelData")


def header_lines(path: Path) -> FileHeader | str:
    """The header of a file; or a sentence with the reason if it cannot be read."""
    removed: set[str] = set()
    try:
        dataset = read_dicom(path, header_only=True)
        lines = list(_lines(copy_kept(dataset, removed)))
        description = str(dataset.get("SeriesDescription") or "")
        syntax = str(dataset.file_meta.get("TransferSyntaxUID", "")) if hasattr(dataset, "file_meta") else ""
        size = path.stat().st_size
    except OSError as error:
        return f"a file cannot be opened ({error.strerror or error})"
    except PARSE_ERRORS as error:
        return f"a file cannot be read as DICOM ({type(error).__name__})"
    if description:
        lines.append(f"{SERIES_DESCRIPTION}{description}")
    lines.append(f"transfer syntax: {UID(syntax).name if syntax else 'not stated'}")
    lines.append(f"left out: {', '.join(sorted(removed))}")
    return FileHeader(format="DICOM", size_bytes=size, lines=tuple(lines))


def _lines(dataset: Dataset, within: str = "") -> Iterator[str]:
    for element in dataset:
        name = within + element.keyword
        if element.keyword in _FREE_TEXT:
            continue
        if element.VR == "SQ":
            yield f"{name}: {len(element.value)} items"
            if element.value:
                yield from _lines(element.value[0], f"{name}/")
        elif element.VR == "UI":
            stated = UID(str(element.value))
            yield f"{name}: {stated.name if stated.name != str(stated) else 'a UID'}"
        else:
            yield f"{name}: {str(element.value)[:_LONGEST]}"
