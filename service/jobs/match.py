"""Job kind `match`: geometrically verified matches of some pairs of images."""

from __future__ import annotations

from service.jobs.features import FrontEndArguments
from service.jobs.kind import Demand, JobKind, JobRecord, NoAnswer
from service.jobs.records import Hash


class PairsToMatch(JobRecord):
    """Features by viewpoint, and the pairs to match."""

    features: dict[str, Hash]
    pairs: tuple[tuple[str, str], ...]


class Arguments(PairsToMatch, FrontEndArguments):
    """Features by viewpoint, and the pairs to match."""


KIND = JobKind(
    name="match",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.worker.front_end:match",
    words="matches between images",
    order=41,
    aside=True,
    demand=lambda _: Demand(memory_mb=600, limit_s=14400),
)
