"""Maps features and matches with pycolmap, in the child process: a database, a mapper, the final adjustment."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from service.compute.camera_model import CameraModel
from service.compute.poses.colmap_convention import (
    from_colmap_camera,
    from_colmap_pixels,
    from_colmap_pose,
    to_colmap_camera,
    to_colmap_pixels,
)
from service.compute.poses.sfm_options import reduction

Told = Callable[[int, int], None]
_VERIFIED = 15  # matches below which a pair is no pair; COLMAP's own limit


def map_images(job: dict[str, Any], told: Told) -> dict[str, Any]:
    """Poses and tracks of the largest model of the images of a job, adjusted; written into its workspace."""
    workspace = Path(job["workspace"])
    _write_database(job, _database(job))
    raw = workspace / f"{job['mapper']}_raw"
    shutil.rmtree(raw, ignore_errors=True)
    raw.mkdir()
    models = (_incremental if job["mapper"] == "incremental" else _global)(job, raw, told)
    if not models:
        return {"poses": {}, "error_px": np.inf, "n_models": 0}
    best = max(models.values(), key=lambda m: m.num_reg_images())
    _refine(best, job)
    poses: dict[int, Any] = {}
    for image_id in best.reg_image_ids():
        image = best.image(image_id)
        poses[image_id - 1] = from_colmap_pose(image.cam_from_world())
        image.name = job["names"][image_id - 1]
    final = workspace / job["mapper"]
    shutil.rmtree(final, ignore_errors=True)
    final.mkdir()
    best.write_binary(final)
    return {
        "poses": poses,
        "camera": dataclasses.asdict(from_colmap_camera(best.cameras[best.image(best.reg_image_ids()[0]).camera_id])),
        **_tracks(best),
        "error_px": float(best.compute_mean_reprojection_error()),
        "track_length": float(best.compute_mean_track_length()),
        "n_models": len(models),
    }


def _write_database(job: dict[str, Any], path: Path) -> None:
    """COLMAP's database of the pieces; images and pairs in the order of their names, numbered from 1."""
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
        for i, j, features, configuration, matrices in job["matches"]:
            if len(features) < _VERIFIED:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = configuration
            geometry.inlier_matches = features
            geometry.E, geometry.F, geometry.H = (M if M.any() else None for M in matrices)
            database.write_matches(i + 1, j + 1, features)
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def _database(job: dict[str, Any]) -> Path:
    """One for each mapper, since two may work side by side."""
    return Path(job["workspace"]) / f"{job['mapper']}.db"


def _tracks(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Points (P, 3), and image index, point index and our pixels of every observation."""
    number = {point_id: k for k, point_id in enumerate(model.points3D)}
    image_index: list[int] = []
    points: list[int] = []
    pixels: list[Any] = []
    for image_id in model.reg_image_ids():
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


def _incremental(job: dict[str, Any], raw: Path, told: Told) -> dict[int, pycolmap.Reconstruction]:
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
        told(done + 2, len(job["names"]))

    return pycolmap.incremental_mapping(_database(job), raw, raw, options=options, next_image_callback=registered)


def _global(job: dict[str, Any], raw: Path, _told: Told) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = job["options"]["mapping_threads"]
    options.random_seed = job["options"]["seed"]
    mapper = options.mapper
    mapper.num_threads = job["options"]["mapping_threads"]
    mapper.random_seed = job["options"]["seed"]
    # Global positioning starts at random and is slow on many tracks; retriangulation brings the others back.
    mapper.keep_max_num_tracks = max(1500, 100 * len(job["names"]))
    mapper.global_positioning.use_gpu = False
    adjustment = mapper.bundle_adjustment
    adjustment.refine_focal_length = False
    adjustment.refine_principal_point = False
    adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu = False
    return pycolmap.global_mapping(_database(job), raw, raw, options=options)


def _refine(model: pycolmap.Reconstruction, job: dict[str, Any]) -> None:
    """Drop doubtful observations, then adjust poses and points, and the camera if wanted, to convergence."""
    settings = job["options"]
    scale = reduction(settings["max_image_size"], job["camera"]["width"], job["camera"]["height"])
    options = pycolmap.BundleAdjustmentOptions()
    # A principal point that is held wrong turns the cameras by its angle, so intrinsics are refined with it or not.
    options.refine_focal_length = settings["refine"] == "intrinsics"
    options.refine_principal_point = settings["refine"] != "nothing"
    options.refine_extra_params = settings["refine"] == "intrinsics"
    options.print_summary = False
    options.min_track_length = settings["min_track"]
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = settings["loss_px"] * scale
    options.ceres.solver_options.num_threads = settings["mapping_threads"]
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-8
    options.ceres.solver_options.gradient_tolerance = 1e-10
    for limit in (2 * settings["filter_error_px"], settings["filter_error_px"]):
        observations = pycolmap.ObservationManager(model)
        observations.filter_all_points3D(limit * scale, 1.5)
        observations.filter_points3D_with_short_tracks(settings["min_track"])
        pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
