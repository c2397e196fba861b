"""Guides a capture by hand: its parameters and measures, what its jobs are given, and what the person reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from service.computations import layout
from service.computations.calibration import CALIBRATE
from service.computations.hand_held import (
    HAND_BOARD,
    HAND_VIEW,
    BoardArguments,
    HandBoardArguments,
    HandViewAnswer,
    HandViewArguments,
    PlannedPlace,
    SpecimenArguments,
)
from service.computations.live import COVERAGE_POINTS, CoveragePointsArguments
from service.computations.records import Limits, Point, image_of
from service.core.errors import ConfigurationError
from service.core.gates import evaluate_gates
from service.core.jobs import Each, Reference, jobs_of, key_stem, resolve
from service.core.records.base import Record
from service.core.records.run_events import RecordedOptics, ViewHeld
from service.core.run.state import JobState
from service.core.step_params import NAMES_CALIBRATION, NAMES_SPHERES, NeededDevice, RepeatedStep, StepParams
from service.core.units import metres, rad_of_mrad
from service.steps.context import JobRequest, StepContext, StepOutcome
from service.steps.exposure import wanted_settings
from service.steps.live_numbers import COVERAGE, ERROR, CoverageRule, seen_words
from service.steps.measures import Count, PredictedMeasures, Share
from service.steps.registration import held_views
from service.steps.retakes import departing_images, optics_departures


class Ring(Record):
    """Camera places on a hemisphere at one tilt from the vertical, evenly spread over an azimuth range.

    Azimuth 0 is the person's side at the first image, positive to the right. A range of 360° is a whole ring.
    """

    tilt_deg: Annotated[float, Field(ge=0, le=60)]  # the angle from the vertical
    azimuth_from_deg: float = -180.0  # start of the range
    azimuth_to_deg: float = 180.0  # end of the range
    count: Annotated[int, Field(ge=1, le=60)]  # places on the ring
    distance_m: Annotated[float, Field(ge=0.2, le=2)]  # the distance from the middle of the scene
    aim_spread_m: Annotated[float, Field(ge=0, le=0.2)] = (
        0.0  # the aim point's distance from the middle, for images of the board
    )

    def azimuths_deg(self) -> list[float]:
        """Return the azimuths of its places."""
        span = self.azimuth_to_deg - self.azimuth_from_deg
        whole = span >= 360.0
        if self.count == 1:
            return [self.azimuth_from_deg + span / 2]
        return [
            float(a) for a in np.linspace(self.azimuth_from_deg, self.azimuth_to_deg, self.count, endpoint=not whole)
        ]


class Params(StepParams):
    """The purpose of the images, and the places from which they should be taken."""

    by_hand: ClassVar = True
    repeated: ClassVar = RepeatedStep("Take the images that are missing or would help; the others are kept")

    purpose: Literal["dataset", "control", "calibration"]  # the purpose of the images
    hemisphere: Annotated[tuple[Ring, ...], Field(min_length=1)]  # the places from which images are to be taken
    prefix: str = "h_"  # the beginning of the views' names
    min_images: Annotated[int, Field(ge=3)] = 12  # usable images that are needed at least
    max_images: Annotated[int, Field(ge=3)] = 200  # including unusable ones
    # Step with the intrinsics; not for images of the board.
    calibration: Annotated[str | None, NAMES_CALIBRATION] = None
    # Steps that locate the spheres, the best first: ct_import, layout_check.
    spheres_of: Annotated[tuple[str, ...], NAMES_SPHERES] = ()
    sensor_width_mm: float = 35.7  # the width for images of the board, together with the focal length in the file
    coverage: CoverageRule = CoverageRule()  # rules by which a view counts for a point of the specimen's surface
    pose_sigma_mm: Annotated[float, Field(gt=0)] = 0.05  # expected position error of structure from motion
    pose_sigma_mrad: Annotated[float, Field(gt=0)] = 0.1  # expected rotation error of structure from motion
    scan_sigma_mm: Annotated[float, Field(ge=0)] = 0.03  # expected error of the scan's own points, for predictions
    wait_s: Annotated[float, Field(gt=0)] = 600.0  # longest wait for the next image before the step stops

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A camera."""
        return (NeededDevice("camera"),)

    @property
    def photographs_specimen(self) -> bool:
        """True unless the images are of the calibration board."""
        return self.purpose != "calibration"


class Measures(PredictedMeasures):
    """The measures of the images so far."""

    images_taken: Annotated[Count, "photographs taken"] = None
    images_used: Annotated[Count, "photographs that can be used"] = None
    images_not_used: Annotated[Count, "photographs that cannot be used"] = None
    coverage: Annotated[Share, "share of the image area in which corners of the board were seen"] = None
    hemisphere_coverage: Annotated[Share, "share of the planned places with a usable image"] = None
    optics_departures: Annotated[Count, "images whose zoom, focus or lens differs from the calibrated one"] = None


