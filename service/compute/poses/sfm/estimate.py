"""Structure from motion with the calibrated camera held: features once, then incremental or global mapping."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from service.compute.camera_covariance import CameraCovariance
from service.compute.camera_model import CameraModel
from service.compute.poses.colmap.process import ColmapProcess
from service.compute.poses.files.pose_covariance import blocks, similarity_covariance
from service.compute.poses.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.compute.poses.sfm.front_end import FrontEnd, missing_pairs, pairs_of
from service.compute.poses.sfm.options import Mapper, Progress, SfmOptions
from service.compute.poses.sfm.tracks import Tracks
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform

logger = logging.getLogger(__name__)

_FEW = 50  # features below which an image has hardly any texture


@dataclass(frozen=True, slots=True)
class SfmModel:
    """The largest reconstructed model, in its own frame `world` and its own unit (not metric).

    Attributes:
        mapper: which mapper made it; that of `triangulated` is in metres, in the frame of the poses given.
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

    def joint_pose_covariance(self, known: CameraCovariance | None = None) -> Array:
        """(6 N, 6 N) of the poses after the positions were laid over the true ones by a similarity; the model's unit.

        Increments (d, w) of exp(w) R, t + d in the model's axes. `known` is how well the camera was, where it was
        held. Takes a second or so.
        """
        return similarity_covariance(np.array(list(self.T_world_camera.values())), self.tracks, self.camera, known)

    def pose_covariance(self, known: CameraCovariance | None = None) -> Array:
        """(N, 6, 6) the same of each pose alone."""
        return blocks(self.joint_pose_covariance(known))


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
    """Estimate the poses of images of one calibrated camera, up to a similarity: all pieces in one call.

    The same as `FrontEnd` for every image and pair, then `reconstruct_from`. Features and matches are kept in the
    workspace and shared by later calls, whatever the mapper; only what is missing is made. COLMAP runs in child
    processes, so that its crash is an error of this call and nothing more.

    Args:
        images: file of each image by name, or files whose names are unique.
        camera: calibrated at the images' size; held fixed unless the options refine it.
        workspace: folder for features, matches, the models and COLMAP's logs; made if missing.
        mapper: COLMAP's incremental mapper, the global one (GLOMAP), or `triangulated` from the prior.
        T_world_camera_prior: rough poses in one frame (from the robot) that choose the pairs to match; images
            that it misses are matched with all others. Not used for anything else, but where `triangulated` starts.
        stations: where poses of the prior are in several frames, the frame of each image.
        options: settings.
        progress: told (stage, done, total) now and then; stages extract, match and those of `reconstruct_from`.

    Raises:
        DataError: an image is missing, unreadable or of another size than the camera.
        ComputeError: too few images, no model, or COLMAP failed.
    """
    settings = options or SfmOptions()
    files = _by_name(images)
    _check_count(len(files))
    workspace.mkdir(parents=True, exist_ok=True)
    pairs = pairs_of(files, T_world_camera_prior, settings, stations=stations)
    seconds: dict[str, float] = {}
    with FrontEnd(camera, settings, processes=settings.threads, log=workspace / "colmap_front.log") as front:
        features = _features(files, camera, settings, workspace, front, seconds, progress)
        matches = _matches(features, pairs, camera, settings, workspace, front, seconds, progress)
    model = reconstruct_from(
        features,
        matches,
        camera,
        workspace,
        mapper,
        T_world_camera_start=T_world_camera_prior if mapper == "triangulated" else None,
        options=settings,
        progress=progress,
    )
    return dataclasses.replace(model, seconds={**seconds, **model.seconds})


