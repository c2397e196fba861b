"""Step kind `manual_capture`: a person holds the camera; after each image the software says where to go next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from drivers.errors import DeviceTimeoutError
from service.core.errors import ConfigurationError
from service.core.gates.verdict import evaluate_gates
from service.core.jobs.keys import key_stem
from service.core.jobs.references import Each, Reference, jobs_of, resolve
from service.core.records.events import Record, ViewHeld
from service.core.run.state import JobState
from service.core.units import metres, rad_of_mrad
from service.jobs.calibration import calibrate
from service.jobs.capture import hand_board, hand_view
from service.jobs.records import Point
from service.jobs.surfaces import coverage_points, layout
from service.steps.capture.exposure import wanted_settings
from service.steps.capture.held_camera import HeldCamera
from service.steps.capture.live_numbers import COVERAGE, ERROR, CoverageRule, seen_words
from service.steps.capture.optics import departing_images, optics_departures
from service.steps.context import Announcement, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.inputs import artefact_of, earlier_answer, held_views
from service.steps.measures import Count, PredictedMeasures, Share

_KINDS = {"dataset": "image", "control": "control_image", "calibration": "board_image"}


class Ring(Record):
    """Places of a hemisphere at one tilt from the vertical, evenly spread over an azimuth range.

    Azimuth 0 is the person's side at the first image, positive to the right; a range of 360° is a whole ring.
    """

    tilt_deg: Annotated[float, Field(ge=0, le=60)]  # from the vertical
    azimuth_from_deg: float = -180.0  # start of the range
    azimuth_to_deg: float = 180.0  # end of the range
    count: Annotated[int, Field(ge=1, le=60)]  # places on the ring
    distance_m: Annotated[float, Field(ge=0.2, le=2)]  # from the middle of the scene
    aim_spread_m: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # to all sides of the middle, for images of the board

    def azimuths_deg(self) -> list[float]:
        """Of its places."""
        span = self.azimuth_to_deg - self.azimuth_from_deg
        whole = span >= 360.0
        if self.count == 1:
            return [self.azimuth_from_deg + span / 2]
        return [
            float(a) for a in np.linspace(self.azimuth_from_deg, self.azimuth_to_deg, self.count, endpoint=not whole)
        ]


class Params(Record):
    """What the images are for, and from where they should be taken."""

    purpose: Literal["dataset", "control", "calibration"]  # what the images are for
    hemisphere: Annotated[tuple[Ring, ...], Field(min_length=1)]  # from where images are to be taken
    prefix: str = "h_"  # of the names of the views
    min_images: Annotated[int, Field(ge=3)] = 12  # that must be usable
    max_images: Annotated[int, Field(ge=3)] = 200  # those that cannot be used included
    calibration: str | None = None  # step with the intrinsics; none for images of the board
    spheres_of: tuple[str, ...] = ()  # steps that may know the spheres, the best first: ct_import, layout_check
    sensor_width_mm: float = 35.7  # for images of the board, with the focal length of the file
    coverage: CoverageRule = CoverageRule()  # when a view counts for a point of the specimen's surface
    pose_sigma_mm: Annotated[float, Field(gt=0)] = 0.05  # what structure from motion will leave of a camera's pose
    pose_sigma_mrad: Annotated[float, Field(gt=0)] = 0.1  # of the camera's rotation
    wait_s: Annotated[float, Field(gt=0)] = 600.0  # for the next image, before the step asks what is wrong


def failure_words(job: JobState) -> str:
    """For a person: which work on the images has failed, what that means and what to do."""
    why = job.message.rstrip(".")
    if job.kind == "coverage_points":
        return (
            f"what of the specimen the images show cannot be told: {why}. Images are judged without it; a limit on "
            "it is not met: end with what there is (finish), and the step lists the ways on"
        )
    return (
        f"{job.arguments['image']['viewpoint']} could not be looked at: {why}. It stays in the evidence and is not "
        "used: take it again from the same place"
    )


class Measures(PredictedMeasures):
    """Of the images so far."""

    images_taken: Annotated[Count, "photographs taken"] = None
    images_used: Annotated[Count, "photographs that can be used"] = None
    images_not_used: Annotated[Count, "photographs that cannot be used"] = None
    coverage: Annotated[Share, "share of the image area in which corners of the board were seen"] = None
    hemisphere_coverage: Annotated[Share, "share of the planned places with a usable image"] = None
    optics_departures: Annotated[Count, "images whose zoom, focus or lens differs from the calibrated one"] = None


class Result(Record):
    """Which images count."""

    purpose: str
    used: tuple[str, ...]
    not_used: dict[str, str]  # image → why


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Take images until the step's limits are met, or somebody says that it is enough."""
    guide = _Guide(context, params, _shared(context, params))
    held = HeldCamera(context, params.prefix, _KINDS[params.purpose])
    guide.begin()
    last_s = context.monotonic_s()
    while not (held.finished or guide.enough()):
        context.checkpoint()
        held.waiting(guide.images_used(), params.min_images)
        if held.new_views():
            last_s = context.monotonic_s()
        guide.look()
        if context.monotonic_s() - last_s > params.wait_s:
            raise DeviceTimeoutError(
                f"no image came within {params.wait_s:.0f} s",
                where=f"step {context.step.id}",
                remedy="Check camera and cable; what was taken is safe. Confirm to go on",
            )
    return guide.outcome()


