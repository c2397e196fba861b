"""Board images as they arrive: a job searches each for the board and checks that it is complete and sharp."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypedDict

import numpy as np

from service.computations import board_view
from service.computations.records import ImageFile, image_of
from service.compute.board.board import Board, BoardView
from service.core.records.events import ViewpointCaptured
from service.core.run.state import JobState
from service.steps.context import JobRequest, StepContext
from service.steps.retakes import ImageSharpness, row_to_stop_for, stop_for_lens, why_spoilt


@dataclass(frozen=True, slots=True)
class SearchedBoardImage:
    """A board image that was searched, and what was found."""

    capture: ViewpointCaptured
    seen: bool
    reason: str
    corners_sha256: str | None = None
    view: BoardView | None = None
    size: tuple[int, int] = (0, 0)
    spoilt: bool = False  # blurred or black: not used, even if the board was found


@dataclass
class BoardLooks:
    """The searched images of a step, and those of an earlier step that show the same board."""

    context: StepContext
    board: Board
    earlier: str | None = None
    _read: dict[str, SearchedBoardImage] = field(default_factory=dict[str, SearchedBoardImage])
    _told: set[str] = field(default_factory=set[str])

    def begin(self) -> None:
        """Enqueue the search of every new image. Returns at once."""
        begun = {image_of(job).sha256 for job in self._jobs(self.context.step.id)}
        for capture in self.context.evidence.captures(self.context.step.id):
            sha256 = capture.artefacts[0].sha256
            if sha256 not in begun:
                arguments = board_view.Arguments(
                    image=ImageFile(viewpoint=capture.viewpoint, sha256=sha256), **board_arguments(self.board)
                )
                self.context.evidence.enqueue(JobRequest.of(board_view.KIND, arguments), sha256)

    def wait(self) -> None:
        """Wait until every image has been searched."""
        self.begin()
        while True:
            self.context.checkpoint()
            jobs = self._jobs(self.context.step.id)
            left = sum(job.status == "enqueued" for job in jobs)
            if not left:
                return
            self.context.progress("looking for the board", len(jobs) - left, len(jobs))
            self.context.wait_for_results(0.05)

    def of(self, step: str) -> list[SearchedBoardImage]:
        """Return every valid image of a step that has been searched, with what was found."""
        jobs = self._by_image(step)
        spoilt = why_spoilt(self._looked_at(step))
        out: list[SearchedBoardImage] = []
        for capture in self.context.evidence.captures(step):
            sha256 = capture.artefacts[0].sha256
            job = jobs.get(sha256)
            if job is None or not isinstance(capture, ViewpointCaptured):
                continue
            look = self._look(capture, job)
            if not all(capture.verdicts.values()):
                departs = [name for name, passed in capture.verdicts.items() if not passed]
                look = SearchedBoardImage(capture, False, f"not as required: {', '.join(departs)}")
            elif sha256 in spoilt:
                look = SearchedBoardImage(capture, False, spoilt[sha256], spoilt=True)
            if not look.seen:
                self._tell(look)
            out.append(look)
        return out

    def spoilt_in_a_row(self) -> list[ImageSharpness]:
        """Return the blurred or black images at this step's end, if there are so many that the capture must stop.

        Empty if all images so far are black: then the search for the first board reports it.
        """
        mine = self._looked_at(self.context.step.id)
        others = self._looked_at(self.earlier) if self.earlier is not None else []
        row = row_to_stop_for(self.context, mine, others)
        from_the_start = len(row) == len(mine) and all(image.black for image in row)
        return [] if from_the_start else row

    def stop_where_spoilt(self) -> None:
        """Raise ImagesSpoiltError after several spoilt images in a row."""
        row = self.spoilt_in_a_row()
        if row:
            stop_for_lens(self.context, row)

    def _jobs(self, step: str) -> list[JobState]:
        return [job for job in self.context.evidence.jobs(step) if job.kind == board_view.KIND.name]

    def _by_image(self, step: str) -> dict[str, JobState]:
        return {image_of(j).sha256: j for j in self._jobs(step) if j.status != "enqueued"}

    def _looked_at(self, step: str) -> list[ImageSharpness]:
        """Return the sharpness of the searched images, in the order of capture."""
        jobs = self._by_image(step)
        ordered = [jobs.get(capture.artefacts[0].sha256) for capture in self.context.evidence.captures(step)]
        done = [(j, _answer_of(j)) for j in ordered if j is not None and j.status == "finished"]
        return [ImageSharpness.of(j, black=answer.black, width=answer.size[0]) for j, answer in done]

    def _look(self, capture: ViewpointCaptured, job: JobState) -> SearchedBoardImage:
        sha256 = capture.artefacts[0].sha256
        if sha256 not in self._read:
            self._read[sha256] = self._as_read(capture, job)
        return self._read[sha256]

    def _as_read(self, capture: ViewpointCaptured, job: JobState) -> SearchedBoardImage:
        if job.status == "failed":
            return SearchedBoardImage(capture, False, job.message)
        answer = _answer_of(job)
        if not answer.seen:
            return SearchedBoardImage(capture, False, answer.reason)
        ref = job.artefacts[0]
        found = board_view.Corners.model_validate_json(self.context.evidence.path(ref).read_bytes())
        view = BoardView(np.array(found.indices, dtype=np.int64), np.array(found.corners, dtype=np.float64))
        return SearchedBoardImage(capture, True, "", ref.sha256, view, found.size)

    def _tell(self, look: SearchedBoardImage) -> None:
        sha256 = look.capture.artefacts[0].sha256
        if sha256 not in self._told:
            self._told.add(sha256)
            self.context.tell(f"{look.capture.viewpoint}: not used, {look.reason}")


def _answer_of(job: JobState) -> board_view.Answer:
    return board_view.KIND.read_answer(job.result)


class BoardFields(TypedDict):
    """The fields of a job's arguments that describe a board."""

    columns: int
    rows: int
    square_m: float


def board_arguments(board: Board) -> BoardFields:
    """Return the fields of a job's arguments for a board."""
    return {"columns": board.columns, "rows": board.rows, "square_m": board.square_m}
