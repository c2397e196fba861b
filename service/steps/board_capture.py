"""Takes images of the board, has each searched as it arrives, and plans more where a gate fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypedDict

import numpy as np

from service.computations.calibration import BOARD_VIEW, BoardViewAnswer, BoardViewArguments, Corners
from service.computations.records import Camera, ImageFile, image_of
from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.board_design import CalibrationTargets, ChosenViews, PlanPrediction
from service.compute.calibration.board_knowledge import BoardKnowledge, refined_knowledge
from service.compute.camera_model import CameraModel
from service.compute.planning.motion_plan import Order, best_posture
from service.core.errors import ComputeError
from service.core.gates import describe, evaluate_gates
from service.core.geometry import Array, Transform, apply, inverse
from service.core.records.run_events import GateVerdict, ViewpointCaptured
from service.core.run.state import JobState
from service.core.words import counted
from service.steps.board_plan import (
    START,
    Planner,
    Why,
    describe_prediction,
    nominal_board,
    nominal_camera,
    prediction_record,
)
from service.steps.context import JobRequest, StepContext
from service.steps.motion import StepPlan, arm_at_station, plan_step, usual_posture
from service.steps.notes import BOARD_POSES, BoardPlan, BoardPose, board_plans
from service.steps.retakes import (
    TAKEN_AGAIN,
    ImageSharpness,
    row_to_stop_for,
    stop_for_lens,
    taken_for_good,
    to_take_again,
    why_spoilt,
)
from service.steps.viewpoints import BoardPoses, Viewpoint
from service.steps.views import CaptureTask, capture_viewpoints

# --- the search for the board in each image ------------------------------------------------------------------------


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
                arguments = BoardViewArguments(
                    image=ImageFile(viewpoint=capture.viewpoint, sha256=sha256), **board_arguments(self.board)
                )
                self.context.evidence.enqueue(JobRequest.of(BOARD_VIEW, arguments), sha256)

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
        return [job for job in self.context.evidence.jobs(step) if job.kind == BOARD_VIEW.name]

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
        found = Corners.model_validate_json(self.context.evidence.path(ref).read_bytes())
        view = BoardView(np.array(found.indices, dtype=np.int64), np.array(found.corners, dtype=np.float64))
        return SearchedBoardImage(capture, True, "", ref.sha256, view, found.size)

    def _tell(self, look: SearchedBoardImage) -> None:
        sha256 = look.capture.artefacts[0].sha256
        if sha256 not in self._told:
            self._told.add(sha256)
            self.context.tell(f"{look.capture.viewpoint}: not used, {look.reason}")


def _answer_of(job: JobState) -> BoardViewAnswer:
    return BOARD_VIEW.read_answer(job.result)


class BoardFields(TypedDict):
    """The fields of a job's arguments that describe a board."""

    columns: int
    rows: int
    square_m: float


def board_arguments(board: Board) -> BoardFields:
    """Return the fields of a job's arguments for a board."""
    return {"columns": board.columns, "rows": board.rows, "square_m": board.square_m}


# --- the capture ---------------------------------------------------------------------------------------------------


_MOST_FIRST = 4  # tries to get a first image that shows the board
_MOVED_M = 0.01  # a board found farther than this from its earlier place has been moved
_MOST_FOR_LENS = 40  # most images used for the estimate during the capture