class Result(Record):
    """The images that are used, and those that are not."""

    purpose: str
    used: tuple[str, ...]
    not_used: dict[str, str]  # image → why


@dataclass(frozen=True, slots=True)
class CommonArguments:
    """The arguments that all jobs of the step share, and the references that are recorded in their place."""

    values: BoardArguments | SpecimenArguments
    references: Mapping[str, Reference | None]


def common_arguments(context: StepContext, params: Params) -> CommonArguments:
    """Return the arguments that all jobs of the step have in common.

    Raises:
        ConfigurationError: the protocol does not name the board, the calibration or the spheres that the images need.
    """
    return _of_board(context, params) if params.purpose == "calibration" else _of_specimen(context, params)


def _places(params: Params) -> tuple[PlannedPlace, ...]:
    """Return the places of the hemisphere."""
    return tuple(
        PlannedPlace(
            name=f"{ring.tilt_deg:02.0f}/{k + 1}",
            tilt_deg=ring.tilt_deg,
            azimuth_deg=azimuth,
            distance_m=ring.distance_m,
            walk_round=params.purpose != "calibration",
            aim_m=(ring.aim_spread_m * float(np.cos(2.4 * k)), ring.aim_spread_m * float(np.sin(2.4 * k)), 0.0),
        )
        for ring in params.hemisphere
        for k, azimuth in enumerate(ring.azimuths_deg())
    )


def _first_words(params: Params, what: str) -> str:
    height_cm = 100 * params.hemisphere[0].distance_m
    return (
        f"hold the camera {height_cm:.0f} cm above the middle of the {what}, looking straight down, "
        "and release the shutter"
    )


def _limits(params: Params) -> Limits:
    return Limits.model_validate(params.coverage.model_dump())


def _of_board(context: StepContext, params: Params) -> CommonArguments:
    board = context.protocol.board
    if board is None:
        raise ConfigurationError(
            "the protocol describes no calibration board",
            where=f"step {context.step.id}",
            remedy="Add a section `board`",
        )
    values = BoardArguments(
        places=_places(params),
        within_deg=9.0,
        first_words=_first_words(params, "calibration board"),
        limits=_limits(params),
        columns=board.columns,
        rows=board.rows,
        square_m=metres(board.square_mm),
        sensor_width_mm=params.sensor_width_mm,
    )
    return CommonArguments(values, {})


def _of_specimen(context: StepContext, params: Params) -> CommonArguments:
    if params.calibration is None:
        raise ConfigurationError(
            "images of the specimen need the calibrated camera",
            where=f"step {context.step.id}",
            remedy="Name the calibration step in `calibration`",
        )
    error, covers = (next((g for g in context.step.gates if g.measure == m), None) for m in (ERROR, COVERAGE))
    calibration = context.earlier_answer(params.calibration, CALIBRATE)
    spheres, rough, spheres_from = _spheres(context, params)
    values = SpecimenArguments(
        places=_places(params),
        within_deg=14.0,
        first_words=_first_words(params, "specimen"),
        limits=_limits(params),
        rough=rough,
        camera=calibration.answer.camera,
        spheres_m=spheres,
        radius_m=metres(context.protocol.spheres.radius_mm),
        pose_sigma_m=metres(params.pose_sigma_mm),
        pose_sigma_rad=rad_of_mrad(params.pose_sigma_mrad),
        limit_m=metres(error.max if error and error.max is not None else 0.35),
        min_coverage=covers.min if covers and covers.min is not None else 0.0,
        scan_sigma_m=metres(params.scan_sigma_mm),
    )
    references = {"camera": calibration.reference("camera"), "spheres_m": spheres_from}
    lens = calibration.answer.intrinsics_covariance
    if lens is not None:
        values = values.model_copy(update={"intrinsics_covariance": lens})
        references["intrinsics_covariance"] = calibration.reference("details/intrinsics/covariance")
    colour = context.protocol.spheres.colour
    if colour is not None:  # a field that is not set is not recorded
        values = values.model_copy(update={"colour": colour})
    return CommonArguments(values, references)


def _spheres(context: StepContext, params: Params) -> tuple[tuple[Point, ...], bool, Reference | None]:
    """Return the first spheres of the steps `spheres_of`, whether they are rough, and the reference to them.

    Spheres that were located in photographs alone are rough.
    """
    for name in params.spheres_of:
        state = context.run.steps.get(name)
        if state is not None and state.result.get("spheres_m"):
            found = context.earlier_answer(name, layout.KIND)
            rough = context.protocol.step(name).gives == "rough_spheres"
            return found.answer.spheres_m, rough, found.reference("spheres_m")
    raise ConfigurationError(
        f"the spheres have not been located by {' or '.join(params.spheres_of) or 'any step'}",
        where=f"step {context.step.id}, spheres_of",
        remedy="Name the CT import, or the layout check from photographs",
    )


