"""Estimates camera poses by structure from motion, the calibrated camera fixed, and their covariance."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from service.compute.camera_model import CameraCovariance, CameraModel
from service.compute.sfm.adjustment import clustered_information, first_guess, robust_rows
from service.compute.sfm.bundle import AdjustmentData, BundleState, Rows, Sigmas, linearise, normal_equations
from service.compute.sfm.colmap_process import ColmapProcess
from service.compute.sfm.features import ImageFeatures, PairMatches, Tracks
from service.compute.sfm.front_end import CachedFrontEnd, FrontEnd, processes_worth
from service.compute.sfm.options import Mapper, Progress, SfmOptions, pairs_of
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform

logger = logging.getLogger(__name__)

_FEW = 50  # features below which an image counts as hardly textured


@dataclass(frozen=True, slots=True)
class SfmModel:
    """The largest reconstructed model, in its own frame `world` and its own unit (not metric).

    Attributes:
        mapper: the mapper used; a model by `triangulated` is in metres, in the frame of the given poses.
        T_world_camera: pose of each registered image.
        tracks: triangulated points and their observations; images in the order of T_world_camera.
        camera: the camera as given, or refined.
        mean_reprojection_error_px: mean over all observations.
        mean_track_length: mean number of observations per point.
        n_registered: number of images in the model.
        missing: images not in it.
        n_models: number of models that the mapper produced; more than one means that the scene fell apart.
        folder: COLMAP's binary model, with the images' own names.
        seconds: wall time of each stage that was run; stages whose results were cached are absent.
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

    def joint_pose_covariance(self, known: CameraCovariance | None = None) -> Array:
        """Return (6 N, 6 N) covariance of poses after a similarity has aligned their positions; the model's unit.

        Increments (d, w) of exp(w) R, t + d in the model's axes. `known` is the covariance of a camera that was
        fixed. Takes about a second.
        """
        return similarity_covariance(np.array(list(self.T_world_camera.values())), self.tracks, self.camera, known)

    def pose_covariance(self, known: CameraCovariance | None = None) -> Array:
        """Return (N, 6, 6) covariance of each pose alone, as in `joint_pose_covariance`."""
        return blocks(self.joint_pose_covariance(known))


@dataclass(frozen=True, slots=True)
class SfmWorkspace:
    """The folder, camera and settings with which images of one camera are reconstructed.

    Attributes:
        folder: the folder for features, matches, models and COLMAP's logs; created if missing.
        camera: the camera, calibrated at the images' size; fixed unless the options refine it.
        options: settings.
        progress: called now and then with (stage, done, total); stage is extract, match, map or adjust, and total is
            0 if COLMAP does not report it.
    """

    folder: Path
    camera: CameraModel
    options: SfmOptions = field(default_factory=SfmOptions)
    progress: Progress | None = None


def reconstruct(
    images: Mapping[str, Path] | Sequence[Path],
    workspace: SfmWorkspace,
    mapper: Mapper = "incremental",
    *,
    T_world_camera_prior: Mapping[str, Transform] | None = None,
    stations: Mapping[str, str] | None = None,
) -> SfmModel:
    """Estimate the poses of images of one calibrated camera, up to a similarity: all stages in one call.

    Equivalent to `FrontEnd` for every image and pair, then `reconstruct_from`. Features and matches are stored in the
    workspace and shared by later calls, whatever the mapper; only missing ones are computed. COLMAP runs in child
    processes, so a crash of COLMAP only fails this call.

    Args:
        images: file of each image by name, or files with unique names.
        workspace: folder, camera and settings.
        mapper: COLMAP's incremental mapper, the global one (GLOMAP), or `triangulated` from the prior.
        T_world_camera_prior: rough poses in one frame (from the robot) that select the pairs to match; images without
            one are matched with all others. Otherwise used only by `triangulated`, which starts from them.
        stations: frame of each image's prior, if there are several.

    Raises:
        DataError: an image is missing, unreadable or of another size than the camera.
        ComputeError: too few images, no model, or COLMAP failed.
    """
    camera, settings, folder, progress = workspace.camera, workspace.options, workspace.folder, workspace.progress
    files = _by_name(images)
    _check_count(len(files))
    folder.mkdir(parents=True, exist_ok=True)
    pairs = pairs_of(files, T_world_camera_prior, settings, stations=stations)
    seconds: dict[str, float] = {}
    with FrontEnd(camera, settings, processes=processes_worth(len(files), len(pairs), camera, settings)) as front:
        kept = CachedFrontEnd(folder, camera, settings, seconds)
        features = kept.features(files, front, progress)
        matches = kept.matches(features, files, pairs, front, progress)
    start = T_world_camera_prior if mapper == "triangulated" else None
    model = reconstruct_from(features, matches, workspace, mapper, T_world_camera_start=start)
    return dataclasses.replace(model, seconds={**seconds, **model.seconds})