def _shared(context: StepContext, params: Params) -> _CommonArguments:
    """The arguments that all jobs of the step have in common."""
    board = params.purpose == "calibration"
    places = [
        {
            "name": f"{ring.tilt_deg:02.0f}/{k + 1}",
            "tilt_deg": ring.tilt_deg,
            "azimuth_deg": azimuth,
            "distance_m": ring.distance_m,
            "walk_round": not board,
            "aim_m": [ring.aim_spread_m * float(np.cos(2.4 * k)), ring.aim_spread_m * float(np.sin(2.4 * k)), 0.0],
        }
        for ring in params.hemisphere
        for k, azimuth in enumerate(ring.azimuths_deg())
    ]
    first = params.hemisphere[0]
    what = "calibration board" if board else "specimen"
    shared: dict[str, Any] = {
        "places": places,
        "within_deg": 9.0 if board else 14.0,
        "first_words": f"hold the camera {100 * first.distance_m:.0f} cm above the middle of the {what}, "
        "looking straight down, and release the shutter",
        "limits": params.coverage.model_dump(),
    }
    if board:
        described = context.protocol.board
        if described is None:
            raise ConfigurationError(
                "the protocol describes no calibration board",
                where=f"step {context.step.id}",
                remedy="Add a section `board`",
            )
        size = {"columns": described.columns, "rows": described.rows, "square_m": metres(described.square_mm)}
        return _CommonArguments({**shared, **size, "sensor_width_mm": params.sensor_width_mm}, {})
    if params.calibration is None:
        raise ConfigurationError(
            "images of the specimen need the calibrated camera",
            where=f"step {context.step.id}",
            remedy="Name the calibration step in `calibration`",
        )
    error, covers = (next((g for g in context.step.gates if g.measure == m), None) for m in (ERROR, COVERAGE))
    if context.protocol.spheres.colour is not None:
        shared["colour"] = context.protocol.spheres.colour
    calibration = earlier_answer(context, params.calibration, calibrate.KIND)
    spheres, rough, spheres_from = _spheres(context, params)
    fields = {
        **shared,
        "camera": calibration.answer.camera,
        "spheres_m": spheres,
        "rough": rough,
        "radius_m": metres(context.protocol.spheres.radius_mm),
        "pose_sigma_m": metres(params.pose_sigma_mm),
        "pose_sigma_rad": rad_of_mrad(params.pose_sigma_mrad),
        "limit_m": metres(error.max if error and error.max is not None else 0.35),
        "min_coverage": covers.min if covers and covers.min is not None else 0.0,
    }
    return _CommonArguments(fields, {"camera": calibration.reference("camera"), "spheres_m": spheres_from})


