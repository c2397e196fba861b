"""Replay: recorded jobs computed and gates judged again from the record, with drift and changed software named."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from service.audit.differences import Comparison, Difference, compare_data, compare_files
from service.audit.recorded_run import RecordedFiles, RecordedRun
from service.computations import job_kinds
from service.computations.job import JobAnswer, JobContext
from service.computations.registration import ARM, REGISTER
from service.compute.registration.accuracy import true_error_m
from service.core.errors import ConfigurationError, IntegrityError, OrthocaptureError
from service.core.gates import evaluate_gates
from service.core.geometry import apply
from service.core.jobs import Reference, computed_by, jobs_of, resolve
from service.core.records.base import ArtefactRef
from service.core.records.run_events import GateVerdict, JobEnqueued, JobFinished, SessionStarted
from service.core.run.state import JobState, RunState, StepState
from service.core.units import mm
from service.dataset.summary import RunSummary
from service.runner.held_run import software_versions
from service.store.artefacts import hash_file
from service.store.events import parse_canonical, payload_text
from service.store.verification.verify import AuditReport, verify
from service.worker.loop import HANDLERS

# --- answers that the replay has computed, as the input of later jobs, and their drift ----------------------------

_TELLING_DIGITS = 12  # a number with so many digits is recognised by its value, since nobody typed it
_TELLING_BITS = (
    32  # what rounding leaves of zero (-7 / 2**55) prints many digits, but two computations often meet in it
)


@dataclass
class CopiedResults:
    """Parts of the answers so far, by their content: an argument that equals a part was copied from there."""

    _parts: dict[str, Reference] = field(default_factory=dict[str, Reference])

    def add(self, job: JobState) -> None:
        """Add the answer of a finished job."""
        self._index(job.job, "result", job.result)

    def _index(self, job: str, path: str, value: Any) -> None:
        if _is_telling(value):
            self._parts[_key(value)] = Reference(job, path)
        if isinstance(value, Mapping):
            for name, item in cast("Mapping[str, Any]", value).items():
                self._index(job, f"{path}/{name}", item)
        elif isinstance(value, list | tuple):
            for index, item in enumerate(cast("Sequence[Any]", value)):
                self._index(job, f"{path}/{index}", item)

    def as_references(self, arguments: Any) -> Any:
        """Return the arguments with a reference in place of every copy."""
        if _is_telling(arguments):
            found = self._parts.get(_key(arguments))
            if found is not None:
                return found.record()
        if isinstance(arguments, Mapping):
            return {name: self.as_references(item) for name, item in cast("Mapping[str, Any]", arguments).items()}
        if isinstance(arguments, list | tuple):
            return [self.as_references(item) for item in cast("Sequence[Any]", arguments)]
        return arguments


def _key(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _is_telling(value: Any) -> bool:
    """Return whether a value holds a number with so many digits that equality means a copy."""
    if isinstance(value, float):
        digits = repr(value).split("e")[0].replace("-", "").replace(".", "").strip("0")
        return len(digits) >= _TELLING_DIGITS and value.as_integer_ratio()[0].bit_length() >= _TELLING_BITS
    if isinstance(value, Mapping):
        return any(map(_is_telling, cast("Mapping[str, Any]", value).values()))
    return isinstance(value, list | tuple) and any(map(_is_telling, cast("Sequence[Any]", value)))


@dataclass(frozen=True, slots=True)
class Drift:
    """Displacement of the scan from its recorded registration, at the centre of its spheres."""

    registration: str
    in_world_mm: float | None  # drift by T_world_scan; None if the world frame is that of the reconstruction
    against_cameras_mm: float  # drift after aligning the cameras


@dataclass(frozen=True, slots=True)
class _Pair:
    """A job as recorded, and as computed again."""

    step: str
    before: JobState
    now: JobState


class RecomputedJobs:
    """The jobs of a run with the answers of the replay."""

    def __init__(self, state: RunState) -> None:
        self.renamed: dict[str, str] = {}  # hash of a recorded file → hash of the file written again, if it differs
        self.pairs: list[_Pair] = []
        self._jobs = jobs_of(state)
        self._copied = CopiedResults()

    def add(self, step: str, job: JobState, now: JobFinished, answer: JobAnswer) -> None:
        """Add a recomputed job, in the order of the jobs; `now` as its event would be."""
        again = replace(job, measures=now.measures, result=now.result, artefacts=answer.artefacts)
        for old, new in zip(job.artefacts, answer.artefacts, strict=False):
            if old.sha256 != new.sha256:
                self.renamed[old.sha256] = new.sha256
        self._copied.add(job)
        self._jobs[job.job] = again
        self.pairs.append(_Pair(step, job, again))

    def arguments(self, job: JobState) -> Mapping[str, Any]:
        """Return a job's arguments with the recomputed answers of earlier jobs."""
        return self._with_new_hashes(resolve(self._copied.as_references(job.arguments), self._jobs))

    def _with_new_hashes(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: self._with_new_hashes(item) for key, item in cast("Mapping[str, Any]", value).items()}
        if isinstance(value, list | tuple):
            return [self._with_new_hashes(item) for item in cast("Sequence[Any]", value)]
        return self.renamed.get(value, value) if isinstance(value, str) else value

    def measures_of(self, step: StepState) -> dict[str, float] | None:
        """Return a step's measures with the recomputed ones of its jobs; None if no job of it was computed again."""
        pairs = {pair.before.job: pair for pair in self.pairs if pair.step == step.step}
        if not pairs:
            return None
        measures = dict(step.measures)
        for source in computed_by(step):
            if source.job in pairs:
                again = pairs[source.job].now.measures
                measures |= {source.prefix + name: float(value) for name, value in again.items()}
        return {name: value for name, value in measures.items() if name in step.measures}


