"""Jobs of camera poses from images: features, verified matches, structure from motion, and hybrid poses."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np

from service.computations.conversion import camera_used
from service.computations.image_poses import (
    FeaturesArguments,
    FrontEndArguments,
    HybridArguments,
    HybridModel,
    MatchArguments,
    ModelFile,
    StructureFromMotionArguments,
)
from service.computations.inputs import photographs, read_outlines, robot_camera_poses
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Hash, PosedPhotograph, has_poses, matrices, matrix
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.sfm.estimate import SfmModel, SfmWorkspace, blocks, reconstruct, reconstruct_from
from service.compute.sfm.features import ImageFeatures, PairMatches, Tracks, pack_matches, unpack_matches
from service.compute.sfm.front_end import FrontEnd
from service.compute.sfm.hybrid import HybridPoses, hybrid_poses
from service.compute.sfm.options import Mapper, SfmOptions, pairs_of
from service.core.geometry import Array, Transform
from service.core.units import mm


def features(context: JobContext[FeaturesArguments]) -> JobAnswer:
    """Compute SIFT features of some images, one artefact for each, in the order of the images."""
    cv2.setNumThreads(1)  # jobs run in parallel
    images = context.arguments.images
    files = photographs(context, images)
    refs = []
    count = 0
    context.progress("features", 0, len(images))
    extracted = front_end(context.arguments).extract_each(files)
    for number, (image, found) in enumerate(zip(images, extracted, strict=True), 1):
        count += len(found.pixels)
        name = f"{image.viewpoint}.features.npz"
        media_type = "application/octet-stream"
        refs.append(context.keep_bytes(found.to_bytes(), kind="sfm_features", media_type=media_type, name=name))
        context.progress("features", number, len(images))
    return JobAnswer({"features_an_image": count / len(images)}, tuple(refs))


def read_features(context: JobContext[Any], wanted: Mapping[str, Hash]) -> dict[str, ImageFeatures]:
    """Read features from their files, by image."""
    return {name: ImageFeatures.from_bytes(context.input(sha256).read_bytes()) for name, sha256 in wanted.items()}


def front_end(arguments: FrontEndArguments) -> FrontEnd:
    """Return the front end for a job: jobs run in parallel, so each uses this process alone, or the cluster."""
    return FrontEnd(camera_used(arguments), SfmOptions(**arguments.effort.set_fields()))


def match(context: JobContext[MatchArguments]) -> JobAnswer:
    """Match some pairs of images, and verify the matches geometrically."""
    arguments = context.arguments
    files = {name: context.input(sha256) for name, sha256 in arguments.features.items()}
    found = front_end(arguments).match_pairs(files, arguments.pairs, context.progress)
    media_type = "application/octet-stream"
    ref = context.keep_bytes(pack_matches(found), kind="sfm_matches", media_type=media_type, name="matches.npz")
    return JobAnswer(
        {"pairs": float(len(found)), "pairs_matched": float(sum(len(m.features) > 0 for m in found))}, (ref,)
    )


def read_matches(
    context: JobContext[Any],
    files: Iterable[Hash],
    names: Iterable[str],
    prior: Mapping[str, Transform],
    options: SfmOptions,
) -> list[PairMatches]:
    """Return the matches of those pairs of images that their prior poses select, whenever they were computed.

    Args:
        context: the job's context.
        files: the hashes of the files of matches.
        names: the images' names.
        prior: T_world_camera by image, which select the pairs; empty if unknown.
        options: the options of structure from motion.
    """
    wanted = set(pairs_of(names, prior or None, options))
    found = (m for sha256 in files for m in unpack_matches(context.input(sha256).read_bytes()))
    by_pair = {m.pair: m for m in found}
    return [by_pair[pair] for pair in sorted(wanted & by_pair.keys())]


def structure_from_motion(context: JobContext[StructureFromMotionArguments]) -> JobAnswer:
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
    context: JobContext[StructureFromMotionArguments], files: Mapping[str, Hash], options: SfmOptions
) -> Callable[[Mapper], SfmModel]:
    arguments, prior = context.arguments, _prior(context.arguments)
    features = read_features(context, files)
    matches = read_matches(context, arguments.matches, features, prior, options)

    workspace = SfmWorkspace(context.scratch, camera_used(arguments), options, context.progress)

    def reconstructed(mapper: Mapper) -> SfmModel:
        start = prior if mapper == "triangulated" else None
        return reconstruct_from(features, matches, workspace, mapper, T_world_camera_start=start)

    return reconstructed


def _from_images(
    context: JobContext[StructureFromMotionArguments], options: SfmOptions
) -> Callable[[Mapper], SfmModel]:
    """Compute everything in this job, as in old runs, which had no jobs for features and matches."""
    images = context.arguments.images
    files = dict(zip((image.viewpoint for image in images), photographs(context, images), strict=True))
    workspace = SfmWorkspace(context.scratch, camera_used(context.arguments), options, context.progress)
    return partial(reconstruct, files, workspace, T_world_camera_prior=_prior(context.arguments) or None)


def _prior(arguments: StructureFromMotionArguments) -> dict[str, Array]:
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


def hybrid(context: JobContext[HybridArguments]) -> JobAnswer:
    """Adjust the tracks of a model, the robot's poses and the registration spheres together."""
    arguments = context.arguments
    camera = camera_used(arguments)
    model = ModelFile.model_validate(context.input_json(arguments.model)).T_world_camera
    images = [image for image in arguments.images if image.viewpoint in model]
    names = [image.viewpoint for image in images]
    stations = sorted({image.station for image in images})
    context.progress("hybrid poses", 0, 1)
    by_arm = has_poses(arguments, images) and not _held(images)
    # Intrinsics stay fixed: overlays and control spheres use the calibrated ones, which must fit the poses.
    answer = hybrid_poses(
        PosedImages(
            np.array([model[name] for name in names]),
            camera,
            groups=[stations.index(image.station) for image in images],
            metric=False,
            names=names,
        ),
        unpacked_tracks(context.input(arguments.tracks).read_bytes(), names),
        read_outlines(context.input_json, arguments.outlines, images, camera),
        ScanSpheres(
            np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=np.array(arguments.sphere_covariance_m2)
        ),
        T_base_camera=robot_camera_poses(arguments, images) if by_arm else None,
    )
    measures = {
        "track_sigma_px": answer.sigma_track_px,
        "robot_sigma_mm": mm(answer.sigma_robot_m or 0.0),
        "robot_sigma_deg": float(np.degrees(answer.sigma_robot_rad or 0.0)),
    }
    ref = context.keep_json(_record(answer, names, stations).plain(), kind="hybrid_poses", name="hybrid_poses.json")
    return JobAnswer(measures, (ref,))


def _held(images: Sequence[PosedPhotograph]) -> bool:
    return any(image.T_scene_camera is not None for image in images)


def _record(answer: HybridPoses, names: list[str], stations: list[str]) -> HybridModel:
    return HybridModel(
        T_world_camera=matrices(dict(zip(names, answer.T_world_camera, strict=True))),
        pose_covariance=matrices(dict(zip(names, answer.scan_pose_covariance, strict=True))),
        pose_covariance_frame="scan",
        T_world_scan=matrix(answer.T_world_scan),
        T_world_station={stations[g]: matrix(T) for g, T in answer.T_world_group.items()},
        scan_covariance=matrix(answer.scan_covariance),
        predicted_error_mm=mm(answer.sigma_at_m(answer.centre_scan_m)),
        sigma_track_px=answer.sigma_track_px,
        sphere_factor=answer.sphere_factor,
        sigma_robot_m=answer.sigma_robot_m,
        sigma_robot_rad=answer.sigma_robot_rad,
        chi2=answer.chi2,
    )
