"""Reads joint angles recorded with images: CSV image,q1,…,qN in radians, one column an axis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.compute.poses.files.image_names import matched_names
from service.core.errors import DataError
from service.core.geometry import Array
from service.core.text.counts import counted
from service.core.text.file_text import csv_rows

_AXES = range(1, 17)  # no arm has more
_LARGEST_RAD = 4 * np.pi  # beyond any arm's range: the file is in degrees


def read_joints_csv(path: Path, images: Sequence[str]) -> dict[str, Array]:
    """Joints (N,) in radians by image name; N is the number of columns q1, q2, …

    Raises:
        DataError: the file is missing or malformed (with file:line), in degrees, or lacks an image.
    """
    rows = csv_rows(path)
    header = tuple(cell.strip() for cell in next(rows, (1, []))[1])
    axes = len(header) - 1
    if axes not in _AXES or header != ("image", *(f"q{k}" for k in range(1, axes + 1))):
        raise DataError(
            f"the first line is {','.join(header)!r}",
            where=f"{path}:1",
            remedy="It must be image,q1,q2,… with a column for each of the arm's axes",
        )
    joints: dict[str, Array] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}:{line}"
        try:
            values = np.array([float(cell) for cell in row[1:]])
        except ValueError:
            raise DataError("a field is not a number", where=where, remedy="Correct the line") from None
        if values.shape != (axes,) or not np.isfinite(values).all():
            raise DataError(f"not {axes} finite numbers after the name", where=where, remedy="Correct the line")
        if np.abs(values).max() > _LARGEST_RAD:
            raise DataError(
                f"{np.abs(values).max():.0f} rad is not a joint angle", where=where, remedy="Write radians"
            )
        if row[0].strip() in joints:
            raise DataError(f"image {row[0].strip()} has two rows", where=where, remedy="Remove one of them")
        joints[row[0].strip()] = values
    names = matched_names(images, joints, str(path), what="row of joints")
    missing = [image for image in images if image not in names]
    if missing:
        raise DataError(
            f"no joints for {counted(len(missing), 'image')}: {', '.join(missing[:5])}",
            where=str(path),
            remedy="Add their rows, or leave the images out",
        )
    return {image: joints[names[image]] for image in images}