@dataclass
class BoardCapture:
    """The board images of one execution of one calibration step.

    Poses come from the protocol (`given`) or are planned. Planned poses are recorded in notes of the step, so that
    they are the same after a restart. A pose is recorded as T_base_camera for the nominal mount.
    """

    context: StepContext
    wanted: BoardPoses
    board: Board
    solve: tuple[str, ...]
    given: tuple[Viewpoint, ...] = ()  # poses of the protocol, in its order; only replacements are chosen then
    camera: Camera | None = None  # calibrated by an earlier step
    earlier: str | None = None  # step whose board images show where board and mount are
    _known: BoardKnowledge | None = None
    _plans: list[BoardPlan] = field(default_factory=list[BoardPlan])
    _replaced: int = 0  # in this attempt

    def __post_init__(self) -> None:
        self._mount = self.context.devices.nominal_T_flange_camera()
        self._plans = list(board_plans(self.context.state))
        mine = [plan for plan in self._plans if plan.attempt == self.context.attempt]
        self._replaced = sum(len(plan.poses) for plan in mine if plan.why == "replacement")
        self._looks = BoardLooks(self.context, self.board, self.earlier)

    # --- the loop ---

    def take(self) -> dict[str, float]:
        """Capture, search and plan until nothing is missing; return the measures of the capture."""
        begun = False
        while True:
            fresh = self.poses() if not begun else self._new
            begun = True
            if fresh:
                self._capture(fresh)
            looks = self.looks()
            self._looks.stop_where_spoilt()
            planned = self._more(looks)
            if not planned:
                return self._measures(looks)
            self._new = planned

    def poses(self) -> tuple[Viewpoint, ...]:
        """Return all poses of the step so far."""
        return (*self.given, *self._recorded())

    def _recorded(self) -> tuple[Viewpoint, ...]:
        return tuple(
            Viewpoint(pose.viewpoint, self.wanted.station, np.array(pose.T_base_camera))
            for plan in self._plans
            for pose in plan.poses
        )

    def _more(self, looks: Sequence[SearchedBoardImage]) -> tuple[Viewpoint, ...]:
        """Plan the poses to add now; none if no image is missing, or no more may be replaced."""
        seen = [look for look in looks if look.seen]
        planned = self._planned()
        if self.given or planned >= self.wanted.count:
            missing = len(self.given) + planned - len(seen)
            missing = min(missing, self.wanted.replacements - self._replaced)
            if missing <= 0 or len(seen) < 3:
                return ()
            return self._plan("replacement", missing, looks)
        if not planned:
            return self._plan("first", 1, looks) if self._knowledge(looks).measured == 0 else self._rest(looks)
        if not seen:
            now = [look for look in looks if not look.seen and look.capture.attempt == self.context.attempt]
            unseen = [f"{look.capture.viewpoint}: {look.reason}" for look in now]
            if len(unseen) >= _MOST_FIRST or self.wanted.replacements <= self._replaced:
                raise ComputeError(
                    f"the first images show no board ({'; '.join(unseen)})",
                    where=f"step {self.context.step.id}",
                    remedy="Lay the board where the protocol says, uncovered and lit, and take the lens cap off",
                )
            return self._plan("replacement", 1, looks)
        if planned < START < self.wanted.count:
            return self._plan("start", START - planned, looks)
        return self._rest(looks)

    def _planned(self) -> int:
        """Return the number of poses planned so far, without replacements."""
        return sum(len(plan.poses) for plan in self._plans if plan.why != "replacement")

    def _rest(self, looks: Sequence[SearchedBoardImage]) -> tuple[Viewpoint, ...]:
        planned = self._planned()
        return self._plan("rest", self.wanted.count - planned, looks)

    # --- planning ---

    def mend(
        self,
        count: int,
        enough: Callable[[PlanPrediction, PlanPrediction], bool],
        advise: Callable[[int, str, str], str],
    ) -> bool:
        """Plan up to `count` further poses for the next attempt, so that the calibration passes its gates.

        Args:
            count: the most poses to add.
            enough: says from the predictions without and with further poses if these are enough.
            advise: returns the advice to the operator for a number of poses, their names and the predicted result.

        Returns:
            True if any pose was found.
        """
        looks = self.looks()
        return bool(self._plan("mend", count, looks, enough=enough, advise=advise))

    def _plan(
        self,
        why: Why,
        count: int,
        looks: Sequence[SearchedBoardImage],
        *,
        enough: Callable[[PlanPrediction, PlanPrediction], bool] | None = None,
        advise: Callable[[int, str, str], str] | None = None,
    ) -> tuple[Viewpoint, ...]:
        """Plan board poses, record and report them; none if the arm can reach no other useful pose."""
        self.context.progress("planning board poses", 0, 1)
        self.context.busy("planning board poses")
        known = self._knowledge(looks)
        planner = self.planner(known, coverage=1.0 if why == "mend" else self.wanted.coverage)
        taken = self._taken(looks, known, planner)
        before = planner.prediction(taken, known)
        judged = None if enough is None else lambda after: enough(before, after)
        number = len(self.poses())
        found = planner.next(why, count, known, taken, enough=judged, seed=number)
        poses = tuple(
            Viewpoint(f"{self.wanted.prefix}{number + i + 1:03d}", self.wanted.station, planner.sent(T, known))
            for i, T in enumerate(found.T_base_camera)
        )
        if poses:
            self._record_plan(why, poses, looks, found.prediction, known.measured, advise)
        return poses

    def _record_plan(
        self,
        why: Why,
        poses: tuple[Viewpoint, ...],
        looks: Sequence[SearchedBoardImage],
        predicted: PlanPrediction,
        from_images: int,
        advise: Callable[[int, str, str], str] | None,
    ) -> None:
        """Record planned poses with what they are predicted to give, and report them to the operator."""
        prediction = prediction_record(predicted)
        words = describe_prediction(prediction, self.solve)
        names = poses[0].name if len(poses) == 1 else f"{poses[0].name} … {poses[-1].name}"
        text = f"{counted(len(poses), 'board pose')} ({_WORDS[why]}): {words}"
        if advise is not None:
            text = advise(len(poses), names, words)
        advice = {} if advise is None else {"advice": text}
        instead = {}
        if why == "replacement":
            instead = {"instead_of": {look.capture.viewpoint: look.reason for look in looks if not look.seen}}
            self._replaced += len(poses)
        plan = BoardPlan(
            why=why,
            attempt=self.context.attempt,
            poses=tuple(_planned_pose(viewpoint) for viewpoint in poses),
            prediction=prediction,
            from_images=from_images,
            **instead,
        )
        self.context.note(BOARD_POSES, text=text, **plan.model_dump(mode="json", exclude_unset=True), **advice)
        self.context.tell(text)
        self._plans.append(plan)

    def planner(self, known: BoardKnowledge, *, coverage: float) -> Planner:
        """Return the planner for this station."""
        layout = self.context.devices.layout(self.wanted.station)
        return Planner(
            self.wanted,
            self.board,
            CalibrationTargets("intrinsics" in self.solve, "hand_eye" in self.solve, coverage),
            np.array(layout.approach),
            self._mount,
            self._feasible(known),
        )

    def _feasible(self, known: BoardKnowledge) -> Callable[[Transform], bool]:
        """Return a test if the arm can reach T_base_camera; it is always true for an arm of unknown kinematics."""
        arm = arm_at_station(self.context, self.wanted.station, self._mount)
        if arm is None:
            return lambda _T: True
        start = usual_posture(arm.model, arm.layout, self._mount)
        scene = arm.scene(start, sharp_at_m=apply(known.T_base_board, self.board.points()))
        return lambda T: best_posture(T, scene) is not None

    def _taken(self, looks: Sequence[SearchedBoardImage], known: BoardKnowledge, planner: Planner) -> ChosenViews:
        """Return the images that show the board, and the planned poses without an image."""
        seen = [look for look in looks if look.seen and look.view is not None]
        poses = np.array([np.array(look.capture.T_base_flange) @ known.T_flange_camera for look in seen])
        pixels = tuple(look.view.corners for look in seen if look.view is not None)
        taken = ChosenViews(poses.reshape(-1, 4, 4), pixels)
        there = {look.capture.viewpoint for look in looks}
        given_up = set(self.context.state.skipped_viewpoints)
        waiting = [v for v in self.poses() if v.name not in there and v.name not in given_up]
        back = inverse(self._mount) @ known.T_flange_camera
        return planner.with_planned(taken, np.array([v.T_base_camera @ back for v in waiting]), known)

    # --- what is known ---

    def knowledge(self) -> BoardKnowledge:
        """Estimate camera, mount and board from all images so far, including those of earlier attempts."""
        return self._knowledge(self.looks())

    def _knowledge(self, looks: Sequence[SearchedBoardImage]) -> BoardKnowledge:
        """Estimate from the images so far; without any from an earlier step's, or from rig file and protocol."""
        seen = [look for look in looks if look.seen]
        if self._known is not None and self._known.measured == len(seen) > 0:
            return self._known
        before = [look for look in self._looks.of(self.earlier) if look.seen] if self.earlier is not None else []
        size = next((look.size for look in (*seen, *before)), None)
        if self.camera is None:
            camera, focal = nominal_camera(self.context.devices.lens(), size)
        else:
            camera, focal = CameraModel.from_record(self.camera.plain()), 0.002
        layout = self.context.devices.layout(self.wanted.station)
        nominal = nominal_board(self.wanted, self.board, layout, self._mount, camera, focal)
        calibrated = self.camera is not None
        known = nominal
        if before and _same_base(before, self.wanted.station, seen):
            known = _refine(nominal, before, self.board, lens_known=calibrated)
            if seen:
                own = _refine(nominal, seen, self.board, lens_known=calibrated)
                apart = np.linalg.norm(_middle(own, self.board) - _middle(known, self.board))
                both = _refine(nominal, [*before, *seen], self.board, lens_known=calibrated)
                known = own if apart > _MOVED_M else both
        elif seen:
            known = _refine(nominal, seen, self.board, lens_known=calibrated)
        self._known = known
        return known

    # --- capture and looks ---

    def _capture(self, poses: Sequence[Viewpoint]) -> None:
        again = to_take_again(self.context)
        done = taken_for_good(self.context.evidence.captures(self.context.step.id), again)
        todo = [v for v in poses if v.name not in done]

        def plan(viewpoints: Sequence[Viewpoint], order: Order = "as_listed") -> StepPlan:
            known = self._knowledge(self.looks(wait=False)) if viewpoints else None
            sharp_at_m = None if known is None else apply(known.T_base_board, self.board.points())
            return plan_step(self.context, viewpoints, self._mount, order, sharp_at_m=sharp_at_m)

        task = CaptureTask(
            plan(todo, "as_listed" if self.given else "shortest"),
            [v for v in poses if v.name in done],
            plan,
            self._mount,
            image_kind="board_image",
            on_captured=self._looks.begin,
            stop=lambda: bool(self._looks.spoilt_in_a_row()),
            again=again,
        )
        capture_viewpoints(self.context, task)

    def looks(self, *, wait: bool = True) -> list[SearchedBoardImage]:
        """Return every valid image with what was found in it; with `wait`, once all have been searched."""
        if wait:
            self._looks.wait()
        return self._looks.of(self.context.step.id)

    def _measures(self, looks: Sequence[SearchedBoardImage]) -> dict[str, float]:
        poses, captures = self.poses(), self.context.evidence.captures(self.context.step.id)
        return {
            "viewpoints_planned": float(len(poses)),
            "viewpoints_captured": float(len(captures)),
            "viewpoints_given_up": float(len({v.name for v in poses} - {c.viewpoint for c in captures})),
            "settings_departures": float(sum(not capture.verdicts["settings"] for capture in captures)),
            "moved_during_exposure": float(sum(not capture.verdicts["still"] for capture in captures)),
            "boards_unseen": float(sum(not look.seen for look in looks)),
        }


