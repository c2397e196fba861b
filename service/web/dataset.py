"""The page of a run's data set: its views and splits, previews made in the background, and the benchmark on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi import Path as UrlPath
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse

from service.audit.background import ChildProcesses, ChildState
from service.computations.benchmark import KIND, SCENARIOS, BenchmarkResult, read_results
from service.core.errors import DataError, IntegrityError
from service.core.gates import refuse_data_set
from service.core.records.events import Event
from service.core.records.run_events import EvidenceExported, JobFinished
from service.core.run.state import RunState
from service.dataset.preview_records import AT_LEAST, FILE_NAME, Preview, ViewPreview, read_preview
from service.store.durable_effects import Clock
from service.web.images import further_cameras_of
from service.web.rendering import render
from service.web.run_frame import run_frame
from service.web.scene import FRAME_HEADERS, Theme
from service.web.security import requires
from service.web.site import CurrentSite, RunId, singleton

FOLDER = "benchmark"


@dataclass(frozen=True, slots=True)
class Benchmark:
    """The results that belong to a run: those on one of the data sets that it has exported.

    Attributes:
        results: the results by method, dense before sparse.
        best: smallest Chamfer distance of each scenario, mm.
        problem: why they cannot be read; "" if they can.
    """

    results: tuple[BenchmarkResult, ...]
    best: tuple[tuple[str, float], ...]
    problem: str = ""


def benchmark_of(data: Path, events: Sequence[Event]) -> Benchmark:
    """Return the results that jobs of the run have answered, and those in DIR/benchmark of its recorded exports.

    The latter are known by the list of checksums of their data set.
    """
    exported = {e.payload.sha256 for e in events if isinstance(e.payload, EvidenceExported)}
    answers = [e.payload for e in events if isinstance(e.payload, JobFinished) and e.payload.job_kind == KIND.name]
    try:
        found = read_results(data / FOLDER) if exported else ()
        answered = [KIND.read_answer(answer.result) for answer in answers]
    except (DataError, IntegrityError, OSError) as error:
        return Benchmark((), (), str(error))
    results = sorted(
        (*answered, *(result for result in found if result.dataset_sha256 in exported)),
        key=lambda result: (result.method, SCENARIOS.index(result.scenario)),
    )
    scores = {
        scenario: [r.score.chamfer_mm for r in results if r.scenario == scenario and r.score is not None]
        for scenario in SCENARIOS
    }
    return Benchmark(tuple(results), tuple((name, min(values)) for name, values in scores.items() if values))


_VERSION = "3"  # of what a preview holds


class Previews:
    """The previews of one data folder."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._children = ChildProcesses("service.web.preview_process", "preview", clock)

    def ready(self, state: RunState) -> Preview | None:
        """Return what is ready of a completed run's preview, None if nothing is; start to make it if nobody did."""
        found = read_preview(self._folder(state))
        if (found is None or not found.whole) and self._children.state(state.run_id) is None:
            self.make(state)
        return found

    def making(self, run_id: str) -> ChildState | None:
        """Return the progress or the outcome of making the preview; None before the first time."""
        return self._children.state(run_id)

    def make(self, state: RunState) -> None:
        """Make the preview of a completed run, unless that is under way."""
        arguments = [str(self._data), state.run_id, str(self._folder(state))]
        self._children.start(state.run_id, arguments, by="")

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Wait until the making has ended."""
        self._children.wait(run_id, timeout_s)

    def file(self, state: RunState, name: str) -> Path | None:
        """Return a file of the preview; None for a name that it does not have."""
        path = self._folder(state) / name
        return path if FILE_NAME.fullmatch(name) and path.is_file() else None

    def _folder(self, state: RunState) -> Path:
        # What a preview shows of a completed run cannot change: its registration was signed, its scan is evidence.
        return self._data / "cache" / "dataset" / f"{state.run_id}-{state.completed_sha256[:16]}-{_VERSION}"


CurrentPreviews = Annotated[
    Previews, Depends(singleton("previews", lambda site: Previews(site.data, site.store.clock)))
]


SPLITS = ("dense", "sparse", "train", "test")
SPLIT_WORDS = {
    "dense": "all views",
    "sparse": "a few that together see most of the surface",
    "train": "to learn from",
    "test": "to judge by, every eighth",
}


@dataclass(frozen=True, slots=True)
class SplitTab:
    """A split that can be chosen."""

    name: str
    words: str
    count: int


@dataclass(frozen=True, slots=True)
class DataSetView:
    """The data that the page shows.

    Attributes:
        views: the views of the chosen split.
        split: the chosen one.
        splits: all splits.
        chosen: the view that is enlarged; None: there is none yet.
        before, after: names of its neighbours in the split; "" at the ends.
        done: views whose pictures are ready.
        total: number of all views.
        crops: number of crops of the views of the split.
        covered: pairs (number of views, share of the surface that at least so many views see).
    """

    views: tuple[ViewPreview, ...]
    split: str
    splits: tuple[SplitTab, ...]
    chosen: ViewPreview | None
    before: str
    after: str
    done: int
    total: int
    crops: int
    covered: tuple[tuple[int, float], ...]


def data_set_view(preview: Preview, split: str, view: str) -> DataSetView:
    """Return the page for a chosen split and view; the first of the split if the name is none of its views."""
    members = tuple(shown for shown in preview.views if split in shown.splits)
    names = [shown.name for shown in members]
    at = names.index(view) if view in names else 0
    return DataSetView(
        views=members,
        split=split,
        splits=tuple(SplitTab(name, SPLIT_WORDS[name], _count(preview, name)) for name in SPLITS),
        chosen=members[at] if members else None,
        before=names[at - 1] if at > 0 else "",
        after=names[at + 1] if at + 1 < len(names) else "",
        done=sum(shown.ready for shown in preview.views),
        total=len(preview.views),
        crops=sum(len(shown.crops) for shown in members),
        covered=() if preview.coverage is None else tuple(zip(AT_LEAST, preview.coverage.shares, strict=True)),
    )


def _count(preview: Preview, split: str) -> int:
    return sum(split in shown.splits for shown in preview.views)


router = APIRouter(tags=["dataset"])

Split = Annotated[Literal["dense", "sparse", "train", "test"], Query()]
_READ = [Depends(requires("read"))]
_TYPES = {"jpg": "image/jpeg", "webp": "image/webp"}
_TITLES = {
    "coverage": "Coverage in 3D",
    "sources": "Sources of the ground truth in 3D",
    "sigmas": "Standard deviation of the ground truth in 3D",
    "distances": "Distance of the scan to the CT in 3D",
}


@router.get("/runs/{run_id}/dataset", name="data_set", dependencies=_READ, response_class=HTMLResponse)
def data_set_page(
    request: Request,
    site: CurrentSite,
    previews: CurrentPreviews,
    run_id: RunId,
    split: Split = "dense",
    view: Annotated[str, Query(max_length=200)] = "",
) -> Response:
    """Show views, crops, depth, coverage and distances, as far as they are ready; the rest is made meanwhile."""
    log = site.run(run_id)
    unfit = refuse_data_set(log.state)
    preview = None if unfit else previews.ready(log.state)
    return render(
        request,
        "dataset/dataset.html.j2",
        frame=run_frame(site, run_id),
        run_id=run_id,
        unfit=unfit,
        preview=preview,
        making=None if unfit else previews.making(run_id),
        benchmark=benchmark_of(site.data, log.events),
        benchmark_folder=site.data / FOLDER,
        further=further_cameras_of(log),
        shown=None if preview is None else data_set_view(preview, split, view),
    )


@router.post("/runs/{run_id}/dataset", name="make_preview", dependencies=_READ)
def make_preview(site: CurrentSite, previews: CurrentPreviews, run_id: RunId) -> RedirectResponse:
    """Make the pictures again, after that has failed."""
    log = site.run(run_id)
    unfit = refuse_data_set(log.state)
    if unfit is not None:
        raise unfit
    previews.make(log.state)
    return RedirectResponse(f"/runs/{run_id}/dataset", status_code=303)


@router.get("/runs/{run_id}/dataset/pictures/{name}", name="data_set_picture", dependencies=_READ)
def picture(
    site: CurrentSite, previews: CurrentPreviews, run_id: RunId, name: Annotated[str, UrlPath(max_length=80)]
) -> FileResponse:
    """Serve a picture of the preview."""
    path = previews.file(site.run(run_id).state, name)
    if path is None or path.suffix[1:] not in _TYPES:
        raise HTTPException(404, "the data set has no such picture")
    headers = {"Cache-Control": "private, max-age=3600", "X-Content-Type-Options": "nosniff"}
    return FileResponse(path, media_type=_TYPES[path.suffix[1:]], headers=headers)


@router.get("/runs/{run_id}/dataset/{figure}/frame", name="data_set_frame", dependencies=_READ)
def surface_frame(
    request: Request,
    site: CurrentSite,
    previews: CurrentPreviews,
    run_id: RunId,
    figure: Literal["coverage", "sources", "sigmas", "distances"],
    theme: Theme = "auto",
) -> HTMLResponse:
    """Show a coloured surface alone, for its sandboxed frame."""
    path = previews.file(site.run(run_id).state, f"{figure}.json")
    if path is None:
        raise HTTPException(404, "this surface is not ready")
    text = path.read_text(encoding="utf-8")
    response = render(
        request,
        "scene/frame.html.j2",
        figure=text,
        theme=theme,
        stations=[],
        title=_TITLES[figure],
        to_view=None,
    )
    response.headers.update(FRAME_HEADERS)
    return response
