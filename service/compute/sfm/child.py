"""Maps features and matches with pycolmap in the child process of structure from motion, its output in a log."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_grey
from service.compute.sfm.colmap import (
    extract_sift,
    from_colmap_camera,
    from_colmap_pixels,
    from_colmap_pose,
    to_colmap_camera,
    to_colmap_pixels,
    to_colmap_pose,
)
from service.compute.sfm.features import (
    Index,
    TrackedFeatures,
    build_tracks,
    match_descriptors,
    thinned,
    triangulate,
    wide_enough,
)
from service.compute.sfm.options import Progress, reduction
from service.core.errors import DataError, OrthocaptureError
from service.core.geometry import Array, align_points
from service.machine.resources import keep_freed_memory


def main(log: str, seed: int, pipe: Connection) -> None:
    """Process (task, job) messages until the other end is closed.

    Sends ("progress", (stage, done, total)) in between, and ("result", value) or ("error", what) at the end of each.
    """
    handle = os.open(Path(log), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    pycolmap.logging.logtostderr = True
    cv2.setNumThreads(1)
    tasks: dict[str, Callable[[dict[str, Any], Progress], Any]] = {
        "extract": _extract,
        "match": _match,
        "map": _map_images,
    }

    def progress(stage: str, done: int, total: int) -> None:
        pipe.send(("progress", (stage, done, total)))

    while True:
        try:
            task, job = pipe.recv()
        except (EOFError, OSError):
            return
        pycolmap.set_random_seed(seed)
        try:
            answer = ("result", tasks[task](job, progress))
        except OrthocaptureError as error:
            answer = ("error", error)
        except (RuntimeError, ValueError, OSError) as error:  # raised by pycolmap
            answer = ("error", str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__)
        pipe.send(answer)


def _extract(job: dict[str, Any], _progress: Progress) -> dict[str, Any]:
    options, camera = job["options"], job["camera"]
    image = read_grey(Path(job["file"]))
    size = (image.shape[1], image.shape[0])
    if size != (camera["width"], camera["height"]):
        raise DataError(
            f"the image is {size[0]}×{size[1]}, the camera {camera['width']}×{camera['height']}",
            where=job["file"],
            remedy="Check the file, and that the calibration was made at the images' size",
        )
    scale = np.ones(2)
    factor = reduction(options["max_image_size"], *size)
    if factor > 1:
        small = (round(size[0] / factor), round(size[1] / factor))
        image = np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        scale = np.array(size) / np.array(small)
    found = extract_sift(image, options["max_features"], options["first_octave"])
    return {
        "width": size[0],
        "height": size[1],
        "pixels": from_colmap_pixels(found.points * scale).astype(np.float32),
        "scales_px": (found.scales_px * float(scale.mean())).astype(np.float32),
        "descriptors": found.descriptors,
    }


def _match(job: dict[str, Any], _progress: Progress) -> dict[str, Any]:
    """Return the matches by descriptor, then those consistent with one epipolar geometry."""
    options = job["options"]
    matches = match_descriptors(*job["descriptors"])
    verification = pycolmap.TwoViewGeometryOptions()
    camera = CameraModel(**job["camera"])
    verification.ransac.max_error = options["verification_error_px"] * reduction(
        options["max_image_size"], camera.width, camera.height
    )
    verification.ransac.random_seed = options["seed"]
    colmap = to_colmap_camera(camera)
    colmap.has_prior_focal_length = True
    first, second = (to_colmap_pixels(pixels.astype(np.float64)) for pixels in job["pixels"])
    geometry = pycolmap.estimate_two_view_geometry(colmap, first, colmap, second, matches, verification)
    features: NDArray[np.uint32] = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    matrices: list[Array] = [
        np.zeros((3, 3)) if M is None else np.asarray(M, dtype=np.float64)
        for M in (geometry.E, geometry.F, geometry.H)
    ]
    return {"features": features, "configuration": int(geometry.config), "matrices": np.array(matrices)}


_VERIFIED = 15  # least number of matches of a pair; COLMAP's own limit
_SHARE = 600  # tracks per image for the mapper
_PAIR_SHARE = 60  # tracks per pair, if it has as many


def _map_images(job: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Return poses and tracks of the largest model of a job's images, adjusted and written into its workspace."""
    camera = CameraModel(**job["camera"])
    features = Features([np.asarray(pixels, dtype=np.float64) for pixels in job["pixels"]], camera)
    matches = [m for m in job["matches"] if len(m[2]) >= _VERIFIED]
    sightings = build_tracks(
        [len(pixels) for pixels in features.pixels], [(m[0], m[1]) for m in matches], [m[2] for m in matches]
    )
    few = thinned(sightings, features.of(sightings), _SHARE, _PAIR_SHARE, (camera.width, camera.height))
    if job["mapper"] == "triangulated":
        start, n_models = {k: np.array(T) for k, T in enumerate(job["start"]) if T is not None}, 1
    else:
        start, n_models = _mapped(job, sightings, few, matches, progress)
    nothing = {"poses": {}, "error_px": np.inf, "n_models": n_models}
    if len(start) < 3:
        return nothing
    model = adjust(start, features, sightings, few, job["options"], progress)
    if model is None:
        return nothing
    if job["mapper"] == "triangulated":
        _laid_over(model, start)
    return {**_written(model, job), "n_models": n_models}


