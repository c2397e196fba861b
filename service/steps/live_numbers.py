"""Live numbers of a capture by the robot, from one job per image; the capture does not wait for these jobs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from service.computations.calibration import CALIBRATE
from service.computations.further_cameras import FURTHER_VIEW, FurtherViewArguments
from service.computations.live import (
    COVERAGE_POINTS,
    LIVE_SUMMARY,
    LIVE_VIEW,
    CandidateView,
    CoveragePointsArguments,
    LiveArguments,
    LiveSummaryArguments,
    LiveViewArguments,
    Suggestion,
)
from service.computations.records import Hash, ImageFile, Limits, Mounting, Point, PosedPhotograph, image_of
from service.computations.scans import LOCATE_SPHERES
from service.core.errors import ComputeError, ConfigurationError
from service.core.gates import limits as gate_text
from service.core.jobs import Each, Reference, jobs_of, key_stem, resolve
from service.core.measure_names import measure_name
from service.core.protocol import Gate
from service.core.records.base import Record
from service.core.records.run_events import FurtherExposure, RecordedView, ViewpointCaptured
from service.core.run.state import LIVE, JobState
from service.core.step_params import NAMES_CALIBRATION, NAMES_CAPTURE, NAMES_CT
from service.core.units import metres, rad_of_mrad
from service.steps.context import JobRequest, StepContext
from service.steps.notes import SPOILT, SUGGESTION, suggested_views
from service.steps.registration import mounting_of, with_robot_pose
from service.steps.retakes import ImageSharpness, row_to_stop_for, stop_for_lens, why_spoilt
from service.steps.viewpoints import Viewpoint


def look_at_further(
    context: StepContext,
    spheres_m: Sequence[Point],
    radius_m: float,
    references: Mapping[str, Reference | Each | None],
) -> None:
    """Enqueue the job on every new image of a further camera in this step. Returns at once.

    Args:
        context: the capture step's surroundings: devices, evidence, clock.
        spheres_m: the spheres' centres in the CT.
        radius_m: the spheres' radius.
        references: the references that are recorded instead of `spheres_m`.
    """
    jobs = context.evidence.jobs(context.step.id)
    begun = {image_of(job).sha256 for job in jobs if job.kind == FURTHER_VIEW.name}
    for viewpoint, exposure in _exposures(context):
        sha256 = exposure.artefacts[0].sha256
        if sha256 in begun:
            continue
        arguments = FurtherViewArguments(
            device=exposure.device,
            image=ImageFile(viewpoint=viewpoint, sha256=sha256),
            calibration=exposure.calibration.sha256,
            spheres_m=tuple(spheres_m),
            radius_m=radius_m,
        )
        request = JobRequest.of(FURTHER_VIEW, arguments, {"spheres_m": references["spheres_m"]}, LIVE)
        context.evidence.enqueue(request, sha256)


def _exposures(context: StepContext) -> list[tuple[str, FurtherExposure]]:
    """Return (viewpoint, exposure) of every usable view of the step."""
    return [
        (capture.viewpoint, exposure)
        for capture in context.evidence.captures(context.step.id)
        if isinstance(capture, ViewpointCaptured) and all(capture.verdicts.values())
        for exposure in capture.further
    ]


def describe_further(job: JobState) -> str:
    """Return one line on one image: `v1_005, side: 7/8 spheres, 0.18 px`, or what is wrong with it."""
    viewpoint = image_of(job).viewpoint
    if job.status == "failed":
        return f"{viewpoint}, further camera: could not be analysed: {job.message}"
    m, answer = job.measures, FURTHER_VIEW.read_answer(job.result)
    if answer.reason:
        return f"{viewpoint}, {answer.device}: this image does not locate it: {answer.reason}"
    return (
        f"{viewpoint}, {answer.device}: {m['spheres_seen']:.0f}/{m['spheres_expected']:.0f} spheres, "
        f"{m['outline_rms_px']:.2f} px"
    )


ERROR, COVERAGE = "predicted_target_error_mm", "specimen_coverage"


class CoverageRule(Record):
    """The rules by which a view counts for a point of the specimen's surface."""

    min_views: Annotated[int, Field(ge=1)] = 2  # views that must see the point
    # Angle between the viewing ray and the normal of the surface.
    max_angle_deg: Annotated[float, Field(gt=0, lt=90)] = 65.0
    max_distance_m: Annotated[float, Field(gt=0)] = 1.0  # the largest distance from the camera


