"""What the child process of structure from motion does: drives pycolmap, its output going to a log file."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable
from multiprocessing.connection import Connection
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
)


def main(stage: str, job: dict[str, Any], pipe: Connection) -> None:
    """Entry point: run `stage`, send ("progress", n) meanwhile and ("result", dict) or ("error", str) at the end."""
    log = os.open(Path(job["workspace"]) / f"colmap_{stage}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    pycolmap.logging.logtostderr = True
    pycolmap.set_random_seed(job["options"]["seed"])
    stages: dict[str, Callable[[dict[str, Any], Connection], dict[str, Any]]] = {
        "extract": _extract,
        "match": _match,
        "map": _map,
    }
    try:
        result = stages[stage](job, pipe)
    except (RuntimeError, ValueError, OSError) as error:  # what pycolmap raises
        pipe.send(("error", str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__))
    else:
        pipe.send(("result", result))
    pipe.close()


def _extract(job: dict[str, Any], _pipe: Connection) -> dict[str, Any]:
    options = job["options"]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = options["threads"]
    extraction.max_image_size = options["max_image_size"] or -1
    extraction.use_gpu = False
    extraction.sift.max_num_features = options["max_features"]
    extraction.sift.first_octave = options["first_octave"]
    camera = to_colmap_camera(CameraModel(**job["camera"]))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera.model_name
    reader.camera_params = ",".join(repr(float(p)) for p in camera.params)
    workspace = Path(job["workspace"])
    pycolmap.Database.open(workspace / "database.db").close()  # makes it
    # The extractor's threads would number the images as they finish, and the mapper goes by these numbers.
    pycolmap.import_images(
        database_path=workspace / "database.db",
        image_path=workspace / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        image_names=job["internal"],
        options=reader,
    )
    pycolmap.extract_features(
        database_path=workspace / "database.db",
        image_path=workspace / "images",
        image_names=job["internal"],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    index = {name: k for k, name in enumerate(job["internal"])}
    with pycolmap.Database.open(workspace / "database.db") as database:
        cameras = {c.camera_id: (c.width, c.height) for c in database.read_all_cameras()}
        size = (job["camera"]["width"], job["camera"]["height"])
        counts = {
            index[image.name]: int(database.num_keypoints_for_image(image.image_id))
            for image in database.read_all_images()
            if cameras[image.camera_id] == size
        }
    return {"keypoints": counts}


def _match(job: dict[str, Any], _pipe: Connection) -> dict[str, Any]:
    options = job["options"]
    workspace = Path(job["workspace"])
    listing = workspace / "pairs.txt"
    names = job["internal"]
    listing.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in job["pairs"]), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = options["threads"]
    matching.use_gpu = False
    matching.max_num_matches = options["max_features"] * 2
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.max_error = options["verification_error_px"] * _reduction(job)
    verification.ransac.random_seed = options["seed"]
    pycolmap.match_image_pairs(
        database_path=workspace / "database.db",
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    return {}


def _reduction(job: dict[str, Any]) -> float:
    """Pixels of the image for each pixel at which features were extracted."""
    limit = job["options"]["max_image_size"]
    return max(1.0, max(job["camera"]["width"], job["camera"]["height"]) / limit) if limit else 1.0


def _map(job: dict[str, Any], pipe: Connection) -> dict[str, Any]:
    workspace = Path(job["workspace"])
    raw = workspace / f"{job['mapper']}_raw"
    shutil.rmtree(raw, ignore_errors=True)
    raw.mkdir()
    models = (_incremental if job["mapper"] == "incremental" else _global)(job, raw, pipe)
    if not models:
        return {"poses": {}, "error_px": np.inf, "n_models": 0}
    best = max(models.values(), key=lambda m: m.num_reg_images())
    _refine(best, job)
    index = {name: k for k, name in enumerate(job["internal"])}
    poses: dict[int, Any] = {}
    for image_id in best.reg_image_ids():
        image = best.image(image_id)
        poses[index[image.name]] = from_colmap_pose(image.cam_from_world())
        image.name = job["names"][index[image.name]]
    final = workspace / job["mapper"]
    shutil.rmtree(final, ignore_errors=True)
    final.mkdir()
    best.write_binary(final)
    return {
        "poses": poses,
        "camera": dataclasses.asdict(from_colmap_camera(best.cameras[best.image(best.reg_image_ids()[0]).camera_id])),
        **_tracks(best, {job["names"][k]: k for k in poses}),
        "error_px": float(best.compute_mean_reprojection_error()),
        "track_length": float(best.compute_mean_track_length()),
        "n_models": len(models),
    }


def _tracks(model: pycolmap.Reconstruction, index: dict[str, int]) -> dict[str, Any]:
    """Points (P, 3), and image index, point index and our pixels of every observation."""
    number = {point_id: k for k, point_id in enumerate(model.points3D)}
    image_index: list[int] = []
    points: list[int] = []
    pixels: list[Any] = []
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        for observation in image.get_observation_points2D():
            image_index.append(index[image.name])
            points.append(number[observation.point3D_id])
            pixels.append(observation.xy)
    return {
        "points": np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3),
        "track_image": np.array(image_index, dtype=np.int64),
        "track_point": np.array(points, dtype=np.int64),
        "track_pixels": from_colmap_pixels(np.array(pixels).reshape(-1, 2)),
    }


def _incremental(job: dict[str, Any], raw: Path, pipe: Connection) -> dict[int, pycolmap.Reconstruction]:
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
        pipe.send(("progress", done + 2))

    workspace = Path(job["workspace"])
    return pycolmap.incremental_mapping(
        workspace / "database.db", workspace / "images", raw, options=options, next_image_callback=registered
    )


def _global(job: dict[str, Any], raw: Path, _pipe: Connection) -> dict[int, pycolmap.Reconstruction]:
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
    workspace = Path(job["workspace"])
    return pycolmap.global_mapping(workspace / "database.db", workspace / "images", raw, options=options)


def _refine(model: pycolmap.Reconstruction, job: dict[str, Any]) -> None:
    """Drop doubtful observations, then adjust poses and points, and the camera if wanted, to convergence."""
    settings = job["options"]
    scale = _reduction(job)
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