def _spheres(context: StepContext, params: Params) -> tuple[tuple[Point, ...], bool, Reference | None]:
    """The spheres of the first of the steps named that has them, whether they are rough, and the reference to them.

    Those that photographs alone tell of are rough.
    """
    for name in params.spheres_of:
        state = context.run.steps.get(name)
        if state is not None and state.result.get("spheres_m"):
            found = earlier_answer(context, name, layout.KIND)
            rough = context.protocol.step(name).kind == "layout_check"
            return found.answer.spheres_m, rough, found.reference("spheres_m")
    raise ConfigurationError(
        f"none of {', '.join(params.spheres_of) or 'no step'} knows where the spheres are",
        where=f"step {context.step.id}, spheres_of",
        remedy="Name the CT import, or the layout check from photographs",
    )


@dataclass(frozen=True, slots=True)
class _CommonArguments:
    """Fields of the arguments of all jobs of the step, and what of them is recorded as a reference."""

    fields: Mapping[str, Any]
    taken: Mapping[str, Reference | None]


@dataclass
class _Guide:
    """Has the images looked at, one after the other, and tells the person what came of it."""

    context: StepContext
    params: Params
    shared: _CommonArguments
    told: str = ""

    @property
    def kind(self) -> str:
        """Of the jobs."""
        return (hand_board if self.params.purpose == "calibration" else hand_view).KIND.name

    def begin(self) -> None:
        """Have the specimen's surface prepared where a CT shows it, and say where to begin."""
        mesh = self._mesh()
        if mesh is not None:
            kept = {k: self.shared.fields[k] for k in ("spheres_m", "radius_m", "limits")}
            arguments = coverage_points.Arguments.model_validate({"mesh": mesh, **kept})
            references = {"spheres_m": self.shared.taken["spheres_m"]}
            request = JobRequest.of(coverage_points.KIND, arguments, references)
            self.context.evidence.enqueue(request, "specimen")
        done = self._answers()
        self._say(str(done[-1].result["words"]) if done else str(self.shared.fields["first_words"]))

    def look(self) -> None:
        """Tell what is known of the last image; have the next one looked at. Returns at once."""
        jobs = {str(job.arguments["image"]["sha256"]): job for job in self._jobs()}
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
            if job.kind == "coverage_points" and job.status == "failed" and job.job not in self._reported:
                self._reported.add(job.job)
                self.context.tell(failure_words(job))

    def __post_init__(self) -> None:
        # What ended before a restart was told then.
        self._reported = {job.job for job in self._jobs() if job.status != "enqueued"}

    def images_used(self) -> int:
        """So far."""
        return int(self._measures().get("images_used", 0))

    def enough(self) -> bool:
        """Whether every image was looked at and the step's limits are met, or there are too many images."""
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
        """The step's numbers."""
        found = held_views(self.context, self.context.step.id)
        failed = {j.arguments["image"]["sha256"]: j.message for j in self._jobs() if j.status == "failed"}
        used: list[str] = []
        not_used: dict[str, str] = {}
        for view in self._views():
            sha256 = view.artefacts[0].sha256
            look = found.get(sha256)
            if look is not None and look.used:
                used.append(view.viewpoint)
            else:
                not_used[view.viewpoint] = failed.get(sha256, "not looked at") if look is None else look.why
        result = Result(purpose=self.params.purpose, used=tuple(used), not_used=not_used)
        return StepOutcome(Measures.read(self._measures()), (), result.model_dump(mode="json"))

    def _measures(self) -> dict[str, float]:
        done = self._answers()
        views = self._views()
        measures = {"images_taken": float(len(views)), "images_used": 0.0}
        if done:
            last = done[-1].measures
            names = ("images_used", "hemisphere_coverage", "coverage", ERROR, COVERAGE)
            measures |= {name: last[name] for name in names if name in last}
        measures["images_not_used"] = measures["images_taken"] - measures["images_used"]
        used = {str(job.arguments["image"]["sha256"]) for job in done if job.result["used"]}
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
                return artefact_of(self.context, name, "ct_mesh").sha256
            except ConfigurationError:
                return None
        return None

    def _surface(self) -> str | None:
        jobs = self.context.evidence.jobs(self.context.step.id)
        done = [job for job in jobs if job.kind == "coverage_points" and job.status == "finished"]
        return done[-1].artefacts[0].sha256 if done else None

    def _enqueue(self, view: ViewHeld) -> None:
        wanted = wanted_settings(self.context)
        camera = view.camera
        settings = ""
        if not view.verdicts["settings"]:
            settings = (
                f"the camera was set to f/{camera['aperture_f']:g}, {camera['exposure_s']:.3g} s, "
                f"ISO {camera['iso']}; "
                f"wanted are f/{wanted.aperture_f:g}, {wanted.exposure_s:.3g} s, ISO {wanted.iso}"
            )
        image = {
            "viewpoint": view.viewpoint,
            "sha256": view.artefacts[0].sha256,
            "settings": settings,
            "focal_mm": camera["focal_length_mm"],
        }
        state = self.context.evidence.state()
        step = self.context.step.id
        done = [j for j in self._answers() if j.ended_seq <= state.seq]
        earlier = [job.artefacts[0].sha256 for job in done]
        each = Each((key_stem(state, step, self.kind),), state.seq, "artefacts/0/sha256")
        looks = each if resolve(each.record(), jobs_of(state)) == earlier else None
        arguments = {**self.shared.fields, "image": image, "earlier": earlier, "surface": self._surface()}
        references = {**self.shared.taken, "earlier": looks}
        request = (
            JobRequest.of(hand_board.KIND, hand_board.Arguments.model_validate(arguments), references)
            if self.params.purpose == "calibration"
            else JobRequest.of(hand_view.KIND, hand_view.Arguments.model_validate(arguments), references)
        )
        self.context.evidence.enqueue(request, view.artefacts[0].sha256)

    def _report(self, job: JobState) -> None:
        if job.status == "failed":
            self.context.tell(failure_words(job))
            done = self._answers()
            self._say_next(str(done[-1].result["words"]) if done else str(self.shared.fields["first_words"]))
            return
        m, result = job.measures, job.result
        parts = [f"{m['images_used']:.0f} used", f"hemisphere {100 * m['hemisphere_coverage']:.0f} %"]
        if "spheres_seen" in m:
            parts.insert(0, seen_words(m["spheres_seen"], m["spheres_expected"]))
        if "spheres_sigma_mm" in m:  # nobody has measured them: the images tell where they are
            parts.append(f"spheres known to {m['spheres_sigma_mm']:.2f} mm")
        if ERROR in m:
            parts.append(f"predicted error {m[ERROR]:.3f} mm")
        for name, word in ((COVERAGE, "specimen"), ("coverage", "frame")):
            if name in m:
                parts.append(f"{word} {100 * m[name]:.0f} %")
        verdict = "" if result["used"] else f" not used: {result['why']}."
        self.context.tell(f"{result['viewpoint']}:{verdict} {', '.join(parts)}")
        self._say_next(str(result["words"]))

    def _say_next(self, words: str) -> None:
        """Unless that is enough, or another image waits to be looked at, as of a card: its words will count."""
        ended = sum(job.status != "enqueued" for job in self._jobs())
        if ended == len(self._views()) and not self.enough():
            self._say(words)

    def _say(self, words: str) -> None:
        self.context.tell(f"next: {words}")


KIND = StepKind(
    "manual_capture",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, _before: Announcement(
        "begin to take images by hand", "Nothing moves. The screen says where to hold the camera."
    ),
    drawing="camera",
)