class LiveParams(Record):
    """The steps and limits that the numbers after each image are computed from."""

    calibration: Annotated[str, NAMES_CALIBRATION]  # step with the intrinsics
    hand_eye: Annotated[str, NAMES_CALIBRATION]  # step with T_flange_camera
    spheres_of: Annotated[str, NAMES_CT]  # CT import: the spheres and, for the coverage, the surface
    images_of: Annotated[tuple[str, ...], NAMES_CAPTURE] = ()  # earlier capture steps whose images count too
    aim_mm: Annotated[float, Field(gt=0)] = 0.35  # error that suggested views should reach, if no gate sets a limit
    # Scatter of the camera's positions before any image is taken; without it, as the held-out views of the
    # hand-eye calibration show it.
    arm_sigma_mm: Annotated[float, Field(gt=0)] | None = None
    arm_sigma_mrad: Annotated[float, Field(gt=0)] | None = None  # likewise, the scatter of the camera's rotations
    coverage: CoverageRule = CoverageRule()  # rules by which a view counts for a point of the specimen's surface
    # At the end of the step, for jobs that have not finished: the longest wait without any of them finishing.
    wait_s: Annotated[float, Field(ge=0)] = 60.0


@dataclass
class LiveAnalysis:
    """The live numbers of one execution of one capture step."""

    context: StepContext
    params: LiveParams
    shared: SharedArguments
    told: set[str] = field(default_factory=set[str])

    @classmethod
    def begin(cls, context: StepContext, params: LiveParams | None) -> LiveAnalysis | None:
        """Read the results of earlier steps; None, with a note, if one of them was skipped."""
        if params is None:
            return None
        try:
            shared = SharedArguments.of(context, params)
            mesh = context.earlier_artefact(params.spheres_of, "ct_mesh").sha256
        except ConfigurationError as error:
            context.note("no_live_numbers", why=str(error))
            context.tell(f"no numbers while capturing: {error}")
            return None
        analysis = cls(context, params, shared)
        if not any(job.kind == "coverage_points" for job in analysis._jobs("coverage_points")):
            live = shared.values
            arguments = CoveragePointsArguments(
                mesh=mesh, spheres_m=live.spheres_m, radius_m=live.radius_m, limits=live.limits
            )
            references = {"spheres_m": shared.taken["spheres_m"]}
            request = JobRequest.of(COVERAGE_POINTS, arguments, references, LIVE)
            context.evidence.enqueue(request, "specimen")
        analysis.told = {job.job for kind in _DESCRIBED for job in analysis._jobs(kind) if job.status != "enqueued"}
        return analysis

    def look(self) -> None:
        """Enqueue the job on every new image, and show the numbers of earlier ones. Returns at once."""
        begun = {image_of(job).sha256 for job in self._jobs("live_view")}
        for capture in self.context.evidence.captures(self.context.step.id):
            sha256 = capture.artefacts[0].sha256
            if sha256 in begun or not all(capture.verdicts.values()):
                continue
            image = PosedPhotograph(viewpoint=capture.viewpoint, station=capture.station, sha256=sha256)
            mounting, mounted_by = mounting_of(self.context, [self.params.hand_eye], [capture.station])
            earlier, looks = self._earlier()
            arguments = LiveViewArguments(
                **self.shared.values.set_fields(),
                **mounting.set_fields(),
                image=with_robot_pose(image, capture),
                surface=self._surface(),
                earlier=earlier,
            )
            references = {**self.shared.taken, **mounted_by, "earlier": looks}
            request = JobRequest.of(LIVE_VIEW, arguments, references, LIVE)
            self.context.evidence.enqueue(request, sha256)
        look_at_further(self.context, self.shared.values.spheres_m, self.shared.values.radius_m, self.shared.taken)
        self._tell()

    def summary(
        self, station: str, candidates: Sequence[tuple[Viewpoint, float]], retakes: str = "", again: int = 0
    ) -> dict[str, float]:
        """Wait for the jobs on the last images; return the measures. If a gate fails, suggest further views.

        Args:
            station: the robot's station.
            candidates: further viewpoints at this station, with the travel time (s).
            retakes: the advice on images to take again, to which the suggestion is added.
            again: the number of images to take again.
        """
        self._wait()
        error_gate, coverage_gate = self._gate(ERROR), self._gate(COVERAGE)
        limit_mm = error_gate.max if error_gate and error_gate.max is not None else self.params.aim_mm
        least = coverage_gate.min if coverage_gate and coverage_gate.min is not None else 0.0
        views, looks = self._earlier()
        arguments = LiveSummaryArguments(
            **self.shared.values.set_fields(),
            **self.shared.mounting.set_fields(),
            surface=self._surface(),
            views=views,
            station=station,
            limit_m=metres(limit_mm),
            min_coverage=least,
            candidates=tuple(
                CandidateView(name=v.name, T_base_camera=v.T_base_camera.tolist(), travel_s=travel_s)
                for v, travel_s in candidates
            ),
        )
        request = JobRequest.of(LIVE_SUMMARY, arguments, {**self.shared.taken, "views": looks})
        try:
            (answer,) = self.context.evidence.run_jobs(request)
        except ComputeError as error:
            self.context.note("no_live_numbers", why=str(error))
            return {}
        found = LIVE_SUMMARY.read_answer(answer.result)
        for why in found.reasons.values():
            self.context.tell(why)
        failed = [gate for gate in self.context.step.gates if _fails(gate, answer.measures)]
        if failed and found.next_best_views:
            self._suggest(failed, answer.measures, found.next_best_views, retakes, again)
        return dict(answer.measures)

    def spoilt_in_a_row(self) -> list[ImageSharpness]:
        """Return the blurred or black images at this step's end, if there are so many that the capture must stop."""
        mine = self._looked_at(self.context.step.id)
        return row_to_stop_for(self.context, mine, self._looked_at(*self.params.images_of))

    def spoilt(self) -> dict[str, str]:
        """Wait for the last images while their jobs go on; return the reason of each spoilt image, by its SHA-256.

        Raises ImagesSpoiltError after several in a row.
        """
        self._wait()
        row = self.spoilt_in_a_row()
        if row:
            stop_for_lens(self.context, row)
        return why_spoilt(self._looked_at(self.context.step.id), self._looked_at(*self.params.images_of))

    def unexamined(self) -> list[str]:
        """Return the viewpoints whose image no finished job has looked at: nobody knows whether it is spoilt."""
        captures = [c for c in self.context.evidence.captures(self.context.step.id) if all(c.verdicts.values())]
        seen = {image_of(job).sha256 for job in self._jobs("live_view") if job.status == "finished"}
        return [capture.viewpoint for capture in captures if capture.artefacts[0].sha256 not in seen]

    def note_spoilt(self, reasons: Mapping[str, str]) -> None:
        """Note images that are spoilt even after they were taken again, so that a retry of the step repeats them."""
        captures = self.context.evidence.captures(self.context.step.id)
        names = [capture.viewpoint for capture in captures if capture.artefacts[0].sha256 in reasons]
        if names:
            self.context.note(SPOILT, viewpoints=names, attempt=self.context.attempt)

    def suggested(self) -> set[str]:
        """Return the names of the viewpoints that earlier attempts of this step suggested."""
        return {view.viewpoint for note in suggested_views(self.context.state) for view in note.viewpoints}

    def _suggest(
        self,
        failed: Sequence[Gate],
        measures: Mapping[str, float],
        suggestions: Sequence[Suggestion],
        retakes: str,
        again: int,
    ) -> None:
        last = suggestions[-1]
        names = ", ".join(view.viewpoint for view in suggestions)
        short = "; ".join(
            f"{measure_name(gate.measure)} is {measures[gate.measure]:.3g} {gate.unit}, "
            f"needed {gate_text(gate.min, gate.max)}"
            for gate in failed
            if gate.measure in measures
        )
        confirm = "The same confirmation also takes" if retakes else "Confirm to take"
        advice = (
            f"{short}. {confirm} {len(suggestions)} more views ({names}): the error is then predicted to be "
            f"{last.predicted_error_mm:.3f} mm and the coverage {100 * last.coverage:.0f} %"
        )
        self.context.tell(advice)  # the advice on retakes was shown before
        # Pages show the newest note with advice, so it must hold everything that the confirmation does.
        both = f"{retakes}. {advice}" if retakes else advice
        # This note replaces that of the retakes, so it repeats what has to be done for them.
        told = self.context.evidence.state().steps[self.context.step.id].mend if retakes else None
        hands = [] if told is None else [work.model_dump(mode="json") for work in told.hands]
        views = [view.plain() for view in suggestions]
        self.context.note(SUGGESTION, advice=both, viewpoints=views, images=again, hands=hands)

    def _gate(self, measure: str) -> Gate | None:
        return next((gate for gate in self.context.step.gates if gate.measure == measure), None)

    def _jobs(self, kind: str) -> list[JobState]:
        steps = dict.fromkeys((*self.params.images_of, self.context.step.id))
        return [job for step in steps for job in self.context.evidence.jobs(step) if job.kind == kind]

    def _earlier(self) -> tuple[tuple[Hash, ...], Each | None]:
        """Return the files of the jobs on images that still count, in the order of capture, and their reference."""
        steps = dict.fromkeys((*self.params.images_of, self.context.step.id))
        state = self.context.evidence.state()
        captures: list[RecordedView] = []
        for step in steps:
            captures += self.context.evidence.captures(step)
        hashes = [capture.artefacts[0].sha256 for capture in captures]
        jobs = jobs_of(state)
        done = [job for job in jobs.values() if job.kind == "live_view" and job.status == "finished"]
        by_image = {image_of(job).sha256: job for job in done}
        mine = [by_image[sha256] for sha256 in hashes if sha256 in by_image]
        files = tuple(job.artefacts[0].sha256 for job in mine)
        keys = tuple(key_stem(state, step, "live_view") for step in steps)
        every = Each(keys, state.seq, "artefacts/0/sha256")
        counted = {job.job for job in mine}
        without = tuple(job.job for job in every.members(jobs) if job.job not in counted)
        each = replace(every, without=without)
        return files, each if resolve(each.record(), jobs) == list(files) else None

    def _looked_at(self, *steps: str) -> list[ImageSharpness]:
        """Return the sharpness of the images of these steps whose job has finished, in the order of capture."""
        by_image = {image_of(j).sha256: j for j in self._jobs("live_view") if j.status == "finished"}
        captures = [capture for step in steps for capture in self.context.evidence.captures(step)]
        hashes = [capture.artefacts[0].sha256 for capture in captures]
        width = self.shared.values.camera.width
        jobs = [by_image[sha256] for sha256 in hashes if sha256 in by_image]
        return [ImageSharpness.of(job, black=LIVE_VIEW.read_answer(job.result).black, width=width) for job in jobs]

    def _surface(self) -> str | None:
        done = [job for job in self._jobs("coverage_points") if job.status == "finished"]
        return done[-1].artefacts[0].sha256 if done else None

    def _wait(self) -> None:
        before, since_s = 0, self.context.monotonic_s()
        while True:
            self.context.checkpoint()
            self.look()
            waiting = [j for kind in (*_DESCRIBED, "coverage_points") for j in self._jobs(kind)]
            left = sum(job.status == "enqueued" for job in waiting)
            if not left:
                return
            if left != before or self.context.evidence.computing():
                before, since_s = left, self.context.monotonic_s()
            if self.context.monotonic_s() - since_s > self.params.wait_s:
                self.context.note("live_numbers_late", images=left)
                return
            images = [job for job in waiting if job.kind in _DESCRIBED]
            done = sum(job.status != "enqueued" for job in images)
            self.context.progress("analysing the last images", done, len(images))
            self.context.wait_for_results(0.1)

    def _tell(self) -> None:
        for kind, describe in _DESCRIBED.items():
            for job in self._jobs(kind):
                if job.status != "enqueued" and job.job not in self.told:
                    self.told.add(job.job)
                    self.context.tell(describe(job))