_WORDS: Mapping[Why, str] = {
    "first": "the first, to locate the board",
    "start": "to estimate lens, mount and board",
    "rest": "the rest",
    "replacement": "instead of images without a board",
    "mend": "to pass the gates",
}


def _planned_pose(viewpoint: Viewpoint) -> BoardPose:
    rows = tuple(tuple(round(float(x), 9) for x in row) for row in viewpoint.T_base_camera)
    return BoardPose(viewpoint=viewpoint.name, T_base_camera=rows)


def _refine(
    nominal: BoardKnowledge, looks: Sequence[SearchedBoardImage], board: Board, *, lens_known: bool
) -> BoardKnowledge:
    pick = np.unique(np.linspace(0, len(looks) - 1, min(len(looks), _MOST_FOR_LENS)).round().astype(int))
    some = [looks[k] for k in pick]
    views = [look.view for look in some if look.view is not None]
    flanges: Array = np.array([look.capture.T_base_flange for look in some])
    known, _ = refined_knowledge(nominal, views, flanges, board, lens_known=lens_known)
    return BoardKnowledge(
        known.camera, known.T_flange_camera, known.T_base_board, known.spread, known.focal, known.centre, len(looks)
    )


def _middle(known: BoardKnowledge, board: Board) -> Array:
    return apply(known.T_base_board, board.points().mean(axis=0))


