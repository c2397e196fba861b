"""Structure from motion with the calibrated camera held: features once, then incremental or global mapping."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import logging
import math
import multiprocessing
import os
import shutil
import sqlite3
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.poses.pairs import choose_pairs
from service.compute.poses.pose_covariance import blocks, similarity_covariance
from service.compute.poses.tracks import Tracks
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform

logger = logging.getLogger(__name__)

_TABLES = {"extract": "SELECT COUNT(*) FROM keypoints", "match": "SELECT COUNT(*) FROM two_view_geometries"}

Mapper = Literal["incremental", "global"]
Refine = Literal["nothing", "principal_point", "intrinsics"]
Progress = Callable[[str, int, int], None]  # stage, done, total (total 0: unknown)


@dataclass(frozen=True, slots=True)
class SfmOptions:
    """Settings of the front end and of the refinement.

    Attributes:
        max_image_size: longer side to which images are reduced for feature extraction; 0 keeps the full size.
        max_features: per image, the largest scales first.
        first_octave: -1 doubles the image first (finer and four times slower), 0 does not.
        neighbours: how many images, nearest in viewing direction, each image is matched with (needs a prior).
        max_angle_deg: views further apart than this, as seen from the scene, are not matched.
        verification_error_px: epipolar distance up to which a match is an inlier, at extraction size.
        filter_error_px: observations beyond this are dropped before the final bundle adjustment.
        min_track: views a point needs to take part in the final bundle adjustment.
        loss_px: scale of the final bundle adjustment's robust (Cauchy) loss.
        threads: of extraction and matching.
        mapping_threads: of mapping and bundle adjustment. With one, the same features give the same model bit for
            bit; with more, sums are added up in the order in which threads finish.
        refine: what the final bundle adjustment may change in the calibrated camera.
        seed: of every random choice.
        timeout_s: after which one stage is given up.
    """

    max_image_size: int = 3200
    max_features: int = 3000
    first_octave: int = 0
    neighbours: int = 8
    max_angle_deg: float = 60.0
    verification_error_px: float = 2.0
    filter_error_px: float = 1.5
    min_track: int = 3
    loss_px: float = 0.5
    threads: int = 2
    mapping_threads: int = 1
    refine: Refine = "nothing"
    seed: int = 1
    timeout_s: float = 3600.0


Effort = Literal["quick", "normal", "quality"]


def options_for(effort: Effort, camera: CameraModel, *, refine: Refine = "nothing", threads: int = 2) -> SfmOptions:
    """Settings for images of this camera.

    Camera positions were off by 0.017–0.028 mm (normal) and 0.013 mm (quality) on 20 rendered images 1920 px wide of
    a scene 0.65 m away (bench/sfm.py); the errors are noise, so more features are what makes them smaller.
    """
    longer = max(camera.width, camera.height)
    if effort == "quick":
        return SfmOptions(max_image_size=1280, max_features=2500, neighbours=8, refine=refine, threads=threads)
    if effort == "normal":
        return SfmOptions(
            max_image_size=min(longer, 2400), max_features=4000, neighbours=8, refine=refine, threads=threads
        )
    # Small images are doubled first; large ones have the pixels themselves.
    small = longer <= 2400
    return SfmOptions(
        max_image_size=min(longer, 4000),
        max_features=8000,
        first_octave=-1 if small else 0,
        neighbours=10,
        refine=refine,
        threads=threads,
    )


@dataclass(frozen=True, slots=True)
class SfmModel:
    """The largest reconstructed model, in its own frame `world` and its own unit (not metric).

    Attributes:
        mapper: which mapper made it.
        T_world_camera: pose of each registered image.
        tracks: triangulated points and their observations; images in the order of T_world_camera.
        camera: as given, or refined.
        mean_reprojection_error_px: mean distance of all observations.
        mean_track_length: observations for each point.
        n_registered: images in the model.
        missing: images that are not in it.
        n_models: models that the mapper ended with; more than one means that the scene fell apart.
        folder: COLMAP's binary model, with the images' own names.
        seconds: wall time of each stage that was run (none for features that were there already).
    """

    mapper: Mapper
    T_world_camera: dict[str, Transform]
    tracks: Tracks = field(repr=False)
    camera: CameraModel
    mean_reprojection_error_px: float
    mean_track_length: float
    n_registered: int
    missing: tuple[str, ...]
    n_models: int
    folder: Path
    seconds: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def points_world(self) -> Array:
        """(P, 3) triangulated points."""
        return self.tracks.points

    def joint_pose_covariance(self) -> Array:
        """(6 N, 6 N) of the poses after the positions were laid over the true ones by a similarity; the model's unit.

        Increments (d, w) of exp(w) R, t + d in the model's axes. Takes a second or so.
        """
        return similarity_covariance(np.array(list(self.T_world_camera.values())), self.tracks, self.camera)

    def pose_covariance(self) -> Array:
        """(N, 6, 6) the same of each pose alone."""
        return blocks(self.joint_pose_covariance())


def reconstruct(
    images: Mapping[str, Path] | Sequence[Path],
    camera: CameraModel,
    workspace: Path,
    mapper: Mapper = "incremental",
    *,
    T_world_camera_prior: Mapping[str, Transform] | None = None,
    stations: Mapping[str, str] | None = None,
    options: SfmOptions | None = None,
    progress: Progress | None = None,
) -> SfmModel:
    """Estimate the poses of images of one calibrated camera, up to a similarity.

    Features and matches are kept in the workspace and shared by later calls with the same input, whatever the
    mapper. COLMAP runs in a child process, so that its crash is an error of this call and nothing more.

    Args:
        images: file of each image by name, or files whose names are unique.
        camera: calibrated at the images' size; held fixed unless the options refine it.
        workspace: folder for the database, the models and COLMAP's log; made if missing.
        mapper: COLMAP's incremental mapper or the global one (GLOMAP).
        T_world_camera_prior: rough poses in one frame (from the robot) that choose the pairs to match; images
            that it misses are matched with all others. Not used for anything else.
        stations: where poses of the prior are in several frames, the frame of each image.
        options: settings.
        progress: told (stage, done, total) now and then.

    Raises:
        DataError: an image is missing, unreadable or of another size than the camera.
        ComputeError: too few images, no model, or COLMAP failed.
    """
    settings = options or SfmOptions()
    files = _by_name(images)
    if len(files) < 3:
        raise ComputeError(f"structure from motion needs at least 3 images, got {len(files)}")
    report: Progress = progress or (lambda _stage, _done, _total: None)
    workspace.mkdir(parents=True, exist_ok=True)
    names = sorted(files)
    seconds: dict[str, float] = {}
    pairs = choose_pairs(names, T_world_camera_prior, settings.neighbours, settings.max_angle_deg, stations=stations)
    job = _job(files, camera, workspace, settings, pairs)
    stamp = workspace / "features.json"
    recipe = json.dumps({k: v for k, v in job.items() if k not in {"options", "workspace"}}, sort_keys=True)
    if not (stamp.is_file() and stamp.read_text(encoding="utf-8") == recipe):
        stamp.unlink(missing_ok=True)
        (workspace / "database.db").unlink(missing_ok=True)
        _link_images(workspace / "images", files, names)
        for stage in ("extract", "match"):
            start = time.monotonic()
            outcome = _run(stage, job, report, settings.timeout_s)
            seconds[stage] = time.monotonic() - start
            if stage == "extract":
                _check_features(outcome["keypoints"], names, files, camera)
        stamp.write_text(recipe, encoding="utf-8")
    start = time.monotonic()
    outcome = _run("map", {**job, "mapper": mapper}, report, settings.timeout_s)
    seconds["map"] = time.monotonic() - start
    return _model(outcome, names, mapper, workspace, seconds)


def _by_name(images: Mapping[str, Path] | Sequence[Path]) -> dict[str, Path]:
    if isinstance(images, Mapping):
        files = {name: Path(path) for name, path in images.items()}
    else:
        files = {path.name: Path(path) for path in images}
        if len(files) != len(images):
            raise DataError("two images have the same file name", remedy="give each image a name of its own")
    for name, path in files.items():
        if not path.is_file():
            raise DataError(f"image {name} does not exist", where=str(path))
    return files


def _job(
    files: Mapping[str, Path],
    camera: CameraModel,
    workspace: Path,
    options: SfmOptions,
    pairs: list[tuple[int, int]],
) -> dict[str, Any]:
    """Everything the child process needs, as plain data. Its front-end part is the key of the feature cache."""
    names = sorted(files)
    stats = [files[name].stat() for name in names]
    front = ("max_image_size", "max_features", "first_octave", "verification_error_px", "seed")
    return {
        "workspace": str(workspace),
        "names": names,
        "files": [[str(files[n].resolve()), s.st_size, s.st_mtime_ns] for n, s in zip(names, stats, strict=True)],
        "internal": [_internal_name(k, files[name]) for k, name in enumerate(names)],
        "camera": dataclasses.asdict(camera),
        "pairs": [list(pair) for pair in pairs],
        "front": {key: getattr(options, key) for key in front},
        "options": dataclasses.asdict(options),
    }


def _internal_name(index: int, path: Path) -> str:
    """A name that COLMAP's list files cannot misread; artefacts of the store have no suffix."""
    return f"{index:05d}{path.suffix or '.jpg'}"