def seen_words(seen: float, expected: float | None) -> str:
    """Return `9/10 spheres`, or `13 spheres (10 expected in this image)` if there are more than expected."""
    if expected is None:
        return f"{seen:.0f} spheres"
    if seen > expected:
        return f"{seen:.0f} spheres ({expected:.0f} expected in this image)"
    return f"{seen:.0f}/{expected:.0f} spheres"


def describe_view(job: JobState) -> str:
    """Return one line on one image: `v1_005: 9/10 spheres, 0.18 px, predicted error 0.210 mm, coverage 74 %`."""
    if job.status == "failed":
        return f"{image_of(job).viewpoint}: could not be analysed: {job.message}"
    m, answer = job.measures, LIVE_VIEW.read_answer(job.result)
    parts = [seen_words(m["spheres_seen"], m.get("spheres_expected"))]
    if "outline_rms_px" in m:
        parts.append(f"{m['outline_rms_px']:.2f} px")
    if ERROR in m:
        parts.append(f"predicted error {m[ERROR]:.3f} mm")
    if COVERAGE in m:
        parts.append(f"coverage {100 * m[COVERAGE]:.0f} %")
    if answer.reason:
        parts.append(answer.reason)
    return f"{answer.viewpoint}: {', '.join(parts)}"


_DESCRIBED = {LIVE_VIEW.name: describe_view, FURTHER_VIEW.name: describe_further}