def reconstruct_from(
    features: Mapping[str, ImageFeatures],
    matches: Iterable[PairMatches],
    workspace: SfmWorkspace,
    mapper: Mapper = "incremental",
    *,
    T_world_camera_start: Mapping[str, Transform] | None = None,
) -> SfmModel:
    """Estimate poses from existing features and matches (see `FrontEnd`), in one child process.

    Images and pairs are processed in the order of their names, so neither their order of arrival nor the processes
    that made them change a single bit of the model. Two mappers may run in parallel in one workspace.

    Args:
        features: features of every image, by name.
        matches: matches of the pairs to use (`pairs_of` the images); pairs with images without features are dropped.
        workspace: folder, camera and settings.
        mapper: source of the initial poses: COLMAP's incremental mapper or the global one (GLOMAP), both from the
            images alone; or `triangulated`, from T_world_camera_start. All tracks are triangulated from these poses,
            and poses and points are adjusted together.
        T_world_camera_start: the start of `triangulated`: metric poses of the images in one frame, from the corrected
            robot, good to a few millimetres and a degree. They are the initial values and give the model its frame
            and
            scale: the adjusted camera positions are aligned to them by a similarity. They do not constrain single
            poses, so their noise does not return. Images without a pose, or without common features with others, are
            missing.

    Raises:
        DataError: an image's features are from another image size than the camera's.
        ComputeError: too few images, no model, or COLMAP failed.
    """
    camera, settings, folder = workspace.camera, workspace.options, workspace.folder
    names = sorted(features)
    _check_count(len(names))
    if mapper == "triangulated" and not T_world_camera_start:
        raise ComputeError("triangulation needs initial poses", remedy="Give T_world_camera_start")
    _check_features({name: features[name] for name in names}, camera)
    folder.mkdir(parents=True, exist_ok=True)
    index = {name: k for k, name in enumerate(names)}
    used = sorted((m for m in matches if m.first in index and m.second in index), key=lambda m: m.pair)
    job = {
        "workspace": str(folder),
        "names": names,
        "mapper": mapper,
        "camera": dataclasses.asdict(camera),
        "options": dataclasses.asdict(settings),
        "pixels": [features[name].pixels for name in names],
        "start": [None if T_world_camera_start is None else T_world_camera_start.get(name) for name in names],
        "matches": [(index[m.first], index[m.second], m.features, m.configuration, m.matrices) for m in used],
    }
    start = time.monotonic()
    with ColmapProcess(seed=settings.seed, log=folder / f"colmap_{mapper}.log") as child:
        outcome = child.run("map", job, timeout_s=settings.timeout_s, progress=workspace.progress)
    return _model(outcome, names, mapper, folder, {"map": time.monotonic() - start})


def _check_features(features: Mapping[str, ImageFeatures], camera: CameraModel) -> None:
    """Refuse features from images of another size than the camera's, and warn of images with hardly any."""
    for name, found in features.items():
        if (found.width, found.height) != (camera.width, camera.height):
            raise DataError(
                f"image {name} is {found.width}×{found.height}, the camera {camera.width}×{camera.height}",
                remedy="Check that the calibration was made at the images' size",
            )
    poor = [name for name, found in features.items() if len(found.pixels) < _FEW]
    if poor:
        logger.warning("images with hardly any texture: %s", ", ".join(poor))


def _check_count(count: int) -> None:
    if count < 3:
        raise ComputeError(f"structure from motion needs at least 3 images, got {count}")


def _by_name(images: Mapping[str, Path] | Sequence[Path]) -> dict[str, Path]:
    if isinstance(images, Mapping):
        files = {name: Path(path) for name, path in images.items()}
    else:
        files = {path.name: Path(path) for path in images}
        if len(files) != len(images):
            raise DataError("two images have the same file name", remedy="Rename one of them")
    for name, path in files.items():
        if not path.is_file():
            raise DataError(f"image {name} does not exist", where=str(path))
    return files


def _model(
    outcome: dict[str, Any], names: list[str], mapper: Mapper, folder: Path, seconds: dict[str, float]
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
            where=os.fspath(folder),
            remedy="Check the images' overlap, sharpness and texture",
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
        folder / mapper,
        seconds,
    )