def _laid_over(model: pycolmap.Reconstruction, start: dict[int, Array]) -> None:
    """Align the model by a similarity to its initial poses, which define frame and scale."""
    ids = sorted(model.reg_image_ids())
    found = np.array([from_colmap_pose(model.image(k).cam_from_world())[:3, 3] for k in ids])
    T, scale = align_points(np.array([start[k - 1][:3, 3] for k in ids]), found, with_scale=True)
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(T[:3, :3]), T[:3, 3]))


def _written(model: pycolmap.Reconstruction, job: dict[str, Any]) -> dict[str, Any]:
    """Return the model as plain data, and written as COLMAP's files with the images' own names."""
    poses: dict[int, Any] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        poses[image_id - 1] = from_colmap_pose(image.cam_from_world())
        image.name = job["names"][image_id - 1]
    final = Path(job["workspace"]) / job["mapper"]
    shutil.rmtree(final, ignore_errors=True)
    final.mkdir()
    model.write_binary(final)
    return {
        "poses": poses,
        "camera": dataclasses.asdict(from_colmap_camera(model.camera(1))),
        **_tracks(model),
        "error_px": float(model.compute_mean_reprojection_error()),
        "track_length": float(model.compute_mean_track_length()),
    }


def _mapped(
    job: dict[str, Any], sightings: TrackedFeatures, few: Index, matches: list[Any], progress: Progress
) -> tuple[dict[int, Array], int]:
    """Return poses by image index from the mapper's largest model, and the number of models it produced."""
    workspace = Path(job["workspace"])
    database = workspace / f"{job['mapper']}.db"  # one for each mapper: two may work side by side
    _write_database(job, database, _matches_of(sightings, few, matches, job["pixels"]))
    raw = workspace / f"{job['mapper']}_raw"
    shutil.rmtree(raw, ignore_errors=True)
    raw.mkdir()
    mapper = _incremental if job["mapper"] == "incremental" else _global
    models = mapper(job, database, raw, progress)
    if not models:
        return {}, 0
    best = max(models.values(), key=lambda m: m.num_reg_images())
    ids = sorted(best.reg_image_ids())
    return {k - 1: from_colmap_pose(best.image(k).cam_from_world()) for k in ids}, len(models)


def _matches_of(sightings: TrackedFeatures, few: Index, matches: list[Any], pixels: list[Any]) -> list[Any]:
    """Return the matches between features of the selected tracks."""
    chosen = np.zeros(sightings.count, dtype=np.bool_)
    chosen[few] = True
    rows = chosen[sightings.track]
    inside = [np.zeros(len(p), dtype=np.bool_) for p in pixels]
    for i in range(len(inside)):
        inside[i][sightings.feature[rows & (sightings.image == i)]] = True
    out: list[Any] = []
    for i, j, found, configuration, matrices in matches:
        kept = found[inside[i][found[:, 0]] & inside[j][found[:, 1]]]
        out.append((i, j, kept, configuration, matrices))
    return out


