"""What a page shows of a data set, as it lies in the folder of a preview: a list, and the names of the files."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

LIST = "preview.json"
FILE_NAME = re.compile(r"[a-z0-9_-]{1,60}\.(jpg|webp|json)")
AT_LEAST = (1, 2, 4, 8)  # views, of which the coverage is told


@dataclass(frozen=True, slots=True)
class ShownCrop:
    """A part of a view without spheres and posts: its place in pixels of the photograph, and its small picture."""

    x: int
    y: int
    width: int
    height: int
    file: str


@dataclass(frozen=True, slots=True)
class ShownView:
    """A view. Its files are there when `ready`.

    Attributes:
        name: of the view.
        width, height: of the photograph, px.
        splits: to which it belongs.
        thumbnail, image, depth: files; the depth is a picture with a transparent ground, as large as the image.
        near_mm, far_mm: of the surface in it, at the ends of the colours; 0 where none is seen.
        crops: the best parts first.
    """

    name: str
    width: int
    height: int
    splits: tuple[str, ...]
    thumbnail: str
    image: str
    depth: str
    near_mm: float = 0.0
    far_mm: float = 0.0
    crops: tuple[ShownCrop, ...] = ()
    ready: bool = False


@dataclass(frozen=True, slots=True)
class ShownCoverage:
    """Share of the surface that at least AT_LEAST views see; `figure`: file of the coloured mesh."""

    shares: tuple[float, ...]
    figure: str


@dataclass(frozen=True, slots=True)
class ShownDistances:
    """The CT against the scan, in the frame of the scan.

    Attributes:
        chamfer_mm: mean of the two directions.
        ct_to_scan_mm, scan_to_ct_mm: means.
        ct_to_scan_median_mm, scan_to_ct_median_mm: of the same distances.
        floor_mm: what the Chamfer distance would be, by the sampling alone, if the surfaces were equal.
        excluded: share of the samples beyond `outlier_mm`, in no mean.
        outlier_mm, spacing_mm: of the comparison.
        spheres: by which the two were brought together, and their root mean square distance.
        spheres_rms_mm: of them.
        figure: file of the scan, coloured by its distance to the CT.
        picture: file of both, seen from above.
    """

    chamfer_mm: float
    ct_to_scan_mm: float
    scan_to_ct_mm: float
    ct_to_scan_median_mm: float
    scan_to_ct_median_mm: float
    floor_mm: float
    excluded: float
    outlier_mm: float
    spacing_mm: float
    spheres: int
    spheres_rms_mm: float
    figure: str
    picture: str


@dataclass(frozen=True, slots=True)
class Preview:
    """A data set on the screen, as far as it is ready.

    Attributes:
        views: all of them.
        crop: width and height of the crops, px.
        coverage: None: not yet.
        distances: None: not yet, or `no_distances` says why not.
        no_distances: reason.
        whole: nothing more will come.
    """

    views: tuple[ShownView, ...]
    crop: tuple[int, int]
    coverage: ShownCoverage | None = None
    distances: ShownDistances | None = None
    no_distances: str = ""
    whole: bool = False


_PREVIEW = TypeAdapter(Preview)


def write_preview(folder: Path, preview: Preview) -> None:
    """Write the list, whole at every moment."""
    put(folder, LIST, _PREVIEW.dump_json(preview))


def read_preview(folder: Path) -> Preview | None:
    """The list; None if there is none that can be read."""
    try:
        return _PREVIEW.validate_json((folder / LIST).read_bytes())
    except (OSError, ValidationError):
        return None


def put(folder: Path, name: str, content: bytes) -> str:
    """Write a file, whole at every moment. Returns its name."""
    part = folder / f"{name}.{os.getpid()}.part"
    part.write_bytes(content)
    part.replace(folder / name)
    return name