def _same_base(before: Sequence[SearchedBoardImage], station: str, seen: Sequence[SearchedBoardImage]) -> bool:
    """Return whether an earlier step's images were taken from this station."""
    return all(look.capture.station == station for look in (*before, *seen))


_MOST = 30  # most further poses in one attempt
_AGAIN = 10  # further poses if their number cannot be predicted
_AIM = 0.9  # share of a limit to reach, because predictions may be slightly optimistic
_SPARE = 0.03  # added to a required coverage, because a corner may miss its predicted cell

Enough = Callable[[PlanPrediction, PlanPrediction], bool]


def mend_calibration(context: StepContext, capture: BoardCapture, measures: Mapping[str, float]) -> None:
    """If a gate fails, plan and note further poses; the retry takes them and keeps the good images."""
    verdicts = evaluate_gates(context.step, context.attempt, measures, context.run.skipped).verdicts
    failed = [verdict for verdict in verdicts if not verdict.passed]
    if not failed:
        return
    short = "; ".join(describe(verdict) for verdict in failed)
    again = [word for name, word in TAKEN_AGAIN.items() if name in {v.measure for v in failed}]
    by_poses = [verdict for verdict in failed if verdict.measure not in TAKEN_AGAIN]
    if by_poses:
        count, rules = _wanted(by_poses, measures)

        def advise(found: int, names: str, words: str) -> str:
            first = f"First {' and '.join(again)}. " if again else ""
            return (
                f"{short}. {first}Confirm to take {counted(found, 'more image', 'more images')} of the board "
                f"({names}); all others are kept. Prediction with them: {words}"
            )

        if capture.mend(count, lambda before, after: all(rule(before, after) for rule in rules), advise):
            return
    if again:
        advice = f"{short}. First {' and '.join(again)}; then confirm, and the affected images are taken again"
    else:
        advice = (
            f"{short}. The arm can reach no further pose that shows the whole board: lay the board where the arm can "
            "reach more poses around it, and redo the step"
        )
    context.note("advice", advice=advice)
    context.tell(advice)


