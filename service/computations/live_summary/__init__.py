"""Job kind `live_summary`: whether the images so far suffice, and which further views would help most."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.live_view import LiveArguments
from service.computations.records import Hash, Matrix


class CandidateView(JobRecord):
    """A view that could be taken in addition."""

    name: str
    T_base_camera: Matrix
    travel_s: float


class Arguments(LiveArguments):
    """The files of all `live_view` jobs, and further views at the robot's present station."""

    views: tuple[Hash, ...]
    station: str
    limit_m: float
    min_coverage: float
    candidates: tuple[CandidateView, ...]


class Suggestion(JobRecord):
    """A view that would help; error and coverage (0 … 1) are predicted with it and the suggestions before it."""

    viewpoint: str
    predicted_error_mm: float
    coverage: float


class StationPrediction(JobRecord):
    """The predicted error from the images of a station so far."""

    predicted_target_error_mm: float
    images: int


class Answer(JobRecord):
    """The views to take next, and why some stations cannot be registered yet."""

    next_best_views: tuple[Suggestion, ...]
    reasons: dict[str, str]
    stations: dict[str, StationPrediction]


KIND = JobKind(
    name="live_summary",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.live_summary.compute:live_summary",
    words="summary of the images",
    order=32,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=600, limit_s=600),
)
