"""What a page shows of a data set, as it lies in the folder of a preview: a list, and the names of the files."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

LIST = "preview.json"
FILE_NAME = re.compile(r"[a-z0-9_-]{1,60}\.(jpg|webp|json)")
AT_LEAST = (1, 2, 4, 8)  # numbers of views for which the coverage is reported


@dataclass(frozen=True, slots=True)
class CropPreview:
    """A part of a view without spheres and posts: its place in pixels of the photograph, and its small picture."""

    x: int
    y: int
    width: int
    height: int
    file: str


@dataclass(frozen=True, slots=True)
class ViewPreview:
    """A view. Its files are there when `ready`.

    Attributes:
        name: the view's name.
        width, height: size of the photograph, px.
        splits: the splits to which it belongs.
        thumbnail, image, depth: files; the depth is a picture with a transparent ground, as large as the image.
        near_mm, far_mm: depths of the surface in it, at the ends of the colours; 0 where none is seen.
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
    crops: tuple[CropPreview, ...] = ()
    ready: bool = False


@dataclass(frozen=True, slots=True)
class CoveragePreview:
    """Share of the surface that at least AT_LEAST views see; `figure`: file of the coloured mesh."""

    shares: tuple[float, ...]
    figure: str


@dataclass(frozen=True, slots=True)
class DecidedRegion:
    """A region in which a person or the protocol decided which source counts: `ct` or `scan`, and who it was."""

    source: str
    by: str


@dataclass(frozen=True, slots=True)
class GroundTruthPreview:
    """The mesh that was fused from CT and scan, as its step recorded it.

    Attributes:
        step: the step's title.
        ct_share, scan_share, blend_share: shares of the vertices, by what they come from.
        sigma_median_mm: median of the recorded standard deviations of the vertices.
        sigma_high_mm: value that 99 % of them do not exceed.
        distance_change_max_mm: largest change of two spheres' distance from the CT to the scan, by the transport.
        loop_closure_mm: largest way of a sphere from scan to CT and back by the cameras; None without images.
        faces: number of faces of the mesh.
        regions: corrections of the proposed wound.
        sources, sigmas: files of the mesh, coloured by source and by standard deviation.
    """

    step: str
    ct_share: float
    scan_share: float
    blend_share: float
    sigma_median_mm: float
    sigma_high_mm: float
    distance_change_max_mm: float
    loop_closure_mm: float | None
    faces: int
    regions: tuple[DecidedRegion, ...]
    sources: str
    sigmas: str


@dataclass(frozen=True, slots=True)
class DistancePreview:
    """The CT against the scan, in the frame of the scan.

    Attributes:
        chamfer_mm: mean of the two directions.
        ct_to_scan_mm, scan_to_ct_mm: mean distances.
        ct_to_scan_median_mm, scan_to_ct_median_mm: medians of the same distances.
        floor_mm: Chamfer distance that the sampling alone would cause if the surfaces were equal.
        excluded: share of the samples beyond `outlier_mm`, in no mean; None: the record does not say.
        outlier_mm, spacing_mm: settings of the comparison: limit of outliers, and spacing of the samples.
        spheres: number of spheres by which the two were brought together.
        spheres_rms_mm: root mean square distance of these spheres.
        figure: file of the scan, coloured by its distance to the CT.
        picture: file of both, seen from above.
        step: title of the step that recorded these figures; "": they were computed for the screen alone.
    """

    chamfer_mm: float
    ct_to_scan_mm: float
    scan_to_ct_mm: float
    ct_to_scan_median_mm: float
    scan_to_ct_median_mm: float
    floor_mm: float
    excluded: float | None
    outlier_mm: float
    spacing_mm: float
    spheres: int
    spheres_rms_mm: float
    figure: str
    picture: str
    step: str = ""


@dataclass(frozen=True, slots=True)
class Preview:
    """A data set on the screen, as far as it is ready.

    Attributes:
        views: all views.
        crop: width and height of the crops, px.
        coverage: the views' coverage of the surface; None: not yet.
        ground_truth: the fused mesh; None: not yet, or the mesh is the scan's.
        distances: the CT against the scan; None: not yet, or `no_distances` says why not.
        no_distances: the reason.
        whole: true when nothing more will come.
    """

    views: tuple[ViewPreview, ...]
    crop: tuple[int, int]
    coverage: CoveragePreview | None = None
    ground_truth: GroundTruthPreview | None = None
    distances: DistancePreview | None = None
    no_distances: str = ""
    whole: bool = False


_PREVIEW = TypeAdapter(Preview)


def write_preview(folder: Path, preview: Preview) -> None:
    """Write the list, whole at every moment."""
    put(folder, LIST, _PREVIEW.dump_json(preview))


def read_preview(folder: Path) -> Preview | None:
    """Return the list; None if there is none that can be read."""
    try:
        return _PREVIEW.validate_json((folder / LIST).read_bytes())
    except (OSError, ValidationError):
        return None


def put(folder: Path, name: str, content: bytes) -> str:
    """Write or replace a file atomically. Returns its name."""
    part = folder / f"{name}.{os.getpid()}.part"
    part.write_bytes(content)
    part.replace(folder / name)
    return name