def _write_database(job: dict[str, Any], path: Path, matches: list[Any]) -> None:
    """Write COLMAP's database; images and pairs in the order of their names, numbered from 1."""
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        camera = to_colmap_camera(CameraModel(**job["camera"]))
        camera.has_prior_focal_length = True
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for k, pixels in enumerate(job["pixels"]):
            # A name that COLMAP's list files cannot misread.
            image = pycolmap.Image(name=f"{k:05d}.jpg", camera_id=1, image_id=k + 1)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=k + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(k + 1, to_colmap_pixels(pixels.astype(np.float64)).astype(np.float32))
        for i, j, features, configuration, matrices in matches:
            if len(features) < _VERIFIED:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = configuration
            geometry.inlier_matches = features
            geometry.E, geometry.F, geometry.H = (M if M.any() else None for M in matrices)
            database.write_matches(i + 1, j + 1, features)
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def _tracks(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Return the points (P, 3), and image index, point index and pixels (our convention) of every observation."""
    number = {point_id: k for k, point_id in enumerate(model.points3D)}
    image_index: list[int] = []
    points: list[int] = []
    pixels: list[Any] = []
    for image_id in sorted(model.reg_image_ids()):
        for observation in model.image(image_id).get_observation_points2D():
            image_index.append(image_id - 1)
            points.append(number[observation.point3D_id])
            pixels.append(observation.xy)
    return {
        "points": np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3),
        "track_image": np.array(image_index, dtype=np.int64),
        "track_point": np.array(points, dtype=np.int64),
        "track_pixels": from_colmap_pixels(np.array(pixels).reshape(-1, 2)),
    }


def _incremental(
    job: dict[str, Any], database: Path, raw: Path, progress: Progress
) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = job["options"]["mapping_threads"]
    options.random_seed = job["options"]["seed"]
    options.min_model_size = 3
    options.extract_colors = False
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    # The final bundle adjustment is ours, so the mapper's own need not run after every tenth image.
    options.ba_global_frames_ratio = 1.3
    options.ba_global_points_ratio = 1.3
    options.ba_global_max_refinements = 2
    options.ba_global_max_num_iterations = 25
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    done = 0

    def registered() -> None:
        nonlocal done
        done += 1
        progress("map", min(done + 2, len(job["names"])), len(job["names"]))

    return pycolmap.incremental_mapping(database, raw, raw, options=options, next_image_callback=registered)


def _global(job: dict[str, Any], database: Path, raw: Path, progress: Progress) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    progress("map", 0, 0)
    options.num_threads = job["options"]["mapping_threads"]
    options.random_seed = job["options"]["seed"]
    mapper = options.mapper
    mapper.num_threads = job["options"]["mapping_threads"]
    mapper.random_seed = job["options"]["seed"]
    # Global positioning starts at random and is slow with many tracks; retriangulation restores the others.
    mapper.keep_max_num_tracks = max(1500, 100 * len(job["names"]))
    mapper.global_positioning.use_gpu = False
    adjustment = mapper.bundle_adjustment
    adjustment.refine_focal_length = False
    adjustment.refine_principal_point = False
    adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu = False
    return pycolmap.global_mapping(database, raw, raw, options=options)


_LEAST = 30  # observations below which an image's pose is dropped
_TRIES = 4  # adjustments of few tracks that bring rough poses within the final limit
_MEDIAN = np.sqrt(2 * np.log(2))  # median length of a two-dimensional Gaussian error, in sigmas


@dataclass(frozen=True, slots=True)
class Features:
    """Pixels (n, 2) of every image's features, and the camera."""

    pixels: list[Array] = field(repr=False)
    camera: CameraModel

    def of(self, sightings: TrackedFeatures) -> Array:
        """Return (O, 2) pixels of the observations."""
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
    """Adjust the model of the images with an initial pose; None if hardly any observation fits.

    A few tracks are adjusted first, until the poses are within the limit of the final adjustment, in which all tracks
    take part. Observations are selected again from all of them before each adjustment, so a rough start loses none.

    Args:
        start: initial T_world_camera by image index.
        features: features of all images.
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
    """Return the observations that agree with the poses; None if hardly any do."""
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
    """Return COLMAP's model of poses, points and observations; image k gets the id k + 1."""
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


if __name__ == "__main__":
    keep_freed_memory()
    main(sys.argv[1], int(sys.argv[2]), Connection(int(sys.argv[3])))
