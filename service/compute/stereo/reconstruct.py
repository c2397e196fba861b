"""From posed images to a mesh: pairs, depth maps, fusion, surface."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from service.compute.ground_truth.surface import Surface
from service.compute.stereo.fusion import fused
from service.compute.stereo.matching import DepthMap, depth_of_pair
from service.compute.stereo.pairs import StereoView, looked_at_m, stereo_pairs
from service.compute.stereo.rectify import rectified
from service.compute.stereo.surface import surface_of
from service.core.errors import ComputeError

WIDTH_PX = 960  # of the images that are matched; larger ones are made smaller
VOXEL_PX = 1.5  # size of a voxel in pixels at the object
_MANY = 24  # depth maps; a surface that so many could see must be seen by three

Progress = Callable[[str, int, int], None]


def reconstruct(views: Sequence[StereoView], progress: Progress) -> Surface:
    """The surface that posed images of pinhole cameras show, in the frame and unit of the poses.

    Raises:
        ComputeError: no two images can be matched, or no surface comes out.
    """
    small = [_smaller(view) for view in views]
    centre = looked_at_m(small)
    pairs = stereo_pairs(small)
    maps: list[DepthMap] = []
    for k, (one, two) in enumerate(pairs):
        progress("matching pairs", k, len(pairs))
        distance = float(np.linalg.norm(0.5 * (small[one].eye_m + small[two].eye_m) - centre))
        found = depth_of_pair(rectified(small[one], small[two], centre), distance)
        if found is not None:
            maps.append(found)
    if not maps:
        raise ComputeError("no pair of images could be matched", remedy="Use more images, at smaller angles")
    footprint = np.median([np.linalg.norm(view.eye_m - centre) / view.camera.fx for view in small])
    least = 3 if len(maps) >= _MANY else 1
    progress("fusing depth maps", 0, 0)
    return surface_of(fused(maps, VOXEL_PX * float(footprint), least), least)


def _smaller(view: StereoView) -> StereoView:
    camera = view.camera
    if camera.width <= WIDTH_PX:
        return view
    size = (WIDTH_PX, round(camera.height * WIDTH_PX / camera.width))
    image = np.asarray(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return dataclasses.replace(view, image=image, camera=camera.scaled(*size))
