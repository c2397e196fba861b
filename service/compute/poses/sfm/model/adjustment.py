"""Triangulates all tracks from initial poses and adjusts poses and points with pycolmap, in the child process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap

from service.compute.camera_model import CameraModel
from service.compute.poses.colmap.convention import (
    from_colmap_camera,
    from_colmap_pose,
    to_colmap_camera,
    to_colmap_pixels,
    to_colmap_pose,
)
from service.compute.poses.sfm.model.track_building import Index, TrackedFeatures, triangulate, wide_enough
from service.compute.poses.sfm.options import Progress, reduction
from service.core.geometry import Array

_LEAST = 30  # observations below which an image's pose is dropped
_TRIES = 4  # adjustments of few tracks that bring rough poses within the final limit
_MEDIAN = np.sqrt(2 * np.log(2))  # median length of a two-dimensional Gaussian error, in sigmas


@dataclass(frozen=True, slots=True)
class Features:
    """Pixels (n, 2) of every image's features, and the camera."""

    pixels: list[Array] = field(repr=False)
    camera: CameraModel

    def of(self, sightings: TrackedFeatures) -> Array:
        """(O, 2) pixels of the observations."""
        offset = np.concatenate([[0], np.cumsum([len(p) for p in self.pixels])])
        every = np.concatenate([np.empty((0, 2)), *self.pixels])
        return every[offset[sightings.image] + sightings.feature]


def adjust(
    start: Mapping[int, Array],
    features: Features,
    sightings: TrackedFeatures,
    few: Index,
    settings: Mapping[str, Any],
    progress: Progress,
) -> pycolmap.Reconstruction | None:
    """The adjusted model of the images with an initial pose; None if hardly any observation fits.

    A few tracks are adjusted first, until the poses are within the limit of the final adjustment, in which all tracks
    take part. Observations are selected anew from all of them before each adjustment, so a rough start loses none.

    Args:
        start: initial T_world_camera by image index.
        features: of all images.
        sightings: all tracks.
        few: numbers of the tracks that are adjusted first.
        settings: SfmOptions as a dictionary.
        progress: called with ("adjust", done, total).
    """
    camera = features.camera
    scale = reduction(settings["max_image_size"], camera.width, camera.height)
    limit = settings["filter_error_px"] * scale
    poses = dict(start)
    chosen = np.zeros(sightings.count, dtype=np.bool_)
    chosen[few] = True
    small = sightings.kept(chosen[sightings.track])[0]
    steps = [_Step(small, limit, rough=True, tolerance=1e-5)] * _TRIES
    steps += [_Step(sightings, limit, rough=False, tolerance=tolerance) for tolerance in (1e-5, 1e-6)]
    model = None
    good = False
    for turn, step in enumerate(steps):
        progress("adjust", turn, len(steps))
        if step.rough and good:
            continue
        found = _fitting(poses, features, camera, step, settings)
        if found is None:
            return None
        model = _model(found, features, camera)
        _bundle(model, settings, found.sigma_px if step.rough else settings["loss_px"] * scale, step.tolerance)
        poses, camera = _poses(model), from_colmap_camera(model.camera(1))
        good = found.limit_px <= 2 * limit
    assert model is not None
    progress("adjust", len(steps), len(steps))
    model.update_point_3d_errors()
    return model


@dataclass(frozen=True, slots=True)
class _Step:
    """One adjustment: its tracks, the limit for observations, and the change of cost at which it stops."""

    sightings: TrackedFeatures
    limit_px: float
    rough: bool  # whether the limit is widened to the poses' own error
    tolerance: float


@dataclass(frozen=True, slots=True)
class _Fitting:
    """The observations within the limit, and their points."""

    poses: dict[int, Array]
    sightings: TrackedFeatures
    points: Array
    sigma_px: float
    limit_px: float


def _fitting(
    poses: Mapping[int, Array], features: Features, camera: CameraModel, step: _Step, settings: Mapping[str, Any]
) -> _Fitting | None:
    """The observations that agree with the poses; None if hardly any do."""
    sightings, limit_px = step.sightings, step.limit_px
    focal = 0.5 * (camera.fx + camera.fy)
    known = np.zeros(len(features.pixels), dtype=np.bool_)
    known[list(poses)] = True
    every = np.tile(np.eye(4), (len(features.pixels), 1, 1))
    every[list(poses)] = list(poses.values())
    used, _ = sightings.kept(known[sightings.image], settings["min_track"])
    if used.count == 0:
        return None
    plane = camera.normalise(features.of(used))
    sigma = limit_px / 3
    points, error = triangulate(every, plane, used, sigma / focal)
    if step.rough:
        sigma = max(sigma, focal * float(np.median(error)) / _MEDIAN)
        limit_px = max(limit_px, 4 * sigma)
        points, error = triangulate(every, plane, used, sigma / focal)
    good = (focal * error <= limit_px) & wide_enough(every, points, used)[used.track]
    seen = np.bincount(used.image[good], minlength=len(features.pixels)) >= _LEAST
    left, tracks = used.kept(good & seen[used.image], settings["min_track"])
    if seen.sum() < 3 or left.count == 0:
        return None
    kept = {k: T for k, T in poses.items() if seen[k]}
    return _Fitting(kept, left, points[tracks], sigma, limit_px)


def _model(found: _Fitting, features: Features, camera: CameraModel) -> pycolmap.Reconstruction:
    """COLMAP's model of poses, points and observations; image k gets the id k + 1."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(to_colmap_camera(camera))
    for k in sorted(found.poses):
        image = pycolmap.Image(
            name=f"{k:05d}.jpg", keypoints=to_colmap_pixels(features.pixels[k]), camera_id=1, image_id=k + 1
        )
        model.add_image_with_trivial_frame(image, to_colmap_pose(found.poses[k]))
    sightings = found.sightings
    order = np.argsort(sightings.track, kind="stable")
    ends = np.cumsum(np.bincount(sightings.track, minlength=sightings.count))
    image, feature = (sightings.image[order] + 1).tolist(), sightings.feature[order].tolist()
    first = 0
    for point, end in zip(found.points, ends.tolist(), strict=True):
        elements = [pycolmap.TrackElement(image[o], feature[o]) for o in range(first, end)]
        model.add_point3D(point, pycolmap.Track(elements))
        first = end
    return model


def _poses(model: pycolmap.Reconstruction) -> dict[int, Array]:
    return {k - 1: from_colmap_pose(model.image(k).cam_from_world()) for k in sorted(model.reg_image_ids())}


def _bundle(model: pycolmap.Reconstruction, settings: Mapping[str, Any], loss_px: float, tolerance: float) -> None:
    """Adjust poses and points, and the camera if configured, until the relative change of the cost is `tolerance`."""
    options = pycolmap.BundleAdjustmentOptions()
    # A wrong principal point rotates the cameras by its angle, so the focal length is refined only together with it.
    options.refine_focal_length = settings["refine"] == "intrinsics"
    options.refine_principal_point = settings["refine"] != "nothing"
    options.refine_extra_params = settings["refine"] == "intrinsics"
    options.print_summary = False
    options.min_track_length = settings["min_track"]
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.use_gpu = False
    solver = options.ceres.solver_options
    solver.num_threads = settings["mapping_threads"]
    solver.max_num_iterations = 50
    solver.function_tolerance = tolerance
    solver.gradient_tolerance = 1e-10
    pycolmap.bundle_adjustment(model, options)
