"""Guides a person from image to image: a job for each, and its result in words."""

from __future__ import annotations

from dataclasses import dataclass

from service.core.errors import ConfigurationError
from service.core.gates.verdict import evaluate_gates
from service.core.jobs.keys import key_stem
from service.core.jobs.references import Each, jobs_of, resolve
from service.core.records.events import ViewHeld
from service.core.run.state import JobState
from service.jobs.capture import hand_board, hand_view
from service.jobs.looks import image_of
from service.jobs.surfaces import coverage_points
from service.steps.capture.exposure import wanted_settings
from service.steps.capture.live_numbers import COVERAGE, ERROR, seen_words
from service.steps.capture.optics import departing_images, optics_departures
from service.steps.context import JobRequest, StepContext, StepOutcome
from service.steps.handheld.arguments import CommonArguments
from service.steps.handheld.records import Measures, Params, Result
from service.steps.inputs import artefact_of, held_views


def failure_words(job: JobState) -> str:
    """Explains a failed job on the images: what it means, and what to do."""
    why = job.message.rstrip(".")
    if job.kind == coverage_points.KIND.name:
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
    """Enqueues a job for one image after the other, and tells the person the result."""

    context: StepContext
    params: Params
    shared: CommonArguments
    told: str = ""

    @property
    def kind(self) -> str:
        """Kind of the jobs."""
        return (hand_board if self.params.purpose == "calibration" else hand_view).KIND.name

    def begin(self) -> None:
        """Enqueue the specimen's surface if there is a CT, and say where to begin."""
        mesh, shared = self._mesh(), self.shared.values
        if mesh is not None and isinstance(shared, hand_view.SpecimenArguments):  # a board has no surface
            arguments = coverage_points.Arguments(
                mesh=mesh, spheres_m=shared.spheres_m, radius_m=shared.radius_m, limits=shared.limits
            )
            references = {"spheres_m": self.shared.references["spheres_m"]}
            request = JobRequest.of(coverage_points.KIND, arguments, references)
            self.context.evidence.enqueue(request, "specimen")
        done = self._answers()
        self._say(_answer_of(done[-1]).words if done else self.shared.values.first_words)

    def look(self) -> None:
        """Tell the result of the last image, and enqueue the job for the next one. Returns at once."""
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
            if job.kind == coverage_points.KIND.name and job.status == "failed" and job.job not in self._reported:
                self._reported.add(job.job)
                self.context.tell(failure_words(job))

    def __post_init__(self) -> None:
        # The results of jobs that ended before a restart were told then.
        self._reported = {job.job for job in self._jobs() if job.status != "enqueued"}

    def images_used(self) -> int:
        """Number of usable images so far."""
        return int(self._measures().get("images_used", 0))

    def enough(self) -> bool:
        """Whether every image was analysed and the step's gates pass, or there are too many images."""
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
        """The outcome of the step."""
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
                return artefact_of(self.context, name, "ct_mesh").sha256
            except ConfigurationError:
                return None
        return None

    def _surface(self) -> str | None:
        jobs = self.context.evidence.jobs(self.context.step.id)
        done = [job for job in jobs if job.kind == coverage_points.KIND.name and job.status == "finished"]
        return done[-1].artefacts[0].sha256 if done else None

    def _enqueue(self, view: ViewHeld) -> None:
        wanted = wanted_settings(self.context)
        camera = view.camera
        settings = ""
        if not view.verdicts["settings"]:
            settings = (
                f"the camera was set to f/{camera['aperture_f']:g}, {camera['exposure_s']:.3g} s, "
                f"ISO {camera['iso']}; "
                f"required are f/{wanted.aperture_f:g}, {wanted.exposure_s:.3g} s, ISO {wanted.iso}"
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
        shared = self.shared.values
        arguments = {**shared.set_fields(), "image": image, "earlier": earlier, "surface": self._surface()}
        references = {**self.shared.references, "earlier": looks}
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


def _answer_of(job: JobState) -> hand_view.Answer:
    """The answer of either kind of job: both answer alike."""
    return hand_view.KIND.read_answer(job.result)
