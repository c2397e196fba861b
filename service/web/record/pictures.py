"""Small copies of large photographs in DIR/cache: made once, replaced as a whole, never evidence."""

from __future__ import annotations

import hashlib
import os
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from service.core.errors import DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

PICTURES = frozenset({"image/jpeg", "image/png"})
WIDTHS = (64, 96, 160, 320, 640)  # of thumbnails: a few sizes, so that nobody fills the disk with thousands
IMAGE_WIDTHS = (*WIDTHS[3:], 960, 1280, 1920)
#: Drawn on the screen's copy, so that every screen shows the same; version of all that follows.
_VERSION = "1"
_DECODING = threading.BoundedSemaphore(2)  # the capture and its worker need the processor more
_SAFE_NAME = re.compile(r"[^\w.+() -]+")

MarkKind = Literal["registration", "control", "sphere", "unassigned"]
# BGR. Line style and label say the same as the colour.
_COLOURS: dict[MarkKind, tuple[int, int, int]] = {
    "registration": (90, 230, 90),
    "control": (255, 190, 60),
    "sphere": (90, 230, 90),
    "unassigned": (70, 170, 255),
}
_DASHES: dict[MarkKind, tuple[int, int] | None] = {  # drawn, left out: segments of the outline; None: all drawn
    "registration": None,
    "control": (7, 5),
    "sphere": None,
    "unassigned": (2, 4),
}


@dataclass(frozen=True, slots=True)
class DrawnOutline:
    """The outline of one sphere in one image.

    Attributes:
        kind: the kind of thing whose outline it is.
        label: the text that is written into it.
        outline_px: (L, 2) points in pixels of the image as captured.
    """

    kind: MarkKind
    label: str
    outline_px: NDArray[np.float64]


_REMEDY = "Download the recorded file and look at it; it is kept unchanged as evidence"


def nearest_width(width: int, among: Sequence[int] = WIDTHS) -> int:
    """Return the smallest size on offer that is at least `width`, or the largest."""
    return next((known for known in among if known >= width), among[-1])


def cached(folder: Path, key: str, suffix: str, make: Callable[[], bytes]) -> Path:
    """Return the file of a key, made when it is not there. Raises OSError, and what `make` raises."""
    digest = hashlib.sha256(f"{_VERSION} {key}".encode()).hexdigest()
    path = folder / "cache" / digest[:2] / f"{digest}{suffix}"
    if not path.is_file():
        content = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}.part")
        temporary.write_bytes(content)
        temporary.replace(path)
    return path


def reduced_jpeg(path: Path, width: int, marks: Sequence[DrawnOutline] = (), *, upright: bool = False) -> bytes:
    """Return a JPEG of this width, or of the picture's own width if that is smaller, with outlines drawn over it.

    With `upright` it is rotated as its orientation tag says, for people; otherwise it is as stored, for measuring.

    A photograph is decoded at an eighth, a quarter or half of its size if that is wide enough.

    Raises:
        DataError: it is not a picture that can be decoded.
    """
    import cv2  # noqa: PLC0415 - a web process starts without it

    from service.compute.images.photographs import decode_reduced  # noqa: PLC0415 - the same

    content = path.read_bytes()
    with _DECODING:
        picture, stored_px = decode_reduced(content, width, path.name, upright=upright)
        if marks:
            draw_marks(picture, marks, picture.shape[1] / stored_px)
        quality = 80 if width <= WIDTHS[-1] else 88
        done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise DataError("the picture cannot be encoded", where=path.name, remedy=_REMEDY)
    return encoded.tobytes()


def draw_marks(picture: NDArray[np.uint8], marks: Sequence[DrawnOutline], scale: float) -> None:
    """Draw outlines into a picture (H, W, 3): solid, dashed or dotted by kind, each with its label in its middle."""
    import cv2  # noqa: PLC0415 - a web process starts without it
    import numpy as np  # noqa: PLC0415

    width = max(1, round(picture.shape[1] / 500))
    for mark in marks:
        colour = _COLOURS[mark.kind]
        curve = np.rint(((mark.outline_px + 0.5) * scale - 0.5) * 16).astype(np.int32)
        for segment in _segments(curve, _DASHES[mark.kind]):
            for tone, extra in (((0, 0, 0), 2), (colour, 0)):
                closed = len(segment) == len(curve)
                cv2.polylines(picture, [segment], closed, tone, width + extra, cv2.LINE_AA, shift=4)
        if mark.label and picture.shape[1] >= WIDTHS[-1]:
            size = picture.shape[1] / 1700
            x, y = np.rint(mark.outline_px.mean(axis=0) * scale).astype(int)
            place = (int(x - 9 * size * len(mark.label)), int(y + 9 * size))
            for tone, thickness in (((0, 0, 0), 3 * width), (colour, width)):
                cv2.putText(picture, mark.label, place, cv2.FONT_HERSHEY_SIMPLEX, size, tone, thickness, cv2.LINE_AA)


def _segments(curve: NDArray[np.int32], dash: tuple[int, int] | None) -> list[NDArray[np.int32]]:
    if dash is None:
        return [curve]
    on, off = dash
    return [curve[k : k + on + 1] for k in range(0, len(curve), on + off)]


def safe_name(name: str, sha256: str) -> str:
    """Return a safe name for a download: no folder, and no characters with a meaning for a shell or a header."""
    last = _SAFE_NAME.sub("_", name.replace("\\", "/").rsplit("/", 1)[-1]).strip(" .")
    return last[-120:].lstrip(" .") or sha256[:12]
