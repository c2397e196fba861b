"""Makes the preview of a run's data set, piece by piece, with small pictures; the screen shows each piece at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.pixels.render import seen_points
from service.compute.pixels.views import FULL_HD, ImageCrop, marker_free_crops
from service.core.errors import ComputeError, DataError
from service.core.units import mm
from service.dataset.preview_records import CropPreview, Preview, ViewPreview, put, write_preview
from service.dataset.preview_surfaces import SimplifiedMesh, fused_mesh, shown_coverage, shown_distances
from service.dataset.records import DataSet, Pixels, PosedView
from service.dataset.run_data_set import data_set_of, specimen_pixels
from service.dataset.summary import RecordedFusion, RunSummary, recorded_fusion

Progress = Callable[[str, int, int], None]  # activity, amount done, total


def make_preview(summary: RunSummary, folder: Path, progress: Progress) -> Preview:
    """Write pictures and figures of a run's data set into a folder.

    Args:
        summary: the run.
        folder: the preview's folder; it is made if it is not there, and its content is replaced.
        progress: a function that is called with the activity, the amount done and the total.

    Raises:
        DataError: there is no data set yet, or a photograph cannot be read.
    """
    progress("reading the run", 0, 0)
    dataset = data_set_of(summary)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = partial(specimen_pixels, summary)
    preview = _begun(dataset, crop_size(dataset, wanted))
    write_preview(folder, preview)
    mesh = SimplifiedMesh.of(dataset.mesh)
    counts, views = np.zeros(len(mesh.points_m), dtype=np.int64), list(preview.views)
    for k, view in enumerate(dataset.views):
        progress("pictures", k, len(views))
        crops = marker_free_crops(wanted(view), dataset.pixels.markers(view), preview.crop, CROPS)
        views[k], small = small_pictures(folder, views[k], view, dataset.pixels, crops)
        counts += seen_points(mesh.points_m, small.camera, view.T_world_camera, small.depth_m)
        preview = dataclasses.replace(preview, views=tuple(views))
        write_preview(folder, preview)
    coverage = shown_coverage(folder, summary, dataset, mesh, counts)
    preview = dataclasses.replace(preview, coverage=coverage)
    write_preview(folder, preview)
    fusion = recorded_fusion(summary)
    if fusion is not None:
        progress("colouring the ground truth", 0, 0)
        truth = fused_mesh(folder, summary, fusion, mesh)
        preview = dataclasses.replace(preview, ground_truth=truth)
        write_preview(folder, preview)
    progress("comparing the CT with the scan", 0, 0)
    preview = dataclasses.replace(_with_distances(preview, folder, summary, fusion), whole=True)
    write_preview(folder, preview)
    return preview


def _begun(dataset: DataSet, crop: tuple[int, int]) -> Preview:
    """Return all views, with the names of the files that they will have."""
    named = dataset.splits.named()
    views = tuple(
        ViewPreview(
            name=view.name,
            width=view.camera.width,
            height=view.camera.height,
            splits=tuple(split for split, names in named.items() if view.name in names),
            thumbnail=f"v{k:04d}-thumb.jpg",
            image=f"v{k:04d}-image.jpg",
            depth=f"v{k:04d}-depth.webp",
        )
        for k, view in enumerate(dataset.views)
    )
    return Preview(views, crop)


def _with_distances(preview: Preview, folder: Path, summary: RunSummary, fusion: RecordedFusion | None) -> Preview:
    try:
        return dataclasses.replace(preview, distances=shown_distances(folder, summary, fusion))
    except (DataError, ComputeError) as error:
        return dataclasses.replace(preview, no_distances=error.what)


THUMBNAIL_PX, IMAGE_PX = 320, 1280  # widths
CROPS = 2  # of each view
_PARTS = (2, 3, 4)  # of the sides of a small photograph
_ROUND = 8  # crops of small photographs have sides that are multiples of this
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 82)
_WEBP = (cv2.IMWRITE_WEBP_QUALITY, 80)
_NEAR, _FAR = 2.0, 98.0  # percentiles of the depth at the ends of the colours

Colours = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SmallDepth:
    """Depth (H, W) of a view at the size of its small picture, z in metres, with its camera."""

    camera: CameraModel
    depth_m: NDArray[np.float32]


def crop_size(dataset: DataSet, wanted: Callable[[PosedView], Mask]) -> tuple[int, int]:
    """Return the full HD where that is within the photograph, else a half, a third or a quarter of its sides.

    The largest that is free of markers in one of three views; the smallest if none is.

    Args:
        dataset: whole photographs.
        wanted: (H, W) pixels of a view that show the specimen.
    """
    camera = dataset.views[0].camera
    sizes = [(camera.width // part // _ROUND * _ROUND, camera.height // part // _ROUND * _ROUND) for part in _PARTS]
    if camera.width >= FULL_HD[0] and camera.height >= FULL_HD[1]:
        sizes = [FULL_HD, *(size for size in sizes if size[0] < FULL_HD[0])]
    few = dataset.views[:: max(1, len(dataset.views) // 3)][:3]
    masks = [(wanted(view), dataset.pixels.markers(view)) for view in few]
    fitting = (size for size in sizes if any(marker_free_crops(*both, size, 1) for both in masks))
    return next(fitting, sizes[-1])


def small_pictures(
    folder: Path, shown: ViewPreview, view: PosedView, pixels: Pixels, crops: Sequence[ImageCrop]
) -> tuple[ViewPreview, SmallDepth]:
    """Write the pictures of a view. Returns the view with what they show, and its depth.

    Args:
        folder: the preview's folder.
        shown: the view, whose files are to be written.
        view: the same view in the data set.
        pixels: the pixels of the data set.
        crops: the crops of the view.

    Raises:
        DataError: the photograph cannot be read.
    """
    colours = pixels.colours(view)
    put(folder, shown.image, _encoded(".jpg", _reduced(colours, IMAGE_PX), _JPEG))
    put(folder, shown.thumbnail, _encoded(".jpg", _reduced(colours, THUMBNAIL_PX), _JPEG))
    small = small_camera(view.camera)
    depth_m = pixels.depth_m(dataclasses.replace(view, camera=small))
    near_m, far_m = _ends(depth_m)
    put(folder, shown.depth, _encoded(".webp", depth_colours(depth_m, near_m, far_m), _WEBP))
    parts = tuple(_part(folder, shown, colours, crop, number) for number, crop in enumerate(crops))
    told = dataclasses.replace(shown, near_mm=mm(near_m), far_mm=mm(far_m), crops=parts, ready=True)
    return told, SmallDepth(small, depth_m)


def small_camera(camera: CameraModel) -> CameraModel:
    """Return the camera of the small picture."""
    if camera.width <= IMAGE_PX:
        return camera
    return camera.scaled(IMAGE_PX, max(1, round(camera.height * IMAGE_PX / camera.width)))


def depth_colours(depth_m: NDArray[np.float32], near_m: float, far_m: float) -> Colours:
    """Colour a depth, (H, W, 4) blue, green, red, opacity: near is yellow, far violet, no surface transparent."""
    level = np.clip((far_m - depth_m) / max(far_m - near_m, 1e-9) * 255, 0, 255).astype(np.uint8)
    colours = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    return np.dstack([colours, np.where(depth_m > 0, 255, 0).astype(np.uint8)])


def _part(folder: Path, shown: ViewPreview, colours: Colours, crop: ImageCrop, number: int) -> CropPreview:
    """Write the small picture of a crop."""
    name = shown.thumbnail.replace("-thumb.", f"-crop{number}.")
    put(folder, name, _encoded(".jpg", _reduced(colours[crop.slices], THUMBNAIL_PX), _JPEG))
    return CropPreview(crop.x, crop.y, crop.width, crop.height, name)


def _ends(depth_m: NDArray[np.float32]) -> tuple[float, float]:
    some = depth_m[::4, ::4]
    some = some[some > 0]
    if not len(some):
        return 0.0, 0.0
    near, far = np.percentile(some, (_NEAR, _FAR))
    return float(near), float(far)


def _reduced(colours: Colours, width: int) -> Colours:
    if colours.shape[1] <= width:
        return colours
    size = (width, max(1, round(colours.shape[0] * width / colours.shape[1])))
    return np.asarray(cv2.resize(colours, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _encoded(suffix: str, picture: Colours, options: tuple[int, int]) -> bytes:
    done, data = cv2.imencode(suffix, picture, options)
    if not done:
        raise DataError("a picture of the preview cannot be encoded", where=suffix)
    return data.tobytes()