def failure_words(job: JobState) -> str:
    """Explain a failed job on the images: what it means, and what to do."""
    why = job.message.rstrip(".")
    if job.kind == COVERAGE_POINTS.name:
        return (
            f"the coverage of the specimen cannot be computed: {why}. Images are judged without it. A gate on the "
            "coverage cannot pass: finish with the images so far, and the step offers what can be done"
        )
    return (
        f"{image_of(job).viewpoint} could not be analysed: {why}. It stays in the evidence but is not "
        "used: take it again from the same place"
    )


@dataclass
class Guide:
    """Enqueues a job for one image after the other, and shows the person the result."""

    context: StepContext
    params: Params
    shared: CommonArguments
    told: str = ""

    @property
    def kind(self) -> str:
        """The kind of the jobs."""
        return (HAND_BOARD if self.params.purpose == "calibration" else HAND_VIEW).name

    def begin(self) -> None:
        """Enqueue the specimen's surface if there is a CT, and say where to begin."""
        mesh, shared = self._mesh(), self.shared.values
        if mesh is not None and isinstance(shared, SpecimenArguments):  # a board has no surface
            arguments = CoveragePointsArguments(
                mesh=mesh, spheres_m=shared.spheres_m, radius_m=shared.radius_m, limits=shared.limits
            )
            references = {"spheres_m": self.shared.references["spheres_m"]}
            request = JobRequest.of(COVERAGE_POINTS, arguments, references)
            self.context.evidence.enqueue(request, "specimen")
        done = self._answers()
        self._say(_answer_of(done[-1]).words if done else self.shared.values.first_words)

    def look(self) -> None:
        """Show the result of the last image, and enqueue the job for the next one. Returns at once."""
        jobs = {image_of(job).sha256: job for job in self._jobs()}
        for view in self._views():
            job = jobs.get(view.artefacts[0].sha256)
            if job is None:
                self._enqueue(view)
                return
            if job.status == "enqueued":
                return
            if job.job not in self._reported:
                self._reported.add(job.job)
                self._report(job)
        for job in self.context.evidence.jobs(self.context.step.id):
            if job.kind == COVERAGE_POINTS.name and job.status == "failed" and job.job not in self._reported:
                self._reported.add(job.job)
                self.context.tell(failure_words(job))

    def __post_init__(self) -> None:
        # The results of jobs that ended before a restart were shown then.
        self._reported = {job.job for job in self._jobs() if job.status != "enqueued"}

    def images_used(self) -> int:
        """Return the number of usable images so far."""
        return int(self._measures().get("images_used", 0))

    def enough(self) -> bool:
        """Return whether every image was analysed and the step's gates pass, or there are too many images."""
        views = self._views()
        if len(self._answers()) + sum(job.status == "failed" for job in self._jobs()) < len(views):
            return False
        if len(views) >= self.params.max_images:
            return True
        measures = self._measures()
        if measures.get("images_used", 0.0) < self.params.min_images:
            return False
        return evaluate_gates(self.context.step, self.context.attempt, measures, self.context.run.skipped).passed

    def outcome(self) -> StepOutcome:
        """Return the outcome of the step."""
        found = held_views(self.context, self.context.step.id)
        failed = {image_of(j).sha256: j.message for j in self._jobs() if j.status == "failed"}
        used: list[str] = []
        not_used: dict[str, str] = {}
        for view in self._views():
            sha256 = view.artefacts[0].sha256
            look = found.get(sha256)
            if look is not None and look.used:
                used.append(view.viewpoint)
            else:
                not_used[view.viewpoint] = failed.get(sha256, "not analysed") if look is None else look.why
        result = Result(purpose=self.params.purpose, used=tuple(used), not_used=not_used)
        return StepOutcome(Measures.read(self._measures()), (), result)

    def _measures(self) -> dict[str, float]:
        done = self._answers()
        views = self._views()
        measures = {"images_taken": float(len(views)), "images_used": 0.0}
        if done:
            last = done[-1].measures
            names = ("images_used", "hemisphere_coverage", "coverage", ERROR, COVERAGE)
            measures |= {name: last[name] for name in names if name in last}
        measures["images_not_used"] = measures["images_taken"] - measures["images_used"]
        used = {image_of(job).sha256 for job in done if _answer_of(job).used}
        departures = optics_departures(
            self.context, [view for view in views if view.artefacts[0].sha256 in used], quiet=True
        )
        if departures is not None:
            measures["optics_departures"] = float(departing_images(departures))
        return measures

    def _views(self) -> list[ViewHeld]:
        return [v for v in self.context.evidence.captures(self.context.step.id) if isinstance(v, ViewHeld)]

    def _jobs(self) -> list[JobState]:
        return [job for job in self.context.evidence.jobs(self.context.step.id) if job.kind == self.kind]

    def _answers(self) -> list[JobState]:
        return [job for job in self._jobs() if job.status == "finished"]

    def _mesh(self) -> str | None:
        if self.params.purpose == "calibration":
            return None
        for name in self.params.spheres_of[:1]:
            try:
                return self.context.earlier_artefact(name, "ct_mesh").sha256
            except ConfigurationError:
                return None
        return None

    def _surface(self) -> str | None:
        jobs = self.context.evidence.jobs(self.context.step.id)
        done = [job for job in jobs if job.kind == COVERAGE_POINTS.name and job.status == "finished"]
        return done[-1].artefacts[0].sha256 if done else None

    def _enqueue(self, view: ViewHeld) -> None:
        wanted = wanted_settings(self.context)
        stated = view.optics
        settings = ""
        if not view.verdicts["settings"]:
            settings = (
                f"the camera was set to {_settings(stated)}; "
                f"required are f/{wanted.aperture_f:g}, {wanted.exposure_s:.3g} s, ISO {wanted.iso}"
            )
        image = {
            "viewpoint": view.viewpoint,
            "sha256": view.artefacts[0].sha256,
            "settings": settings,
            "focal_mm": stated.focal_length_mm or 0.0,
        }
        state = self.context.evidence.state()
        step = self.context.step.id
        done = [j for j in self._answers() if j.ended_seq <= state.seq]
        earlier = [job.artefacts[0].sha256 for job in done]
        each = Each((key_stem(state, step, self.kind),), state.seq, "artefacts/0/sha256")
        looks = each if resolve(each.record(), jobs_of(state)) == earlier else None
        shared = self.shared.values
        arguments = {**shared.set_fields(), "image": image, "earlier": earlier, "surface": self._surface()}
        references = {**self.shared.references, "earlier": looks}
        request = (
            JobRequest.of(HAND_BOARD, HandBoardArguments.model_validate(arguments), references)
            if self.params.purpose == "calibration"
            else JobRequest.of(HAND_VIEW, HandViewArguments.model_validate(arguments), references)
        )
        self.context.evidence.enqueue(request, view.artefacts[0].sha256)

    def _report(self, job: JobState) -> None:
        if job.status == "failed":
            self.context.tell(failure_words(job))
            done = self._answers()
            self._say_next(_answer_of(done[-1]).words if done else self.shared.values.first_words)
            return
        m, answer = job.measures, _answer_of(job)
        parts = [f"{m['images_used']:.0f} used", f"hemisphere {100 * m['hemisphere_coverage']:.0f} %"]
        if "spheres_seen" in m:
            parts.insert(0, seen_words(m["spheres_seen"], m["spheres_expected"]))
        if "spheres_sigma_mm" in m:  # they have not been measured: the images locate them
            parts.append(f"spheres known to {m['spheres_sigma_mm']:.2f} mm")
        if ERROR in m:
            parts.append(f"predicted error {m[ERROR]:.3f} mm")
        for name, word in ((COVERAGE, "specimen"), ("coverage", "frame")):
            if name in m:
                parts.append(f"{word} {100 * m[name]:.0f} %")
        verdict = "" if answer.used else f" not used: {answer.why}."
        self.context.tell(f"{answer.viewpoint}:{verdict} {', '.join(parts)}")
        self._say_next(answer.words)

    def _say_next(self, words: str) -> None:
        """Say where to go, unless the images suffice or another image (as from a memory card) waits for its job."""
        ended = sum(job.status != "enqueued" for job in self._jobs())
        if ended == len(self._views()) and not self.enough():
            self._say(words)

    def _say(self, words: str) -> None:
        self.context.tell(f"next: {words}")


def _settings(stated: RecordedOptics) -> str:
    """Return the settings of a photograph as a person reads them, and those that it does not state."""
    aperture = "an unknown aperture" if stated.aperture_f is None else f"f/{stated.aperture_f:g}"
    time = "an unknown time" if stated.exposure_s is None else f"{stated.exposure_s:.3g} s"
    return f"{aperture}, {time}, {'an unknown ISO' if stated.iso is None else f'ISO {stated.iso:g}'}"


def _answer_of(job: JobState) -> HandViewAnswer:
    """Return the answer of either kind of job: both answer alike."""
    return HAND_VIEW.read_answer(job.result)
