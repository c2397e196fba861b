"""Job `match`: matches between images, verified geometrically."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from service.computations import match as match_job
from service.computations.features.compute import front_end
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Hash
from service.compute.sfm.features import PairMatches, pack_matches, unpack_matches
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.geometry import Transform


def match(context: JobContext[match_job.Arguments]) -> JobAnswer:
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