def _wanted(failed: Sequence[GateVerdict], measures: Mapping[str, float]) -> tuple[int, list[Enough]]:
    """Return the most poses to add, and the rules that say when they are enough."""
    least, most, rules = 1, _MOST, list[Enough]()
    for verdict in failed:
        name, value = verdict.measure, verdict.value
        low, high = verdict.minimum, verdict.maximum
        if name == "views" and value is not None and low is not None:
            least = max(least, round(low - value))
        elif name in _PREDICTED and (low is not None or (high is not None and value)):
            rules.append(_rule(name, value, low, high))
        else:  # an error that decreases with more images
            least = max(least, _AGAIN)
    return max(most, least), [lambda before, after: after.images - before.images >= least, *rules]


def _rule(name: str, value: float | None, low: float | None, high: float | None) -> Enough:
    """Return a rule that says if a predicted number reaches the gate.

    For uncertainties, the measured value is scaled by the predicted ratio of after to before.
    """
    of = _PREDICTED[name]
    if low is not None:
        least = min(1.0, low + _SPARE) if name == "coverage" else low
        return lambda _before, after: of(after) >= least
    assert high is not None
    assert value is not None
    return lambda before, after: value * of(after) / of(before) <= _AIM * high


_PREDICTED: Mapping[str, Callable[[PlanPrediction], float]] = {
    "coverage": lambda p: p.coverage,
    "tilt_deg": lambda p: p.tilt_deg - 0.5,
    "rotation_spread_deg": lambda p: p.rotation_spread_deg - 0.5,
    "uncertainty_mm": lambda p: p.uncertainty_mm,
    "uncertainty_px": lambda p: p.uncertainty_mm,
    "uncertainty_centre_mm": lambda p: p.uncertainty_mm,
    "hand_eye_sigma_mm": lambda p: p.hand_eye_sigma_mm,
    "hand_eye_sigma_deg": lambda p: p.hand_eye_sigma_deg,
}
