"""Job kind `match`: geometrically verified matches of some pairs of images."""

from __future__ import annotations

from service.computations.features import FrontEndArguments
from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import Hash


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
    compute="service.computations.match.compute:match",
    words="matches between images",
    order=41,
    aside=True,
    demand=lambda _: Demand(memory_mb=600, limit_s=14400),
)
