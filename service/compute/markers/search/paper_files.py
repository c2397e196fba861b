"""The paper's detector on image files, with its own boxes or another detector's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from service.compute.camera_model import CameraModel
from service.compute.images.files import read_image_of
from service.compute.markers.paper_chain import Box, detect_by_masks
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.core.errors import DataError
from service.core.text.file_text import file_text
from service.core.text.json_text import parse_json

_FORM = 'Write {"image.jpg": [[left, top, right, bottom], …], …} in pixels of the image'


def detect_file_by_masks(
    path: Path,
    camera: CameraModel,
    options: DetectionOptions = DEFAULTS,
    boxes: Mapping[str, Sequence[Box]] | None = None,
) -> tuple[SphereOutline, ...]:
    """The outlines in one image file by the paper's chain.

    Args:
        path: JPEG, PNG or TIFF of the camera's size.
        camera: intrinsics.
        options: of the detector.
        boxes: (left, top, right, bottom) in pixels by file name; an image without an entry has no sphere. None: found
            by circle votes.

    Raises:
        DataError: the file is not an image of the camera's size.
    """
    mine = None if boxes is None else boxes.get(path.name, ())
    return detect_by_masks(read_image_of(path, camera), camera, options, boxes=mine)


def read_boxes(path: Path, names: Sequence[str]) -> dict[str, list[Box]]:
    """Boxes by image name from a JSON file, such as Grounding DINO's.

    Raises:
        DataError: the file is not JSON of this form, a box has no area, or an image is not among `names`.
    """
    data = parse_json(file_text(path), name=str(path), remedy=_FORM)
    if not isinstance(data, dict):
        raise DataError("the file does not hold boxes by image name", where=str(path), remedy=_FORM)
    known = cast(dict[str, Any], data)
    strange = sorted(set(known) - set(names))
    if strange:
        raise DataError(f"there is no image {strange[0]!r}", where=str(path), remedy=_FORM)
    return {
        name: [_box(entry, f"{path}: {name}") for entry in _list(entries, path)] for name, entries in known.items()
    }


def _list(entries: Any, path: Path) -> list[Any]:
    if not isinstance(entries, list):
        raise DataError("the boxes of an image are not a list", where=str(path), remedy=_FORM)
    return cast(list[Any], entries)


def _box(entry: Any, where: str) -> Box:
    try:
        left, top, right, bottom = (float(value) for value in entry)
    except (TypeError, ValueError) as error:
        raise DataError(f"{entry!r} is not a box", where=where, remedy=_FORM) from error
    if not (left < right and top < bottom):  # NaN fails too
        raise DataError(f"the box {entry!r} has no area", where=where, remedy=_FORM)
    return left, top, right, bottom
