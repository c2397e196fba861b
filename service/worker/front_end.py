"""Jobs `features` and `match`: the pieces that structure from motion is made of, as images arrive or afterwards."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import Any

import cv2
import numpy as np

from service.compute.poses.colmap.process import ColmapProcess
from service.compute.poses.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.compute.poses.sfm.front_end import FrontEnd, pairs_of
from service.compute.poses.sfm.options import SfmOptions
from service.worker.job import JobAnswer, JobContext
from service.worker.photographs import photographs


def features(context: JobContext) -> JobAnswer:
    """SIFT features of some images, an artefact each, in the order of the images."""
    cv2.setNumThreads(1)  # jobs run side by side
    images = context.arguments["images"]
    files = photographs(context, images)
    refs = []
    count = 0
    with _front_end(context) as front:
        for number, (image, file) in enumerate(zip(images, files, strict=True)):
            context.progress("features", number, len(images))
            found = front.extract_features(file)
            count += len(found.pixels)
            name = f"{image['viewpoint']}.features.npz"
            media_type = "application/octet-stream"
            refs.append(context.keep_bytes(found.to_bytes(), kind="sfm_features", media_type=media_type, name=name))
    return JobAnswer({"features_an_image": count / len(images)}, tuple(refs))


def match(context: JobContext) -> JobAnswer:
    """Verified matches of some pairs of images."""
    pairs = [(str(a), str(b)) for a, b in context.arguments["pairs"]]
    with _front_end(context) as front:
        found = front.match_pairs(read_features(context), pairs, context.progress)
    media_type = "application/octet-stream"
    ref = context.keep_bytes(pack_matches(found), kind="sfm_matches", media_type=media_type, name="matches.npz")
    return JobAnswer(
        {"pairs": float(len(found)), "pairs_matched": float(sum(len(m.features) > 0 for m in found))}, (ref,)
    )


def read_features(context: JobContext) -> dict[str, ImageFeatures]:
    """The features that the job's arguments name, by image."""
    wanted: Mapping[str, str] = context.arguments["features"]
    return {name: ImageFeatures.from_bytes(context.input(sha256).read_bytes()) for name, sha256 in wanted.items()}


def read_matches(context: JobContext, names: Iterable[str]) -> list[PairMatches]:
    """The matches that count for these images: of the pairs that their poses choose, whenever they were made."""
    prior = {name: np.array(T) for name, T in (context.arguments.get("prior") or {}).items()}
    wanted = set(pairs_of(names, prior or None, _options(context)))
    found = (m for sha256 in context.arguments["matches"] for m in unpack_matches(context.input(sha256).read_bytes()))
    by_pair = {m.pair: m for m in found}
    return [by_pair[pair] for pair in sorted(wanted & by_pair.keys())]


class _Kept(threading.local):
    """COLMAP's child of each thread that does jobs, by seed: starting one takes as long as an image's features."""

    def __init__(self) -> None:
        self.children: dict[int, ColmapProcess] = {}


_KEPT = _Kept()


def _front_end(context: JobContext) -> FrontEnd:
    options = _options(context)
    child = _KEPT.children.setdefault(options.seed, ColmapProcess(seed=options.seed))
    return FrontEnd(context.camera(), options, child=child)


def _options(context: JobContext) -> SfmOptions:
    effort: dict[str, Any] = context.arguments["effort"]
    return SfmOptions(**effort)
