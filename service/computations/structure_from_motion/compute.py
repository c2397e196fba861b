"""Job `structure_from_motion`: camera poses from images, with the tracks behind them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from service.computations import structure_from_motion as sfm_job
from service.computations.conversion import camera_used
from service.computations.features.compute import read_features
from service.computations.inputs import photographs
from service.computations.job import JobAnswer, JobContext
from service.computations.match.compute import read_matches
from service.computations.records import Hash
from service.compute.sfm.estimate import SfmModel, SfmWorkspace, blocks, reconstruct, reconstruct_from
from service.compute.sfm.features import Tracks
from service.compute.sfm.options import Mapper, SfmOptions
from service.core.geometry import Array


def structure_from_motion(context: JobContext[sfm_job.Arguments]) -> JobAnswer:
    """Run each mapper on the same features; the prior poses only select which pairs are matched."""
    arguments = context.arguments
    options = SfmOptions(**arguments.effort.set_fields())
    reconstructed = (
        _from_images(context, options)
        if arguments.features is None
        else _from_pieces(context, arguments.features, options)
    )
    measures: dict[str, float] = {}
    artefacts = []
    for mapper in arguments.mappers:
        model = reconstructed(mapper)
        measures[f"{mapper}_images"] = float(model.n_registered)
        measures[f"{mapper}_missing"] = float(len(model.missing))
        measures[f"{mapper}_reprojection_px"] = model.mean_reprojection_error_px
        joint = model.joint_pose_covariance()
        data = {
            "mapper": mapper,
            "T_world_camera": {name: T.tolist() for name, T in model.T_world_camera.items()},
            "pose_covariance": {
                name: C.tolist() for name, C in zip(model.T_world_camera, blocks(joint), strict=True)
            },
            "mean_reprojection_error_px": model.mean_reprojection_error_px,
            "mean_track_length": model.mean_track_length,
            "missing": list(model.missing),
            "models": model.n_models,
            "points": len(model.points_world),
        }
        artefacts.append(context.keep_json(data, kind="sfm_model", name=f"{mapper}.json"))
        packed = _packed(model, joint)
        media_type = "application/octet-stream"
        name = f"{mapper}_tracks.npz"
        artefacts.append(context.keep_bytes(packed, kind="sfm_tracks", media_type=media_type, name=name))
    return JobAnswer(measures, tuple(artefacts))


def _from_pieces(
    context: JobContext[sfm_job.Arguments], files: Mapping[str, Hash], options: SfmOptions
) -> Callable[[Mapper], SfmModel]:
    arguments, prior = context.arguments, _prior(context.arguments)
    features = read_features(context, files)
    matches = read_matches(context, arguments.matches, features, prior, options)

    workspace = SfmWorkspace(context.scratch, camera_used(arguments), options, context.progress)

    def reconstructed(mapper: Mapper) -> SfmModel:
        start = prior if mapper == "triangulated" else None
        return reconstruct_from(features, matches, workspace, mapper, T_world_camera_start=start)

    return reconstructed


def _from_images(context: JobContext[sfm_job.Arguments], options: SfmOptions) -> Callable[[Mapper], SfmModel]:
    """Compute everything in this job, as in old runs, which had no jobs for features and matches."""
    images = context.arguments.images
    files = dict(zip((image.viewpoint for image in images), photographs(context, images), strict=True))
    workspace = SfmWorkspace(context.scratch, camera_used(context.arguments), options, context.progress)
    return partial(reconstruct, files, workspace, T_world_camera_prior=_prior(context.arguments) or None)


def _prior(arguments: sfm_job.Arguments) -> dict[str, Array]:
    return {name: np.array(T) for name, T in (arguments.prior or {}).items()}


def _packed(model: SfmModel, joint_pose_covariance: Array) -> bytes:
    """Return the tracks and the joint covariance of the poses as a compressed NumPy archive, images by name."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        names=np.array(json.dumps(list(model.T_world_camera))),
        image=model.tracks.image.astype(np.int32),
        point=model.tracks.point.astype(np.int32),
        pixels=model.tracks.pixels.astype(np.float32),
        points=model.tracks.points,
        pose_covariance=joint_pose_covariance,
    )
    return buffer.getvalue()


def joint_pose_covariance(data: bytes, names: Sequence[str]) -> Array:
    """Return the (6 N, 6 N) covariance of the poses in a packed model, for the named images in their order."""
    with np.load(io.BytesIO(data)) as archive:
        order = json.loads(str(archive["names"]))
        rows = (6 * np.array([order.index(name) for name in names])[:, None] + np.arange(6)).ravel()
        return np.asarray(archive["pose_covariance"][np.ix_(rows, rows)], dtype=np.float64)


def unpacked_tracks(data: bytes, names: list[str]) -> Tracks:
    """Return the tracks of a packed model, with images numbered as in `names`."""
    with np.load(io.BytesIO(data)) as archive:
        order = json.loads(str(archive["names"]))
        number = np.array([names.index(name) for name in order], dtype=np.int64)
        return Tracks(
            number[archive["image"].astype(np.int64)],
            archive["point"].astype(np.int64),
            archive["pixels"].astype(np.float64),
            archive["points"],
        )