def _link_images(folder: Path, files: Mapping[str, Path], names: Sequence[str]) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for index, name in enumerate(names):
        link = folder / _internal_name(index, files[name])
        try:
            link.symlink_to(files[name].resolve())
        except OSError:  # file systems without links
            shutil.copyfile(files[name], link)


def _check_features(
    keypoints: Mapping[int, int], names: Sequence[str], files: Mapping[str, Path], camera: CameraModel
) -> None:
    unread = [name for index, name in enumerate(names) if index not in keypoints]
    if unread:
        raise DataError(
            f"{len(unread)} images cannot be read or are not {camera.width}×{camera.height}: {', '.join(unread[:5])}",
            where=str(files[unread[0]]),
            remedy="check the files, and that the calibration was made at the images' size",
        )
    poor = [names[index] for index, count in keypoints.items() if count < 50]
    if poor:
        logger.warning("images with hardly any texture: %s", ", ".join(poor))


def _child(stage: str, job: dict[str, Any], pipe: Connection) -> None:
    """Import pycolmap in the child only: its import takes over the process's signal handlers."""
    importlib.import_module("service.compute.poses.sfm_process").main(stage, job, pipe)


def _run(stage: str, job: dict[str, Any], report: Progress, timeout_s: float) -> dict[str, Any]:
    """Run one stage in a child process; its messages are progress, then one result or one error."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(stage, job, theirs), daemon=True, name=f"sfm-{stage}")
    process.start()
    theirs.close()
    total = {"extract": len(job["names"]), "match": len(job["pairs"]), "map": len(job["names"])}[stage]
    report(stage, 0, total)
    try:
        outcome = _await(ours, stage, job, report=report, total=total, deadline=time.monotonic() + timeout_s)
    finally:
        ours.close()
        process.join(timeout=5)
        if process.is_alive():
            process.kill()
            process.join()
        process.close()
    report(stage, total, total)
    return outcome


def _await(
    pipe: Connection, stage: str, job: dict[str, Any], *, report: Progress, total: int, deadline: float
) -> dict[str, Any]:
    log = Path(job["workspace"]) / f"colmap_{stage}.log"
    while True:
        if pipe.poll(0.5):
            try:
                kind, value = pipe.recv()
            except EOFError:
                raise ComputeError(
                    f"COLMAP crashed during {stage}: {_tail(log)}", where=str(log), remedy="see its log"
                ) from None
            if kind == "progress":
                report(stage, min(int(value), total), total)
            elif kind == "error":
                raise ComputeError(f"COLMAP failed during {stage}: {value}", where=str(log), remedy="see its log")
            else:
                logger.debug("colmap %s done: %s", stage, _tail(log))
                return value
        elif time.monotonic() > deadline:
            raise ComputeError(f"COLMAP did not end {stage} in time", where=str(log))
        elif stage in {"extract", "match"}:
            report(stage, _rows_done(Path(job["workspace"]) / "database.db", stage), total)


def _rows_done(database: Path, stage: str) -> int:
    """How many images or pairs the running stage has written; 0 while the database is not there or busy."""
    if not database.is_file():
        return 0
    try:
        with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.2)) as connection:
            return int(connection.execute(_TABLES[stage]).fetchone()[0])
    except sqlite3.Error:
        return 0


def _tail(log: Path) -> str:
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except FileNotFoundError:
        return "no log"
    return " | ".join(lines[-3:]) if lines else "empty log"


def _model(
    outcome: dict[str, Any], names: list[str], mapper: Mapper, workspace: Path, seconds: dict[str, float]
) -> SfmModel:
    by_index: dict[int, Transform] = outcome["poses"]
    poses = {names[index]: by_index[index] for index in sorted(by_index)}
    missing = tuple(name for name in names if name not in poses)
    if missing or outcome["n_models"] > 1:
        logger.warning(
            "%s mapping registered %d of %d images in %d model(s)",
            mapper,
            len(poses),
            len(names),
            outcome["n_models"],
        )
    if len(poses) < 3 or not math.isfinite(outcome["error_px"]):
        raise ComputeError(
            f"{mapper} mapping registered {len(poses)} of {len(names)} images",
            where=os.fspath(workspace),
            remedy="check the images' overlap, sharpness and texture",
        )
    position = {names.index(name): k for k, name in enumerate(poses)}
    image = np.array([position[int(i)] for i in outcome["track_image"]], dtype=np.int64)
    return SfmModel(
        mapper,
        poses,
        Tracks(image, outcome["track_point"], outcome["track_pixels"], outcome["points"]),
        CameraModel(**outcome["camera"]),
        outcome["error_px"],
        outcome["track_length"],
        len(poses),
        missing,
        outcome["n_models"],
        workspace / mapper,
        seconds,
    )