def similarity_covariance(
    T_world_camera: Array, tracks: Tracks, camera: CameraModel, known: CameraCovariance | None = None
) -> Array:
    """Compute the joint covariance (6 N, 6 N) of poses at a bundle adjustment's solution with the camera fixed.

    It follows from the normal equations with the points eliminated and robust weights, allowing for errors shared
    within a track. Frame and scale are free: the covariance is that of the poses after a similarity has aligned their
    positions with the true ones (inner constraints; Triggs et al., "Bundle adjustment", 2000, 9.2.2).

    Args:
        T_world_camera: (N, 4, 4), any unit.
        tracks: tracks of the same images, in the same frame.
        camera: intrinsics.
        known: covariance of the camera that was fixed; its error moves all poses together, however many images there
            are. None: the camera is taken as exact.

    Returns:
        (6 N, 6 N) of increments (d in the model's unit, w in radians) of exp(w) R, t + d in the model's axes.

    Raises:
        ComputeError: an image or a point has too few observations.
    """
    n = len(T_world_camera)
    state = BundleState(T_world_camera, tracks.points, np.empty((0, 4, 4)), camera)
    data = AdjustmentData(tracks)
    rows = robust_rows(state, data, first_guess(state, data, Sigmas()))
    bread, meat = clustered_information(rows["tracks"], 6 * n)
    # The images do not determine seven directions: translation, rotation and scale.
    positions = T_world_camera[:, :3, 3] - T_world_camera[:, :3, 3].mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(positions**2, axis=1))))
    gauge = np.zeros((n, 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, :3, 3:6] = np.array([np.cross(np.eye(3), p).T for p in positions])
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, :3, 6] = positions
    G = gauge.reshape(6 * n, 7)
    unit = np.tile([spread] * 3 + [1.0] * 3, n)
    B = bread * np.outer(unit, unit)
    Q = np.linalg.qr(G / unit[:, None])[0]
    level = float(np.median(np.diag(B)))
    inverse = np.linalg.inv(B + level * Q @ Q.T) * np.outer(unit, unit)
    if not np.all(np.isfinite(inverse)):
        raise ComputeError("the poses of structure from motion are not determined by its tracks")
    fixed = gauge.copy()
    fixed[:, 3:] = 0.0  # only positions define the alignment
    E = fixed.reshape(6 * n, 7)
    S = np.eye(6 * n) - G @ np.linalg.solve(E.T @ G, E.T)
    half = S @ inverse
    covariance = half @ meat @ half.T
    for pull in _pulls(state, data, rows["tracks"], bread, known) if known is not None else ():
        moved = half @ pull
        covariance = covariance + np.outer(moved, moved)
    return covariance


def _pulls(
    state: BundleState, data: AdjustmentData, tracks: Rows, bread: Array, known: CameraCovariance
) -> Iterator[Array]:
    """Yield (6 N,) change of the poses' gradient for each deviation of the camera, with the points adjusted."""
    plain = linearise(state, data, Sigmas())["tracks"]
    # The square roots of the robust weights, over the sigma that they were found with.
    root = np.sqrt(_row_squares(tracks) / np.maximum(_row_squares(plain), 1e-300))
    for camera in known.deviations(state.camera):
        off = linearise(dataclasses.replace(state, camera=camera), data, Sigmas())["tracks"].residual - plain.residual
        normal = normal_equations([dataclasses.replace(tracks, residual=root * off)])
        n = len(bread)
        yield normal.gradient[:n] * float(np.trace(bread) / np.trace(normal.schur[:n, :n]))


def _row_squares(rows: Rows) -> Array:
    return np.asarray(rows.frame.multiply(rows.frame).sum(axis=1), dtype=np.float64).ravel()


def blocks(covariance: Array) -> Array:
    """Return (N, 6, 6) covariance of each pose, from a joint covariance (6 N, 6 N)."""
    n = len(covariance) // 6
    return np.array([covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(n)])


def write_pose_covariance(path: Path, names: Sequence[str], pose_covariance: Array, unit: str) -> None:
    """Write (N, 6, 6) beside a model; `unit` is that of the positions: "m" or "model"."""
    document = {
        "order": ["x", "y", "z", "rx_rad", "ry_rad", "rz_rad"],
        "increment": "T_world_camera: exp(w) R, t + d, in the axes of the world",
        "position_unit": unit,
        "covariance": {name: C.tolist() for name, C in zip(names, pose_covariance, strict=True)},
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