def reconstruct_from(
    features: Mapping[str, ImageFeatures],
    matches: Iterable[PairMatches],
    camera: CameraModel,
    workspace: Path,
    mapper: Mapper = "incremental",
    *,
    T_world_camera_start: Mapping[str, Transform] | None = None,
    options: SfmOptions | None = None,
    progress: Progress | None = None,
) -> SfmModel:
    """Poses of images whose features and matches are there already (see `FrontEnd`), in one child process.

    Images and pairs are taken in the order of their names: in which order they arrived, or which process made them,
    changes no bit of the model. Two mappers may work side by side in one workspace.

    Args:
        features: of every image, by name.
        matches: of the pairs that count (`pairs_of` the images); pairs of images without features are left out.
        camera: calibrated at the images' size; held fixed unless the options refine it.
        workspace: folder for the model and COLMAP's log; made if missing.
        mapper: where the poses to begin with come from: COLMAP's incremental mapper or the global one (GLOMAP), both
            from the images alone; or `triangulated`, T_world_camera_start. All tracks are triangulated from these
            poses, and poses and points adjusted together.
        T_world_camera_start: for `triangulated`: metric poses of the images in one frame, from the corrected robot,
            good to a few millimetres and a degree. They are where the adjustment begins, and give the model its frame
            and scale: a similarity lays the adjusted camera positions over these. They do not hold single poses, so
            their noise does not come back. Images without a pose, or that share nothing with the others, are missing.
        options: settings.
        progress: told ("map", done, total) and ("adjust", done, total) now and then; total 0 where COLMAP does not
            tell how far it is.

    Raises:
        DataError: an image's features are those of another size than the camera's.
        ComputeError: too few images, no model, or COLMAP failed.
    """
    settings = options or SfmOptions()
    names = sorted(features)
    _check_count(len(names))
    if mapper == "triangulated" and not T_world_camera_start:
        raise ComputeError("triangulation needs poses to begin with", remedy="give T_world_camera_start")
    for name in names:
        if (features[name].width, features[name].height) != (camera.width, camera.height):
            raise DataError(
                f"image {name} is {features[name].width}×{features[name].height}, "
                f"the camera {camera.width}×{camera.height}",
                remedy="check that the calibration was made at the images' size",
            )
    poor = [name for name in names if len(features[name].pixels) < _FEW]
    if poor:
        logger.warning("images with hardly any texture: %s", ", ".join(poor))
    workspace.mkdir(parents=True, exist_ok=True)
    index = {name: k for k, name in enumerate(names)}
    used = sorted((m for m in matches if m.first in index and m.second in index), key=lambda m: m.pair)
    job = {
        "workspace": str(workspace),
        "names": names,
        "mapper": mapper,
        "camera": dataclasses.asdict(camera),
        "options": dataclasses.asdict(settings),
        "pixels": [features[name].pixels for name in names],
        "start": [None if T_world_camera_start is None else T_world_camera_start.get(name) for name in names],
        "matches": [(index[m.first], index[m.second], m.features, m.configuration, m.matrices) for m in used],
    }
    start = time.monotonic()
    with ColmapProcess(seed=settings.seed, log=workspace / f"colmap_{mapper}.log") as child:
        outcome = child.run("map", job, timeout_s=settings.timeout_s, progress=progress)
    return _model(outcome, names, mapper, workspace, {"map": time.monotonic() - start})


def _check_count(count: int) -> None:
    if count < 3:
        raise ComputeError(f"structure from motion needs at least 3 images, got {count}")


def _features(
    files: Mapping[str, Path],
    camera: CameraModel,
    settings: SfmOptions,
    workspace: Path,
    front: FrontEnd,
    seconds: dict[str, float],
    progress: Progress | None,
) -> dict[str, ImageFeatures]:
    """Features of every image, those of the workspace where file, camera and settings are the same."""
    folder = workspace / "features"
    folder.mkdir(exist_ok=True)
    kept = {name: folder / f"{_key(file, camera, settings)}.npz" for name, file in files.items()}
    wanted = {name: files[name] for name, path in kept.items() if not path.is_file()}
    start = time.monotonic()
    fresh = front.extract_all(wanted, progress) if wanted else {}
    if wanted:
        seconds["extract"] = time.monotonic() - start
    for name, found in fresh.items():
        _write(kept[name], found.to_bytes())
    return {
        name: fresh[name] if name in fresh else ImageFeatures.from_bytes(kept[name].read_bytes())
        for name in sorted(files)
    }


def _matches(
    features: Mapping[str, ImageFeatures],
    pairs: Sequence[tuple[str, str]],
    camera: CameraModel,
    settings: SfmOptions,
    workspace: Path,
    front: FrontEnd,
    seconds: dict[str, float],
    progress: Progress | None,
) -> list[PairMatches]:
    """Matches of exactly the pairs; those that the workspace has of the same features are not made again."""
    kept = workspace / "matches.npz"
    stamp = workspace / "matches.json"
    recipe = json.dumps([dataclasses.asdict(camera), settings.verification_error_px, settings.seed, _hash(features)])
    known: list[PairMatches] = []
    if kept.is_file() and stamp.is_file() and stamp.read_text(encoding="utf-8") == recipe:
        known = unpack_matches(kept.read_bytes())
    missing = missing_pairs(pairs, known)
    if missing:
        start = time.monotonic()
        known += front.match_pairs(features, missing, progress)
        seconds["match"] = time.monotonic() - start
        stamp.unlink(missing_ok=True)
        _write(kept, pack_matches(known))
        stamp.write_text(recipe, encoding="utf-8")
    wanted = set(pairs)
    return [m for m in known if m.pair in wanted]


def _hash(features: Mapping[str, ImageFeatures]) -> str:
    digest = hashlib.sha256()
    for name, found in features.items():
        digest.update(name.encode() + found.pixels.tobytes() + found.descriptors.tobytes())
    return digest.hexdigest()


def _key(file: Path, camera: CameraModel, settings: SfmOptions) -> str:
    stat = file.stat()
    front = ("max_image_size", "max_features", "first_octave")
    words = [str(file.resolve()), stat.st_size, stat.st_mtime_ns, camera.width, camera.height]
    text = json.dumps([*words, *(getattr(settings, key) for key in front)])
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _write(path: Path, data: bytes) -> None:
    part = path.with_suffix(".part")
    part.write_bytes(data)
    part.replace(path)


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
