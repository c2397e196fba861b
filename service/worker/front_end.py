"""Jobs `features` and `match`: the input of structure from motion, computed as images arrive or afterwards."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import Any

import cv2

from service.compute.sfm.colmap_process import ColmapProcess
from service.compute.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.compute.sfm.front_end import FrontEnd
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.geometry import Transform
from service.jobs import features as features_job
from service.jobs import match as match_job
from service.jobs.features import FrontEndArguments
from service.jobs.records import Hash
from service.worker.inputs import photographs
from service.worker.job import JobAnswer, JobContext
from service.worker.records import camera_used


def features(context: JobContext[features_job.Arguments]) -> JobAnswer:
    """Compute SIFT features of some images, one artefact for each, in the order of the images."""
    cv2.setNumThreads(1)  # jobs run in parallel
    images = context.arguments.images
    files = photographs(context, images)
    refs = []
    count = 0
    with _front_end(context.arguments) as front:
        for number, (image, file) in enumerate(zip(images, files, strict=True)):
            context.progress("features", number, len(images))
            found = front.extract_features(file)
            count += len(found.pixels)
            name = f"{image.viewpoint}.features.npz"
            media_type = "application/octet-stream"
            refs.append(context.keep_bytes(found.to_bytes(), kind="sfm_features", media_type=media_type, name=name))
    return JobAnswer({"features_an_image": count / len(images)}, tuple(refs))


def match(context: JobContext[match_job.Arguments]) -> JobAnswer:
    """Match some pairs of images, and verify the matches geometrically."""
    arguments = context.arguments
    with _front_end(arguments) as front:
        found = front.match_pairs(read_features(context, arguments.features), arguments.pairs, context.progress)
    media_type = "application/octet-stream"
    ref = context.keep_bytes(pack_matches(found), kind="sfm_matches", media_type=media_type, name="matches.npz")
    return JobAnswer(
        {"pairs": float(len(found)), "pairs_matched": float(sum(len(m.features) > 0 for m in found))}, (ref,)
    )


def read_features(context: JobContext[Any], wanted: Mapping[str, Hash]) -> dict[str, ImageFeatures]:
    """Read features from their files, by image."""
    return {name: ImageFeatures.from_bytes(context.input(sha256).read_bytes()) for name, sha256 in wanted.items()}


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


class _ColmapChildren(threading.local):
    """COLMAP's child process of each thread, by seed; it stays, because starting one takes as long as an image."""

    def __init__(self) -> None:
        self.children: dict[int, ColmapProcess] = {}


_KEPT = _ColmapChildren()


def _front_end(arguments: FrontEndArguments) -> FrontEnd:
    options = SfmOptions(**arguments.effort.set_fields())
    child = _KEPT.children.setdefault(options.seed, ColmapProcess(seed=options.seed))
    return FrontEnd(camera_used(arguments), options, child=child)