def drifts(summary: RunSummary, recomputed: RecomputedJobs) -> Iterator[Drift]:
    """Yield the drift of every registration that was computed again."""
    spheres = summary.scan_spheres_m()
    if not spheres:
        return
    centre_m = np.array(spheres, dtype=np.float64).mean(axis=0)
    for pair in recomputed.pairs:
        of_scan = summary.protocol.step(pair.step).gives == "registrations"  # the ground truth registers the CT, too
        if pair.before.kind != REGISTER.name or not of_scan:
            continue
        before, after = (REGISTER.read_answer(job.result) for job in (pair.before, pair.now))
        shared = sorted(before.T_scan_camera.keys() & after.T_scan_camera.keys())
        moved, given = (np.array([each.T_scan_camera[name] for name in shared]) for each in (after, before))
        in_world: float | None = None
        if before.poses in ARM:  # the world is the base of the first station
            places = [apply(np.array(each.T_world_scan), centre_m) for each in (before, after)]
            in_world = mm(float(np.linalg.norm(places[1] - places[0])))
        yield Drift(before.poses, in_world, mm(true_error_m(moved, given, centre_m)))


class ScratchStore:
    """The store that a job's handler sees during a replay."""

    def __init__(self, recorded: RecordedFiles, folder: Path) -> None:
        self._recorded = recorded
        self._folder = folder

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return a recomputed file, or else the recorded one. Raises IntegrityError."""
        own = self._folder / sha256
        return own if own.is_file() else self._recorded.artefact_path(sha256, verify=verify)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep bytes in the scratch folder."""
        digest = hashlib.sha256(data).hexdigest()
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / digest).write_bytes(data)
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=len(data), original_name=original_name
        )

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep a copy of a file in the scratch folder."""
        digest, size = hash_file(path)
        self._folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, self._folder / digest)
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=size, original_name=original_name
        )


# --- the replay ---------------------------------------------------------------------------------------------------

Verdict = Literal["identical", "within_tolerance", "different", "not_replayed"]
_WORST_FIRST: tuple[Verdict, ...] = ("not_replayed", "different", "within_tolerance")


@dataclass(frozen=True, slots=True)
class VersionChange:
    """A distribution that is not what it was when the run was recorded; "" where it is or was not installed."""

    name: str
    recorded: str
    now: str


@dataclass(frozen=True, slots=True)
class ArtefactReplay:
    """A file that a job wrote, and the same file written again."""

    name: str
    kind: str
    recorded_sha256: str
    recomputed_sha256: str
    content: Comparison  # empty where the hashes are the same


@dataclass(frozen=True, slots=True)
class JobReplay:
    """One job computed again."""

    job: str
    kind: str
    step: str
    attempt: int
    label: str  # the source of poses, which distinguishes registrations; "" for other kinds
    verdict: Verdict
    measures: Comparison = field(default_factory=Comparison)
    result: Comparison = field(default_factory=Comparison)
    artefacts: tuple[ArtefactReplay, ...] = ()
    duration_s: float = 0.0
    error: str = ""  # why it could not be replayed
    computed_by: str = ""  # the version that computed it, in words, if this program's gives other numbers

    @property
    def differences(self) -> tuple[Difference, ...]:
        """The differences of measures, result and files, in this order, each worst first."""
        parts = (self.measures, self.result, *(artefact.content for artefact in self.artefacts))
        return tuple(difference for part in parts for difference in part.differences)


@dataclass(frozen=True, slots=True)
class GateReplay:
    """A step's gates judged again by the measures that the replay gave."""

    step: str
    attempt: int
    recorded: tuple[GateVerdict, ...]
    recomputed: tuple[GateVerdict, ...]

    @property
    def changed(self) -> tuple[tuple[GateVerdict, GateVerdict], ...]:
        """Verdicts that are now different: recorded, recomputed."""
        pairs = zip(self.recorded, self.recomputed, strict=True)
        return tuple((old, new) for old, new in pairs if old.passed != new.passed)


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """The whole replay. `gates_judged`: number of recorded verdicts that follow from the recorded measures."""

    run_id: str
    head_sha256: str
    end_to_end: bool
    versions: tuple[VersionChange, ...]
    files_verified: int
    bytes_verified: int
    gates_judged: int
    gates: tuple[GateReplay, ...]
    jobs: tuple[JobReplay, ...]
    drifts: tuple[Drift, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst of all jobs; a gate with another verdict is a difference."""
        found: set[Verdict] = {job.verdict for job in self.jobs}
        if any(gate.changed for gate in self.gates):
            found.add("different")
        for verdict in _WORST_FIRST:
            if verdict in found:
                return verdict
        return "identical"


Progress = Callable[[str, int, int], None]

# The computations behind a data set; the checks of each live image are left out unless asked for.
DEFAULT_KINDS = tuple(name for name, kind in job_kinds().items() if kind.replayed)
_FAILURES = (ValueError, ArithmeticError, LookupError, OSError, MemoryError, np.linalg.LinAlgError)


def replay(
    run: RecordedRun,
    *,
    kinds: Collection[str] = DEFAULT_KINDS,
    step: str | None = None,
    end_to_end: bool = False,
    out: Path | None = None,
    progress: Progress,
) -> ReplayReport:
    """Compute the finished, valid jobs of a run again and compare each with what was recorded.

    Each job gets the recorded results of the jobs before it, so that it is judged by itself; with `end_to_end` it
    gets the recomputed ones. Nothing is written into the data folder.

    Args:
        run: the run, as `read_run` returns it.
        kinds: the kinds of jobs to compute.
        step: only this step's jobs.
        end_to_end: feed each job the recomputed results; the report then has the drift of each registration.
        out: folder to keep the recomputed files in, by step, job and name.
        progress: a function that is called with the activity, the amount done and the total.

    Raises:
        IntegrityError: the evidence does not verify; the message names the first fault.
        ConfigurationError: unknown kind or step, `out` within the data folder, nothing to replay.
    """
    if out is not None and run.data_dir.resolve() in (out.resolve(), *out.resolve().parents):
        raise ConfigurationError("the recomputed files must not be written into the data folder", where=str(out))
    chosen = _chosen(run, kinds, step)
    checked = _require_sound(run, progress)
    recomputed = RecomputedJobs(run.state)
    recorded = jobs_of(run.state)
    replays: list[JobReplay] = []
    with tempfile.TemporaryDirectory(prefix="orthocapture-replay-") as folder:
        store = ScratchStore(run.files, Path(folder))
        for number, (step_id, job) in enumerate(chosen, 1):
            title = f"{number}/{len(chosen)} {job.kind.replace('_', ' ')}"
            progress(title, 0, 1)

            def show(what: str, done: int, total: int, title: str = title) -> None:
                progress(f"{title}: {what}", done, total)

            arguments = recomputed.arguments(job) if end_to_end else resolve(job.arguments, recorded)
            replays.append(_replay_job(run, store, step_id, job, arguments, recomputed, show))
            if out is not None:
                _keep(store, replays[-1], out / step_id / f"{number:02d}_{job.kind}")
        return ReplayReport(
            run_id=run.run_id,
            head_sha256=run.events[-1].sha256,
            end_to_end=end_to_end,
            versions=changed_versions(run),
            files_verified=checked.files,
            bytes_verified=checked.bytes_hashed,
            gates_judged=sum(len(state.verdicts) for state in run.state.steps.values()),
            gates=tuple(_gates(run, recomputed)),
            jobs=tuple(replays),
            drifts=tuple(drifts(run.summary(), recomputed)) if end_to_end else (),
        )


def _require_sound(run: RecordedRun, progress: Progress) -> AuditReport:
    """Verify the evidence. Raises IntegrityError."""
    checked = verify(run.data_dir, run.run_id, progress)
    if checked.first_fault is not None:
        raise IntegrityError(
            f"the evidence does not verify, so there is nothing to compare with: {checked.first_fault}",
            where=str(run.data_dir),
            remedy="See `orthocapture audit verify`; restore the file from a copy",
        )
    return checked


def _chosen(run: RecordedRun, kinds: Collection[str], step: str | None) -> list[tuple[str, JobState]]:
    unknown = sorted(set(kinds) - set(HANDLERS))
    if unknown:
        raise ConfigurationError(
            f"no worker computes {', '.join(unknown)}", remedy=f"Jobs are of the kinds {', '.join(HANDLERS)}"
        )
    if step is not None and step not in run.state.steps:
        raise ConfigurationError(f"the protocol has no step {step!r}", remedy=f"Steps: {', '.join(run.state.steps)}")
    jobs = [
        (name, job)
        for name, state in run.state.steps.items()
        if step in (None, name)
        for job in state.jobs.values()
        if job.status == "finished" and job.kind in kinds
    ]
    if not jobs:
        raise ConfigurationError(
            "nothing of these kinds was computed in this run",
            where=run.run_id if step is None else f"{run.run_id}, step {step}",
            remedy="Choose others with --jobs or --step",
        )
    return sorted(jobs, key=lambda named: named[1].enqueued_seq)


def _replay_job(
    run: RecordedRun,
    store: ScratchStore,
    step: str,
    job: JobState,
    arguments: Mapping[str, Any],
    recomputed: RecomputedJobs,
    progress: Progress,
) -> JobReplay:
    recorded, kind = _finished(run, job), job_kinds()[job.kind]
    about = JobReplay(
        job=job.job,
        kind=job.kind,
        step=step,
        attempt=job.attempt,
        label=str(job.arguments.get("poses", "")),
        verdict="not_replayed",
        computed_by=kind.other_numbers(_version(run, job)),
    )
    why_not = kind.not_compared(recorded.result)
    if why_not:
        return replace(about, error=why_not)
    started_s = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="orthocapture-job-") as scratch:
            context = JobContext(arguments, store, Path(scratch), progress, events=lambda _run: run.events)
            answer = HANDLERS[job.kind](context)
        now = _as_recorded(recorded, answer)
    except OrthocaptureError as error:
        return replace(about, error=f"{type(error).__name__}: {error}", duration_s=time.monotonic() - started_s)
    except _FAILURES as error:
        return replace(about, error=repr(error), duration_s=time.monotonic() - started_s)
    about = replace(about, duration_s=time.monotonic() - started_s)
    recomputed.add(step, job, now, answer)
    return _compare(about, recorded, now, answer, (run.files, store), recomputed.renamed)


def _compare(
    about: JobReplay,
    recorded: JobFinished,
    now: JobFinished,
    answer: JobAnswer,
    files: tuple[RecordedFiles, ScratchStore],
    renamed: Mapping[str, str],
) -> JobReplay:
    """Return the job with its measures, result and files compared. `now`: as its event would be."""
    artefacts = [
        _compare_artefacts(*files, old, new, renamed)
        for old, new in zip(recorded.artefacts, answer.artefacts, strict=False)
    ]
    names = [[ref.original_name for ref in refs] for refs in (recorded.artefacts, answer.artefacts)]
    listed = compare_data(*names, path="files")
    measures = compare_data(recorded.measures, now.measures, path="measures")
    left_out = job_kinds()[about.kind].circumstances
    results = ({name: value for name, value in of.result.items() if name not in left_out} for of in (recorded, now))
    result = compare_data(*results, path="result", renamed=renamed)
    parts = [measures, result, listed, *(artefact.content for artefact in artefacts)]
    if about.computed_by:  # an earlier version did not tell what this one tells besides
        parts = [part.of_recorded() for part in parts]
    same_files = all(artefact.recorded_sha256 == artefact.recomputed_sha256 for artefact in artefacts)
    result = replace(result, differences=(*listed.differences, *result.differences))
    verdict = _verdict(parts, same_files=same_files)
    return replace(about, verdict=verdict, measures=measures, result=result, artefacts=tuple(artefacts))


def _verdict(parts: Iterable[Comparison], *, same_files: bool) -> Verdict:
    compared = tuple(parts)
    if not all(part.equal for part in compared):
        return "different"
    return "identical" if same_files and all(part.identical for part in compared) else "within_tolerance"


def _finished(run: RecordedRun, job: JobState) -> JobFinished:
    """Return the event whose result counts: the first one, when a second worker finished it too."""
    events = (event.payload for event in run.events)
    return next(p for p in events if isinstance(p, JobFinished) and p.job == job.job)


def _version(run: RecordedRun, job: JobState) -> int:
    """Return the version of the computation that was enqueued."""
    events = (event.payload for event in run.events)
    return next(p.version for p in events if isinstance(p, JobEnqueued) and p.job == job.job)


def _as_recorded(recorded: JobFinished, answer: JobAnswer) -> JobFinished:
    """Return an answer as it would stand in the evidence, through the same canonical form."""
    payload = recorded.model_copy(
        update={
            "measures": dict(answer.measures),
            "artefacts": tuple(answer.artefacts),
            "result": answer.result,
        }
    )
    return JobFinished.model_validate(parse_canonical(payload_text(payload)))


def _compare_artefacts(
    recorded: RecordedFiles, store: ScratchStore, old: ArtefactRef, new: ArtefactRef, renamed: Mapping[str, str]
) -> ArtefactReplay:
    content = Comparison()
    if old.sha256 != new.sha256:
        paths = recorded.artefact_path(old.sha256), store.artefact_path(new.sha256)
        content = compare_files(old, *paths, renamed=renamed)
    return ArtefactReplay(old.original_name, old.kind, old.sha256, new.sha256, content)


def _gates(run: RecordedRun, recomputed: RecomputedJobs) -> Iterator[GateReplay]:
    """Yield the gates of every step whose measures hold a recomputed one.

    That the recorded verdicts follow from the recorded measures is what reading the run has shown: `fold` refuses
    others.
    """
    for step_id, state in run.state.steps.items():
        measures = recomputed.measures_of(state)
        if state.verdicts and measures is not None:
            judged = evaluate_gates(
                run.protocol.step(step_id), state.attempt, measures, run.state.skipped, state.uncertainties
            )
            if len(judged.verdicts) == len(state.verdicts):
                yield GateReplay(step_id, state.attempt, state.verdicts, judged.verdicts)


def _keep(store: ScratchStore, job: JobReplay, folder: Path) -> None:
    for artefact in job.artefacts:
        folder.mkdir(parents=True, exist_ok=True)
        content = store.artefact_path(artefact.recomputed_sha256).read_bytes()
        (folder / Path(artefact.name).name).write_bytes(content)


def changed_versions(run: RecordedRun) -> tuple[VersionChange, ...]:
    """Return distributions that differ between the run's last session and this process."""
    sessions = [e.payload for e in run.events if isinstance(e.payload, SessionStarted)]
    recorded = sessions[-1].software if sessions else run.root.software
    now = software_versions()
    names = sorted({**recorded, **now}, key=str.lower)
    changes = (VersionChange(name, recorded.get(name, ""), now.get(name, "")) for name in names)
    return tuple(change for change in changes if change.recorded != change.now)
