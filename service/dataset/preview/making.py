"""Makes the preview of a run's data set, piece by piece: the screen shows each as soon as it is there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from service.compute.pixels.render import seen_points
from service.compute.pixels.views import marker_free_crops
from service.core.errors import ComputeError, DataError
from service.dataset.posed.of_run.data_set import data_set_of, specimen_pixels
from service.dataset.posed.records import DataSet
from service.dataset.preview.pictures import CROPS, crop_size, small_pictures
from service.dataset.preview.records import Preview, ViewPreview, write_preview
from service.dataset.preview.surfaces import SimplifiedMesh, fused_mesh, shown_coverage, shown_distances
from service.dataset.recorded_fusion import RecordedFusion, recorded_fusion
from service.dataset.summary import RunSummary

Progress = Callable[[str, int, int], None]  # activity, amount done, total


def make_preview(summary: RunSummary, folder: Path, progress: Progress) -> Preview:
    """Write pictures and figures of a run's data set into a folder.

    Args:
        summary: the run.
        folder: made if it is not there; what it holds is replaced.
        progress: called with the activity, the amount done and the total.

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
    """All views, with the names of the files that they will have."""
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