@dataclass(frozen=True, slots=True)
class SharedArguments:
    """The arguments that all jobs of a capture share, and the references that are recorded in their place.

    The covariance of T_flange_camera and the scatter of the camera's poses are those of the hand-eye calibration with
    the arm's correction, if there is one, because the poses of the images are corrected too.
    """

    values: LiveArguments  # without the mounting, which is another at other stations
    mounting: Mounting
    taken: Mapping[str, Reference | Each | None]

    @classmethod
    def of(cls, context: StepContext, params: LiveParams) -> SharedArguments:
        """Read the arguments from the results of earlier steps. Raises ConfigurationError if one is missing."""
        scan = context.earlier_answer(params.spheres_of, LOCATE_SPHERES)
        calibration = context.earlier_answer(params.calibration, CALIBRATE)
        hand_eye = context.earlier_answer(params.hand_eye, CALIBRATE)
        record = hand_eye.answer.hand_eye
        if record is None:
            raise ConfigurationError(
                f"step {params.hand_eye!r} has no hand-eye calibration",
                where=f"step {context.step.id}, live",
                remedy="Do that step first",
            )
        best = record.best
        sigma_m = metres(_rms(best.residuals.held_out_mm.values()))
        sigma_rad = float(np.radians(_rms(best.residuals.held_out_deg.values())))
        at = "hand_eye" if record.arm_correction is None else "hand_eye/arm_correction"
        values = LiveArguments(
            camera=calibration.answer.camera,
            hand_eye_covariance=best.sigma.covariance,
            arm_sigma_m=sigma_m if params.arm_sigma_mm is None else metres(params.arm_sigma_mm),
            arm_sigma_rad=sigma_rad if params.arm_sigma_mrad is None else rad_of_mrad(params.arm_sigma_mrad),
            spheres_m=scan.answer.spheres_m,
            radius_m=metres(context.protocol.spheres.radius_mm),
            limits=Limits.model_validate(params.coverage.model_dump()),
        )
        return cls(
            values,
            Mounting(T_flange_camera=best.T_flange_camera),
            taken={
                "camera": calibration.reference("camera"),
                "spheres_m": scan.reference("spheres_m"),
                "hand_eye_covariance": hand_eye.reference(f"{at}/sigma/covariance"),
                "T_flange_camera": hand_eye.reference(f"{at}/T_flange_camera"),
            },
        )


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _fails(gate: Gate, measures: Mapping[str, float]) -> bool:
    if gate.measure not in (ERROR, COVERAGE):
        return False
    value = measures.get(gate.measure)
    return value is None or (gate.max is not None and value > gate.max) or (gate.min is not None and value < gate.min)
