"""Reconstructs a mesh from posed images: pairs, depth maps, fusion; again, finely, near it; then steep parts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from service.compute.images.render import RayMesh
from service.compute.stereo.depth_maps import Pair, depth_maps, stored_views
from service.compute.stereo.fusion import fused, surface_of
from service.compute.stereo.matching import DepthMap
from service.compute.stereo.rectify import StereoView, looked_at_m, stereo_pairs
from service.compute.stereo.steep import closed, completed
from service.compute.surfaces.surface import Surface
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.machine.resources import return_freed_memory

COARSE_PX, FINE_PX = 960, 1920  # width of the images that are matched at first and then; larger ones are made smaller
VOXEL_PX = 1.5  # size of a voxel in pixels at the object
_MANY = 24  # depth maps; a surface that so many could see must be seen by several
_FEWEST_AT_FIRST, _FEWEST = 3, 2  # then

Progress = Callable[[str, int, int], None]


def reconstruct(views: Sequence[StereoView], progress: Progress, *, processes: int = 1) -> Surface:
    """Reconstruct the surface that posed images of pinhole cameras show, in the frame and unit of the poses.

    A first surface from small images, closed where nothing was matched, is the guess around which larger images are
    matched. The depth of both is fused: the first holds more of what is steep, the second is finer. If there are many
    images, the steep parts that the fused surface misses are searched for last.

    Args:
        views: the images and their poses.
        progress: called with what is done, how much is done, and the total.
        processes: number of processes of this machine that match pairs; 1: this one, unless a cluster was chosen.

    Raises:
        ComputeError: no two images can be matched, or no surface comes out.
    """
    small, large = ([_smaller(view, width) for view in views] for width in (COARSE_PX, FINE_PX))
    centre = looked_at_m(small)
    pairs = stereo_pairs(small)
    with stored_views(small) as stored:
        report = _pair_progress(progress, "matching pairs", pairs)
        coarse = depth_maps(stored, pairs, centre, report, processes=processes)
    if not coarse:
        raise ComputeError("no pair of images could be matched", remedy="Use more images, at smaller angles")
    many = len(coarse) >= _MANY
    progress("fusing depth maps", 0, 0)
    first = _surface(coarse, VOXEL_PX * _footprint_m(small, centre), _FEWEST_AT_FIRST if many else 1)
    guess = closed(first)
    near = RayMesh(guess.vertices_m, guess.faces)
    report = _pair_progress(progress, "matching pairs near the first surface", pairs)
    with stored_views(large) as stored:
        fine = depth_maps(stored, pairs, centre, report, guess=near, processes=processes)
    progress("fusing all depth maps", 0, 0)
    fused_all = _surface([*coarse, *fine], VOXEL_PX * _footprint_m(large, centre), _FEWEST if many else 1)
    if not many:
        return fused_all
    del coarse, fine
    return_freed_memory()
    progress("searching what is steep", 0, 0)
    return completed(fused_all, small, _footprint_m(small, centre))


def _surface(maps: Sequence[DepthMap], voxel_m: float, least: int) -> Surface:
    return surface_of(fused(maps, voxel_m, least), least)


def _pair_progress(progress: Progress, what: str, pairs: Sequence[Pair]) -> Callable[[int], None]:
    return lambda done: progress(what, done, len(pairs))


def _footprint_m(views: Sequence[StereoView], centre_m: Array) -> float:
    """Return the width, in metres, that a pixel covers at the object."""
    return float(np.median([np.linalg.norm(view.eye_m - centre_m) / view.camera.fx for view in views]))


def _smaller(view: StereoView, width_px: int) -> StereoView:
    camera = view.camera
    if camera.width <= width_px:
        return view
    size = (width_px, round(camera.height * width_px / camera.width))
    image = np.asarray(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return dataclasses.replace(view, image=image, camera=camera.scaled(*size))
